"""Others' renders of a cloth: who knows errs by nothing, and another format is named."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mmgsd.files import DamagedFileError
from mmgsd.measure.shipped import measure_cloth_renders, read_cloth_renders
from mmgsd.symmetry import load_group

GRID = np.stack(np.divmod(np.arange(625), 25)[::-1], 1) * 3.0 + 10  # (625, 2) px
C4 = load_group("cloth", "c4")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two pictures, the second with its cloth two pixels to the right; the number 0 has no picture."""
    labels = {str(k): (GRID + (2 * (k == 2), 0))[:, None].tolist() for k in range(3)}
    (tmp_path / "knots_info.json").write_text(json.dumps(labels))
    for k in (1, 2):
        Image.fromarray(np.full((90, 120, 3), k, np.uint8)).save(tmp_path / f"{k:06d}_rgb.png")
    return tmp_path


class Knowing:
    """A matcher that answers with the true matches, ``off`` px below."""

    def __init__(self, off: float = 0.0) -> None:
        self.off, self.asked = off, 0

    def prepare(self, image0: np.ndarray, image1: np.ndarray) -> Any:
        assert image0.shape == image1.shape == (90, 90, 3)
        shifts = [2 * (int(image[0, 0, 0]) == 2) for image in (image0, image1)]
        return SimpleNamespace(match=lambda xy, n: self.answer(xy, n, *shifts))

    def answer(self, xy: np.ndarray, n: int, shift0: float, shift1: float) -> Any:
        self.asked += len(xy)
        points = np.rint((xy - (shift0, 0) - 10) / 3).astype(int) @ (1, 25)
        modes = np.stack([GRID[C4.distinct_modes(int(p))] for p in points]) + (shift1, self.off)
        assert modes.shape[1] == n
        return SimpleNamespace(modes=modes, covariances=np.tile(np.eye(2), (*modes.shape[:2], 1, 1)))


def test_who_knows_errs_by_nothing_and_every_pair_is_asked(folder: Path) -> None:
    matcher = Knowing()
    found = measure_cloth_renders(matcher, folder)
    assert found["rmse_mean"] == 0 and (found["queries"], found["pictures"], matcher.asked) == (2 * 169, 2, 2 * 169)
    assert measure_cloth_renders(Knowing(5.0), folder)["rmse_mean"] == pytest.approx(5.0)


@pytest.mark.parametrize("labels", [{"1": GRID[:, None].tolist()}, {"1": [], "2": []}, {"1": 3, "2": 4}])
def test_another_format_names_the_file(folder: Path, labels: Any) -> None:
    (folder / "knots_info.json").write_text(json.dumps(labels))
    with pytest.raises(DamagedFileError, match="knots_info.json"):
        read_cloth_renders(folder)


def test_one_picture_is_no_pair(folder: Path) -> None:
    (folder / "000002_rgb.png").unlink()
    with pytest.raises(DamagedFileError, match="at least two pictures"):
        read_cloth_renders(folder)
