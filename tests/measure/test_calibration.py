"""Calibration: scales of heatmaps, tables of what modes hold, and weights that get them without training."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors import safe_open

from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.match.em import ModeReadout
from mmgsd.match.matcher import Matcher
from mmgsd.measure import calibration
from mmgsd.measure.calibration import (
    BANDWIDTHS,
    calibrate_bandwidth,
    calibrate_modes,
    calibrate_temperature,
    calibrate_unseen,
    calibrate_weights,
    check_calibration,
    find_quantiles,
    fit_calibration,
)
from mmgsd.measure.questions import choose_points
from mmgsd.measure.uncertainty import compute_coverage, get_distances, get_modes, measure_modes, recalibrate
from mmgsd.model.calibration import LEVELS, parse_calibration
from mmgsd.model.network import build_network, compute_cell_centres
from mmgsd.model.tensors import load_metadata, read_tensors, write_tensors

CONFIG = TrainConfig(input_px=64, descriptor_dim=4)


def draw_queries(rng: np.random.Generator, pairs: int, *, points: int = 60, power: float = 1.4) -> pd.DataFrame:
    """Answers of one mode whose errors are heavy-tailed, and grow faster than their spread."""
    spread = np.exp(rng.normal(2.5, 0.6, pairs * points))
    along = rng.standard_t(2.5, (pairs * points, 2)) * (0.15 * spread**power)[:, None]
    distance = np.linalg.norm(along, axis=1)
    table = pd.DataFrame({"pair": np.repeat(np.arange(pairs), points), "visible": True})
    table["entropy"] = 2 * np.log(spread) + rng.normal(0, 0.3, len(spread))
    lists = {"mahalanobis2": (distance / spread) ** 2, "distance_px": distance, "spread_px": spread,
             "share": np.ones(len(spread))}  # fmt: skip
    return table.assign(**{name: list(values[:, None]) for name, values in lists.items()})


def test_ellipses_and_confidences_hold_what_they_promise_of_heavy_tails(rng: np.random.Generator) -> None:
    fitted = fit_calibration(draw_queries(rng, 100))
    unseen = draw_queries(rng, 400)
    ellipse, confidence = check_calibration(fitted, unseen)
    assert ellipse < 0.015 and confidence < 0.03
    assert np.abs(compute_coverage(get_distances(unseen)) - LEVELS[:-1]).mean() > 0.05  # as a Gaussian they do not
    after = compute_coverage(get_distances(recalibrate(unseen, fitted)))
    np.testing.assert_allclose(after, LEVELS[:-1], atol=0.03)


def test_radii_hold_at_least_what_they_promise_on_average_over_calibrations() -> None:
    levels, shares = (0.5, 0.8, 0.9, 0.95), []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        fitted, unseen = fit_calibration(draw_queries(rng, 25, points=8)), get_modes(draw_queries(rng, 50, points=8))
        modes = measure_modes(unseen)
        shares.append([np.mean(unseen.distance_px <= fitted.compute_radius(level, modes)) for level in levels])
    for level, share in zip(levels, np.mean(shares, 0), strict=True):
        assert level - 0.01 < share < level + 0.06


def test_quantiles_weigh_pairs_not_queries() -> None:
    """Nineteen pairs of one query with scores 1 to 19, and one of a thousand queries that are all perfect."""
    scores, pair = np.r_[np.arange(1.0, 20), np.zeros(1000)], np.r_[np.arange(19), np.full(1000, 19)]
    found = dict(zip(LEVELS, find_quantiles(scores, pair), strict=True))
    assert (found[0.05], found[0.5], found[0.95]) == (1, 10, 19)  # of 21, the new one worse than all
    assert found[0.99] == np.inf


def make_matcher(**changed: object) -> Matcher:
    torch.manual_seed(0)
    config = dataclasses.replace(CONFIG, **changed)
    return Matcher(build_network("lite0", 4, pretrained=False), config, modes=4, size=(485, 485), device="cpu")


@pytest.fixture
def weights(cloth_dataset: Path, tmp_path: Path) -> Path:
    """An untrained network that says it was trained on the synthetic data set."""
    matcher, data = make_matcher(), load_dataset(cloth_dataset)
    metadata = {"format": "mmgsd-1", "config": json.dumps(dataclasses.asdict(CONFIG)), "size": "[485, 485]",
                "modes": "4", "data": data.fingerprint, "temperature": "1.5"}  # fmt: skip
    state = {name: value.half() if value.ndim > 1 else value for name, value in matcher.network.state_dict().items()}
    return write_tensors(tmp_path / "w.safetensors", state, metadata)


@pytest.fixture
def many_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tiny data set holds out two images: take all six, and few pairs for enough."""
    monkeypatch.setattr(calibration, "hold_out", lambda data: (data, data))
    monkeypatch.setattr(calibration, "LEAST_PAIRS", 20)


def test_weights_are_calibrated_without_training(weights: Path, cloth_dataset: Path, many_held_out: None) -> None:
    tensors, note = read_tensors(weights)
    assert "calibration" not in note
    assert calibrate_weights(weights, cloth_dataset, pairs=20, points=4, progress=False) == weights
    after, said = read_tensors(weights)
    assert after.keys() == tensors.keys() | {"places"}
    assert all(torch.equal(after[n], v) and after[n].dtype == v.dtype for n, v in tensors.items())
    assert {name: text for name, text in said.items() if name != "calibration"} == note
    found = Matcher.load(weights, device="cpu").calibration
    assert found == parse_calibration(said["calibration"]) and found.pairs == 20
    with safe_open(weights, "pt") as file:
        assert len(file.metadata()["calibration"]) < 1000


