"""How modes are read is chosen by what a robot can grasp on held-out renders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from mmgsd.config import EvaluateConfig, TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.match.em import ModeReadout
from mmgsd.match.matcher import Matcher
from mmgsd.measure import calibration
from mmgsd.measure.calibration import (
    ALLOWED,
    POWERS,
    SHARPNESSES,
    SHRINKAGES,
    choose_readout,
    choose_shrinkage,
    count_seen,
    describe_places,
)
from mmgsd.model.network import build_network


@pytest.fixture
def matcher() -> Matcher:
    torch.manual_seed(0)
    config = TrainConfig(input_px=64, descriptor_dim=4)
    return Matcher(build_network("lite0", 4, pretrained=False), config, modes=4, size=(485, 485), device="cpu")


def test_only_matches_that_are_seen_count() -> None:
    true = np.array([[[0.0, 0], [100, 0], [0, 100], [100, 100]]]).repeat(3, 0)
    seen = np.array([[True, True, False, False], [True, True, True, False], [False] * 4])
    modes = true.copy()
    modes[0, 1] = 100, 30  # neither near a seen match nor far from all
    modes[1, :2] = (50, 50), (0, 19)  # the first is far from all three, the second near one
    found, spurious = count_seen(modes, true, seen)
    np.testing.assert_allclose(found, [1 / 2, 2 / 3])  # the third query has nothing to be found
    np.testing.assert_allclose(spurious, [0, 1 / 3])


def test_a_reading_that_costs_too_much_error_is_not_chosen(
    matcher: Matcher, cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(asked: list, tried: ModeReadout, size: tuple[int, int]) -> tuple[float, float]:
        a, b = tried.exponent, tried.mean_exponent
        return 10 * (1 + 0.01 * (a - 1) * b), 0.1 * a * b

    monkeypatch.setattr(calibration, "measure_readout", measure)
    chosen = choose_readout(matcher, load_dataset(cloth_dataset, "test"), pairs=2, points=4)
    assert chosen == matcher.readout == ModeReadout(matcher.config.roundness, 1.5, 8.0)
    assert 1 + 0.01 * 0.5 * 8 <= ALLOWED < 1 + 0.01 * 8


@pytest.mark.parametrize("best", SHRINKAGES)
def test_the_share_with_the_least_error_is_chosen(
    matcher: Matcher, cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch, best: float
) -> None:
    def measure(answer: object, asked: Matcher, *_: object) -> float:
        return 20 + abs(asked.shrinkage - best)

    monkeypatch.setattr(calibration, "measure_mean_error", measure)
    assert choose_shrinkage(matcher, load_dataset(cloth_dataset, "test"), pairs=2, points=4) == best
    assert matcher.shrinkage == best


def test_a_share_is_chosen_by_images(matcher: Matcher, cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset, "test")
    matcher.places = describe_places(matcher, data)
    chosen = choose_shrinkage(matcher, data, pairs=2, points=9)
    assert chosen in SHRINKAGES
    torch.testing.assert_close(describe_places(matcher, data), matcher.places)  # which are of what is not shrunk


def test_a_reading_is_chosen_by_images(matcher: Matcher, cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset, "test")
    chosen = choose_readout(matcher, data, pairs=2, points=9)
    assert chosen.exponent in POWERS and chosen.mean_exponent in SHARPNESSES
    assert chosen == choose_readout(matcher, data, pairs=2, points=9)


def test_the_points_of_a_symmetrys_centre_are_not_asked(matcher: Matcher, cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset, "test")
    for heatmaps, true, seen in calibration._ask_seen(matcher, data, EvaluateConfig(pairs=2, points=625)):
        assert len(heatmaps) == len(true) == len(seen) <= 624 and true.shape[1:] == (4, 2)
