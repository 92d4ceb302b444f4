"""What modes promise: inverse to one another, calibrated or not, and the same for a picture of any size."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch
from heatmaps import CELLS, CORNERS, SIZE, draw_mixture

from mmgsd.dataset import load_dataset
from mmgsd.match.heatmap import make_match
from mmgsd.match.match import Match
from mmgsd.match.matcher import load
from mmgsd.model.calibration import LEVELS, Calibration, Gaussian, Modes, parse_calibration
from mmgsd.model.network import compute_cell_centres
from mmgsd.paths import find_root

TABLE = tuple(float(level / (1 - level)) for level in LEVELS)
KNOWN = Calibration(ellipse=TABLE, radius=TABLE, powers=(0.9, -0.2, 0.3), pairs=100)
PROMISES = pytest.mark.parametrize("promise", [Gaussian(), KNOWN], ids=["gaussian", "calibrated"])
MODES = Modes(np.array([4.0, 10.0, 30.0]), np.array([1.0, 0.99, 1.0]), np.array([10.0, 40.0, 60.0]))


@PROMISES
@pytest.mark.parametrize("level", [0.05, 0.5, 0.9, 0.95])
def test_a_radius_has_the_confidence_it_was_asked_for(promise: Gaussian, level: float) -> None:
    found = [promise.compute_confidence(r, MODES)[k] for k, r in enumerate(promise.compute_radius(level, MODES))]
    np.testing.assert_allclose(found, level, rtol=1e-4)


@PROMISES
def test_more_is_promised_further_out(promise: Gaussian) -> None:
    radii = np.stack([promise.compute_radius(level, MODES) for level in (0.1, 0.33, 0.6, 0.9)])
    distances = np.stack([promise.compute_distance2(level, MODES) for level in (0.1, 0.33, 0.6, 0.9)])
    confidences = np.stack([promise.compute_confidence(radius, MODES) for radius in (1, 5, 20, 80)])
    for values in (radii, distances, confidences):
        assert (np.diff(values, axis=0) > 0).all()


def test_levels_are_read_back_from_distances() -> None:
    for level in (0.03, 0.5, 0.93):
        np.testing.assert_allclose(KNOWN.compute_level(KNOWN.compute_distance2(level, MODES), MODES), level)
    assert (KNOWN.compute_level(np.full(3, 1e9), MODES) == 1).all()


def test_between_two_levels_the_radius_is_the_higher_ones() -> None:
    np.testing.assert_array_equal(KNOWN.compute_radius(0.86, MODES), KNOWN.compute_radius(0.9, MODES))


def test_too_few_pairs_promise_no_bound() -> None:
    few = dataclasses.replace(KNOWN, radius=(*TABLE[:-2], np.inf, np.inf))
    assert np.isinf(few.compute_radius(0.95, MODES)).all() and np.isfinite(few.compute_radius(0.9, MODES)).all()
    assert np.isinf(KNOWN.compute_radius(0.999, MODES)).all()
    assert (few.compute_confidence(1e9, MODES) == 0.9).all()


def test_a_calibration_is_kept_as_json() -> None:
    few = dataclasses.replace(KNOWN, radius=(*TABLE[:-1], np.inf), ece_ellipse=0.02)
    again = parse_calibration(few.to_json())
    np.testing.assert_allclose([*again.ellipse, *again.radius], [*few.ellipse, *few.radius], rtol=1e-5)
    assert (again.powers, again.pairs, again.ece_ellipse) == (few.powers, 100, 0.02) and np.isnan(again.ece_confidence)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("ellipse", TABLE[1:]), ("radius", TABLE[::-1]), ("radius", [-1.0, *TABLE[1:]]), ("radius", [None] * 20),
        ("powers", [1.0, 0.0]), ("powers", [1.0, None, 0.0]), ("powers", ["1", 0.0, 0.0]),
    ],
)  # fmt: skip
def test_what_is_no_calibration(name: str, values: list) -> None:
    with pytest.raises(ValueError, match=f"^{name} must .*got"):
        parse_calibration(json.dumps(json.loads(KNOWN.to_json()) | {name: values}))


def answer(scale: float = 1.0, calibration: Calibration | None = None) -> Match:
    blank, centres = np.zeros((485, 485, 3), np.uint8), compute_cell_centres(SIZE, (CELLS, CELLS))
    cells = torch.cat([draw_mixture(CORNERS, 12.0), draw_mixture(CORNERS, 24.0)])
    match = make_match(blank, blank, np.zeros((2, 2), np.float32), cells, centres, 4, scale=scale)
    return dataclasses.replace(match, calibration=calibration)


@pytest.mark.parametrize("calibration", [None, KNOWN])
def test_an_answer_in_other_pixels_promises_the_same(calibration: Calibration | None) -> None:
    """The same px of a picture, said to be twice as large as those of the training."""
    match = answer(2.0, calibration)
    halved = dataclasses.replace(match, modes=match.modes / 2, covariances=match.covariances / 4, scale=1.0)
    np.testing.assert_allclose(match.confidence(), halved.confidence())
    np.testing.assert_allclose(match.confidence(radius_px=30), halved.confidence(radius_px=15))
    np.testing.assert_allclose(match.radius_px(level=0.8), 2 * halved.radius_px(level=0.8))
    np.testing.assert_allclose(match.ellipses(level=0.8), 4 * halved.ellipses(level=0.8))
    np.testing.assert_allclose(match.entropy, answer().entropy - 2 * np.log(2), rtol=1e-5)


def test_uncalibrated_ellipses_are_those_of_a_gaussian() -> None:
    match = answer()
    np.testing.assert_allclose(match.ellipses(level=0.95), 5.991 * match.covariances, rtol=1e-3)
    assert "not calibrated" in repr(match) and "not calibrated" not in repr(answer(1.0, KNOWN))


def test_some_queries_keep_the_calibration() -> None:
    match = answer(1.5, KNOWN)
    np.testing.assert_array_equal(match[1].radius_px(), match.radius_px()[1:])
    assert match[[0]].calibration is KNOWN and match[0].scale == 1.5


@pytest.mark.parametrize("level", [0, 1, 1.5, np.nan, "0.9", True])
@pytest.mark.parametrize("ask", [Match.radius_px, Match.ellipses])
def test_what_is_no_level(ask: object, level: object) -> None:
    with pytest.raises(ValueError, match="level must"):
        ask(answer(), level=level)


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_a_resized_picture_has_the_same_entropy_and_confidence(factor: float) -> None:
    data, matcher = load_dataset(find_root() / "data" / "sample" / "cloth", "test"), load("cloth", device="cpu")
    images = [data.load_image(index) for index in (0, 1)]
    xy = data.xy[0][data.visible[0]][[40, 200, 300]]
    resized = cv2.resize(images[1], None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    own, other = (matcher.match(images[0], image, xy) for image in (images[1], resized))
    assert other.scale == pytest.approx(factor, rel=0.01)
    np.testing.assert_allclose(other.entropy, own.entropy, atol=0.25)
    np.testing.assert_allclose(np.sort(other.confidence(), 1), np.sort(own.confidence(), 1), atol=0.1)
    np.testing.assert_allclose(np.sort(other.radius_px(level=0.5), 1) / factor,
                               np.sort(own.radius_px(level=0.5), 1), rtol=0.25)  # fmt: skip