def test_calibrated_weights_are_left_alone_unless_asked(
    weights: Path, cloth_dataset: Path, many_held_out: None
) -> None:
    how = {"pairs": 20, "points": 4, "progress": False}
    calibrate_weights(weights, cloth_dataset, **how)
    before, stamp = load_metadata(weights), weights.stat().st_mtime_ns
    calibrate_weights(weights, cloth_dataset, **how)
    assert weights.stat().st_mtime_ns == stamp
    calibrate_weights(weights, cloth_dataset, overwrite="yes", **how)
    assert weights.stat().st_mtime_ns > stamp and load_metadata(weights) == before


def test_unseen_images_choose_how_modes_are_read_as_well(
    weights: Path, cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tensors, note = read_tensors(weights)
    write_tensors(weights, tensors, note | {"data": "0123"})

    def choose(matcher: Matcher, *_: object, **__: object) -> ModeReadout:
        matcher.readout = ModeReadout(0.2, 1.5, 4.0)
        return matcher.readout

    monkeypatch.setattr(calibration, "choose_readout", choose)
    errors = {1.0: 9.0, 1.2: 7.0, 1.5: 5.0, 2.0: 6.0}  # px, of the likeliest temperature times these
    likely = calibrate_temperature(Matcher.load(weights, device="cpu"), load_dataset(cloth_dataset, "test"))
    monkeypatch.setattr(calibration, "measure_mean_error",
                        lambda _, matcher, *__: errors[round(matcher.temperature / likely, 3)])  # fmt: skip
    monkeypatch.setattr(calibration, "LEAST_PAIRS", 8)  # of four images
    how = {"pairs": 12, "points": 4, "progress": False}
    calibrate_unseen(weights, [cloth_dataset], **how)
    matcher, said = Matcher.load(weights, device="cpu"), load_metadata(weights)
    assert matcher.readout == ModeReadout(0.2, 1.5, 4.0) and matcher.calibration.pairs >= 8
    assert matcher.temperature == pytest.approx(1.5 * likely)
    assert json.loads(said["unseen"]) == [load_dataset(cloth_dataset, "test").fingerprint]
    stamp = weights.stat().st_mtime_ns
    calibrate_unseen(weights, [cloth_dataset], **how)
    assert weights.stat().st_mtime_ns == stamp


def test_images_trained_on_are_not_unseen(weights: Path, cloth_dataset: Path) -> None:
    with pytest.raises(ValueError, match="unseen must .*got that"):
        calibrate_unseen(weights, [cloth_dataset], progress=False)


def test_weights_of_other_data_are_not_calibrated(weights: Path, cloth_dataset: Path) -> None:
    tensors, note = read_tensors(weights)
    write_tensors(weights, tensors, note | {"data": "0123"})
    with pytest.raises(ValueError, match="dataset must"):
        calibrate_weights(weights, cloth_dataset, progress=False)


def test_too_few_pairs_calibrate_nothing(weights: Path, cloth_dataset: Path) -> None:
    with pytest.raises(ValueError, match="dataset must .*got 2 images"):
        calibrate_weights(weights, cloth_dataset, progress=False)
    with pytest.raises(ValueError, match="pairs must .*got 5"):
        calibrate_weights(weights, cloth_dataset, pairs=5)
    assert calibrate_modes(make_matcher(), load_dataset(cloth_dataset, "test")) is None


@pytest.mark.parametrize("method", ["pcl", "spcl"])
def test_calibration_picks_a_candidate(cloth_dataset: Path, method: str) -> None:
    torch.manual_seed(0)
    config = dataclasses.replace(CONFIG, method=method, margin=0.6)
    matcher = Matcher(build_network("lite0", 4, pretrained=False), config, modes=4, size=(485, 485), device="cpu")
    bandwidth = calibrate_bandwidth(matcher, load_dataset(cloth_dataset), pairs=2, points=5)
    assert bandwidth == matcher.bandwidth
    assert bandwidth in [pytest.approx(0.6 * b) for b in BANDWIDTHS]


def test_temperature_of_overconfident_and_timid_heatmaps(cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Heatmaps are Gaussians of 20 px around points that are off the truth by a Gaussian of another std."""
    data, truth = load_dataset(cloth_dataset), {}
    config = TrainConfig(input_px=64, descriptor_dim=4, group="identity")
    matcher = Matcher(build_network("lite0", 4, pretrained=False), config, modes=1, size=(485, 485), device="cpu")
    xs, ys = compute_cell_centres((485, 485), (97, 97))

    def compute_heatmaps(first: None, second: int, xy: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
        centre = torch.from_numpy(data.xy[second, choose_points(40, 625)]) + truth["offset"]
        squared = (xs[None, None] - centre[:, :1, None]) ** 2 + (ys[None, :, None] - centre[:, 1:, None]) ** 2
        logits = -squared / (2 * 20.0**2) / matcher.temperature
        return logits.flatten(1).softmax(-1).view(-1, 97, 97)

    monkeypatch.setattr(matcher, "compute_heatmaps", compute_heatmaps)
    monkeypatch.setattr(calibration, "describe", lambda matcher, data, images: {int(i): int(i) for i in images})
    for std, temperature in ((10.0, 0.25), (20.0, 1.0), (40.0, 4.0)):
        truth["offset"] = std * torch.randn(40, 2, generator=torch.Generator().manual_seed(0))
        truth["offset"] *= std / truth["offset"].square().mean().sqrt()
        assert calibrate_temperature(matcher, data, pairs=8) == pytest.approx(temperature, rel=0.05)
        assert matcher.temperature == pytest.approx(temperature, rel=0.05)
