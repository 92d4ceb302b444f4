"""Jumps of neighbouring matches: none where offsets are the same, half a border where one side is moved."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.studies.continuity import JUMP_PX, measure_jumps


class Knowing:
    """Answers with the true matches, moved by what is told of the source's point."""

    def __init__(self, data: Dataset, move: Callable[[np.ndarray], np.ndarray]) -> None:
        self.data, self.move = data, move

    def match(self, image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, *, n: int) -> Any:
        first, second = (next(k for k in range(len(self.data)) if np.array_equal(self.data.load_image(k), image))
                         for image in (image0, image1))  # fmt: skip
        points = np.array([np.flatnonzero((self.data.xy[first] == pixel).all(1))[0] for pixel in xy])
        true = self.data.xy[second][self.data.group().orbit(points)]
        return SimpleNamespace(modes=true[:, ::-1] + self.move(points)[:, None])


@pytest.mark.parametrize(
    ("object", "move", "share"),
    [
        ("rope", lambda p: np.zeros((len(p), 2)), 0.0),
        ("rope", lambda p: np.full((len(p), 2), 3 * JUMP_PX), 0.0),  # wrong, and continuous
        ("rope", lambda p: np.outer(p == 100, (0, 2 * JUMP_PX)), 2 / 622),  # of the neighbours without the middle
        ("cloth", lambda p: np.outer(p // 25 < 5, (0, 1.1 * JUMP_PX)), 25 / 1196),  # of those without the centre
    ],
)
def test_jumps_by_hand(
    tiny_dataset: Callable[..., Path], object: str, move: Callable[[np.ndarray], np.ndarray], share: float
) -> None:
    data = load_dataset(tiny_dataset(object=object, n_test=4), "test")
    data.visible[:] = True
    found = measure_jumps(Knowing(data, move), data, config=EvaluateConfig(pairs=2))
    assert found["jumps"] == pytest.approx(share, abs=1e-4)
