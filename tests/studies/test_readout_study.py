"""Ways to read the same weights: each asks the same questions, and what has no preference gives the same answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import mmgsd
from mmgsd.config import EvaluateConfig
from mmgsd.dataset import load_dataset
from mmgsd.match.matcher import Matcher
from mmgsd.model.heads import Outputs
from mmgsd.studies.readout import TEMPERATURES, WAYS, describe_ways, measure_ways
from mmgsd.studies.table import to_markdown

FEW = EvaluateConfig(pairs=4, points=9)


def test_every_way_answers_the_same_queries_and_leaves_the_weights_as_they_were(cloth_dataset: Path) -> None:
    matcher, data = mmgsd.load("cloth-paper"), load_dataset(cloth_dataset, "test")
    before = matcher.temperature
    found = measure_ways(matcher, data, config=FEW)
    assert list(found) == list(WAYS) and len({row["queries"] for row in found.values()}) == 1
    assert found["temperature 1"]["temperature"] == 1.0 and found["shipped"]["temperature"] == before
    assert found["least error"]["temperature"] in [before * factor for factor in TEMPERATURES]
    assert matcher.temperature == before and matcher.turns == 4
    lines = to_markdown(describe_ways({"cloth-paper": {"quick": found}})).splitlines()
    assert len(lines) == 2 + len(WAYS) and lines[2].startswith("| as it is shipped |")


def test_what_sees_turns_and_mirror_images_alike_answers_all_ways_alike(cloth_dataset: Path, monkeypatch) -> None:
    matcher, data = mmgsd.load("cloth-paper"), load_dataset(cloth_dataset, "test")

    def describe(images: list[np.ndarray]) -> list[Outputs]:
        """A cell's descriptor is its brightness, whichever way round the image is."""
        cells = [torch.from_numpy(image[..., 0].copy()).float()[None, None] / 255 for image in images]
        small = [torch.nn.functional.adaptive_avg_pool2d(image, 24)[0] for image in cells]
        return [Outputs(one.expand(2 * matcher.config.descriptor_dim, -1, -1)) for one in small]

    monkeypatch.setattr(Matcher, "describe", lambda self, images: describe(images))
    ways = {name: WAYS[name] for name in ("shipped", "turned", "flipped")}
    found = measure_ways(matcher, data, config=FEW, ways=ways)
    assert found["turned"]["rmse_mean"] == pytest.approx(found["shipped"]["rmse_mean"], abs=0.5)
    assert found["flipped"]["rmse_mean"] == pytest.approx(found["shipped"]["rmse_mean"], abs=0.5)
