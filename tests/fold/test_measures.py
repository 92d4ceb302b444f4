"""What counts of a rollout: error and overlap after the best motion, whatever symmetric way it was folded."""

from __future__ import annotations

import numpy as np
import pytest

from mmgsd.fold.measures import compare_rollouts, estimate_mean, estimate_share, measure_outcome, measure_overlap
from mmgsd.symmetry import grid_group, line_group

ROW, COLUMN = np.divmod(np.arange(625), 25)
FLAT = np.stack([COLUMN / 24 - 0.5, 0.5 - ROW / 24, np.zeros(625)], 1)
HALF = FLAT.copy()
HALF[:, 1] = -np.abs(HALF[:, 1])  # the first rows on the last
C4 = grid_group("c4").permutations
ROPE = np.stack([np.linspace(-0.8, 0.8, 625), np.zeros(625), np.zeros(625)], 1)


def move(points: np.ndarray, angle: float, shift: tuple[float, float]) -> np.ndarray:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([points[:, :2] @ turn.T + shift, points[:, 2]])


def test_where_it_lies_and_how_it_is_turned_does_not_count() -> None:
    found = measure_outcome(move(HALF, 0.8, (0.3, -2.0)), HALF, C4, "cloth")
    assert found.error_m == pytest.approx(0, abs=1e-6) and found.overlap > 0.97


@pytest.mark.parametrize("quarter", range(4))
def test_any_symmetric_edge_may_be_the_one_that_was_folded(quarter: int) -> None:
    folded = HALF[C4[quarter]]
    assert measure_outcome(folded, HALF, C4, "cloth").error_m == pytest.approx(0, abs=1e-6)


def test_a_cloth_that_stays_flat_is_far_from_folded_and_overlaps_by_half() -> None:
    found = measure_outcome(FLAT, HALF, C4, "cloth")
    assert 0.2 < found.error_m < 0.3 and found.overlap == pytest.approx(0.5, abs=0.04)


def test_a_rope_turned_end_for_end_is_the_same() -> None:
    found = measure_outcome(ROPE[::-1] + (1, 2, 0), ROPE, line_group("c2").permutations, "rope")
    assert found.error_m == pytest.approx(0, abs=1e-9) and found.overlap == pytest.approx(1, abs=0.05)


def test_what_physics_spoilt_is_infinitely_far() -> None:
    found = measure_outcome(FLAT * np.nan, HALF, C4, "cloth")
    assert found.error_m == np.inf and found.overlap == 0


def test_overlap_is_of_areas() -> None:
    assert measure_overlap(FLAT + (0.5, 0, 0), FLAT, "cloth") == pytest.approx(1 / 3, abs=0.02)


def test_intervals_hold_the_mean_and_shrink_with_more(rng: np.random.Generator) -> None:
    few, many = (estimate_mean(rng.normal(1, 1, count)) for count in (20, 2000))
    assert few["low"] < few["mean"] < few["high"]
    assert many["high"] - many["low"] < 0.2 * (few["high"] - few["low"]) + 0.1
    assert estimate_mean(np.zeros(0)) == {"mean": None, "low": None, "high": None, "count": 0}


@pytest.mark.parametrize(("found", "low", "high"), [(0, 0.0, 0.0653), (55, 0.9347, 1.0), (49, 0.7817, 0.9493)])
def test_none_and_all_have_an_interval(found: int, low: float, high: float) -> None:
    said = estimate_share([True] * found + [False] * (55 - found))
    assert (said["low"], said["high"]) == pytest.approx((low, high), abs=1e-3) and said["count"] == 55
    assert estimate_share([])["mean"] is None


def test_a_comparison_is_of_the_same_rollouts() -> None:
    ours = {"a": (0.01, True), "b": (0.02, True), "c": (0.03, True), "d": (0.5, False)}
    others = {"a": (0.21, False), "b": (0.02, True), "d": (0.9, False), "e": (0.9, False)}
    found = compare_rollouts(ours, others, {"a", "b", "c", "e"})
    assert found["error"]["mean"] == pytest.approx(0.1) and found["error"]["count"] == 2
    assert found["success"]["mean"] == -0.5
    assert found["error"]["low"] == 0 and found["error"]["high"] == pytest.approx(0.2)
