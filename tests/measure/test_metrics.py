"""Metrics: hand values, and the assignment's independence of the modes' order."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mmgsd.measure.metrics import (
    BIN_PX,
    aggregate,
    compute_mahalanobis2,
    compute_mode_errors,
    compute_query_errors,
    compute_swaps,
    summarise_errors,
)

TRUE = np.array([[[0.0, 0.0], [100.0, 0.0]]])
MODES = np.array([[[100.0, 8.0], [3.0, 4.0]]])  # 8 px from the second, 5 px from the first
COVARIANCES = np.array([[np.diag([16.0, 64.0]), np.diag([9.0, 4.0])]])  # px²


@st.composite
def modes_and_true(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    pixels = st.floats(0, 500, width=32)
    shape = (1, draw(st.integers(1, 6)), 2)
    return draw(arrays(float, shape, elements=pixels)), draw(arrays(float, shape, elements=pixels))


def least_total(modes: np.ndarray, true: np.ndarray) -> float:
    orders = permutations(range(len(modes)))
    return min(np.square(modes[list(order)] - true).sum() for order in orders)


def test_errors_by_hand() -> None:
    np.testing.assert_allclose(compute_mode_errors(MODES, TRUE), [[5.0, 8.0]])


def test_query_metrics_by_hand() -> None:
    metrics = compute_query_errors(MODES, COVARIANCES, TRUE)
    assert {name: float(value[0]) for name, value in metrics.items()} == pytest.approx({
        "rmse_px": np.sqrt((25 + 64) / 2), "nearest_px": 8.0, "best_px": 5.0,
        "swapped": 0.0, "pck@5px": 0.5, "pck@10px": 1.0, "pck@20px": 1.0,
    })  # fmt: skip


def test_errors_of_what_is_seen_leave_hidden_matches_out() -> None:
    seen = np.array([[[True, False]], [[False, True]], [[False, False]], [[True, True]]])
    errors = [compute_query_errors(MODES, COVARIANCES, TRUE, one)["rmse_seen_px"][0] for one in seen]
    assert errors[:2] == pytest.approx([5.0, 8.0]) and np.isnan(errors[2])
    assert errors[3] == pytest.approx(compute_query_errors(MODES, COVARIANCES, TRUE)["rmse_px"][0])
    columns = {name: 1.0 for name in ("nearest_px", "best_px", "swapped", "pck@5px", "pck@10px", "pck@20px")}
    queries = pd.DataFrame({"rmse_px": [3.0, 4.0], "rmse_seen_px": [2.0, np.nan], **columns})
    assert aggregate(queries)["rmse_seen"] == 2.0


def test_without_covariances_the_first_mode_is_the_best() -> None:
    metrics = compute_query_errors(MODES, np.full_like(COVARIANCES, np.nan), TRUE)
    assert metrics["best_px"][0] == metrics["nearest_px"][0] == 8.0


def test_mahalanobis_distances_by_hand() -> None:
    expected = [[3**2 / 9 + 4**2 / 4, 8**2 / 64]]  # in the order of the true modes
    np.testing.assert_allclose(compute_mahalanobis2(MODES, COVARIANCES, TRUE), expected)


def test_a_turned_ellipse() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    covariance = turn @ np.diag([100.0, 1.0]) @ turn.T
    along, across = ([[turn[:, k] * 10]] for k in (0, 1))
    mode = np.zeros((1, 1, 2)), covariance[None, None]
    distances = [compute_mahalanobis2(*mode, np.array(true)) for true in (along, across)]
    np.testing.assert_allclose(np.ravel(distances), [1, 100])


def test_nearest_is_of_the_most_probable_mode() -> None:
    metrics = compute_query_errors(MODES[:, ::-1], COVARIANCES[:, ::-1], TRUE)
    assert metrics["nearest_px"][0] == pytest.approx(5.0)


def test_two_modes_on_one_match_leave_the_other_missed() -> None:
    errors = compute_mode_errors(np.array([[[0.0, 0.0], [0.0, 1.0]]]), TRUE)
    assert sorted(errors[0]) == pytest.approx([0.0, np.hypot(100, 1)])


def test_swapped_are_modes_nearer_to_another_match() -> None:
    true = np.array([[[0.0, 0.0], [100.0, 0.0]]])
    both_left = np.array([[[2.0, 0.0], [30.0, 0.0]]])  # the second has to stand for the right match, 70 px away
    np.testing.assert_array_equal(compute_swaps(both_left, true), [[False, True]])
    np.testing.assert_array_equal(compute_swaps(true[:, ::-1], true), [[False, False]])


@given(modes_and_true(), st.randoms(use_true_random=False))
def test_order_of_modes_does_not_matter(pair: tuple[np.ndarray, np.ndarray], random: object) -> None:
    modes, true = pair
    order = list(range(modes.shape[1]))
    random.shuffle(order)
    one, two = (np.square(compute_mode_errors(m, true)).sum() for m in (modes, modes[:, order]))
    assert one == pytest.approx(two, rel=1e-9, abs=1e-9)


@given(modes_and_true())
def test_assignment_has_the_least_total_squared_error(pair: tuple[np.ndarray, np.ndarray]) -> None:
    modes, true = pair
    found = np.square(compute_mode_errors(modes, true)).sum()
    assert found == pytest.approx(least_total(modes[0], true[0]), rel=1e-9, abs=1e-9)


def test_eight_modes_beside_brute_force(rng: np.random.Generator) -> None:
    modes, true = rng.uniform(0, 480, (2, 1, 8, 2))
    found = np.square(compute_mode_errors(modes, true)).sum()
    assert found == pytest.approx(least_total(modes[0], true[0]))


@pytest.mark.parametrize("n", [4, 8])
def test_no_query_no_error(n: int) -> None:
    assert compute_mode_errors(np.zeros((0, n, 2)), np.zeros((0, n, 2))).shape == (0, n)


def test_aggregate_by_hand() -> None:
    columns = {"nearest_px": [1.0, 1.0, 4.0], "best_px": [2.0, 0.0, 1.0], "swapped": [0.0, 0.5, 1.0],
               "pck@5px": [1.0, 0.5, 0.0], "pck@10px": 1.0, "pck@20px": 1.0}  # fmt: skip
    summary = aggregate(pd.DataFrame({"rmse_px": [3.0, 4.0, 12.0], **columns}))
    assert summary == {
        "rmse_mean": 6.3333, "rmse_pooled": 7.5056, "median": 4.0, "nearest_mean": 2.0,
        "best_mean": 1.0, "swap_rate": 0.5,
        "pck@5px": 0.5, "pck@10px": 1.0, "pck@20px": 1.0, "queries": 3,
    }  # fmt: skip


def test_a_summary_counts_visible_sources_alone() -> None:
    point, visible = [3, 3, 3, 600], [True, True, False, True]
    errors = [0.2, 2 * BIN_PX, 1e6, 2.5 * BIN_PX]
    summary = summarise_errors(pd.DataFrame({"point": point, "visible": visible, "rmse_px": errors}))
    assert summary.histogram.tolist() == [1, 0, 2]
    assert {int(p): int(n) for p, n in enumerate(summary.asked) if n} == {3: 2, 600: 1}
    assert summary.mean_px[[3, 600]].tolist() == pytest.approx([(0.2 + 2 * BIN_PX) / 2, 2.5 * BIN_PX])
    assert np.flatnonzero(np.isfinite(summary.mean_px)).tolist() == [3, 600] and summary.asked.shape == (625,)


def test_a_summary_of_nothing_seen_counts_nothing() -> None:
    hidden = pd.DataFrame({"point": [3], "visible": [False], "rmse_px": [1.0]})
    summary = summarise_errors(hidden)
    assert summary.asked.sum() == summary.histogram.sum() == 0 and np.isnan(summary.mean_px).all()
