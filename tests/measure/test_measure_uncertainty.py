"""Uncertainty: hand values, orders that are known, and samples of the distribution that is claimed."""

from __future__ import annotations

import json
import warnings
from itertools import permutations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mmgsd.measure.uncertainty import (
    LEVELS,
    compute_aurc,
    compute_auroc,
    compute_confidence_error,
    compute_coverage,
    compute_coverage_error,
    compute_reliability,
    compute_risk_coverage,
    recalibrate,
    summarise_uncertainty,
)
from mmgsd.model.calibration import Calibration


def make_queries(**columns: object) -> pd.DataFrame:
    """Four queries seen, and a fifth with a hidden source that must not count."""
    table = {
        "visible": [True] * 4 + [False], "n": 2, "rmse_px": [1.0, 2.0, 3.0, 6.0, 1e6], "hidden": [0, 1, 1, 2, 0],
        "entropy": [1.0, 3.0, 2.0, 4.0, 0.0], "outside": [0.1, 0.3, 0.05, 0.9, 1.0],
        "mahalanobis2": [np.array(d) for d in ([0.1, 5.0], [1.0, 9.0], [1.3, 1.5], [0.5, 4.0], [0.0, 0.0])],
    }  # fmt: skip
    return pd.DataFrame(table | columns)


def test_risk_coverage_by_hand() -> None:
    coverage, risk = compute_risk_coverage([6.0, 1.0, 2.0, 3.0], [0.4, 0.1, 0.3, 0.2])
    np.testing.assert_allclose(coverage, [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(risk, [1.0, 2.0, 2.0, 3.0])
    assert compute_aurc([6.0, 1.0, 2.0, 3.0], [0.4, 0.1, 0.3, 0.2]) == pytest.approx(2.0)


def test_tied_scores_share_their_mean_error() -> None:
    np.testing.assert_allclose(compute_risk_coverage([4.0, 0.0, 2.0], [1.0, 1.0, 0.0])[1], [2.0, 2.0, 2.0])
    assert compute_aurc([1.0, 5.0, 9.0], [7.0, 7.0, 7.0]) == pytest.approx(5.0)
    areas = {compute_aurc(error, [7.0] * 3) for error in permutations([0.1, 0.2, 0.3])}
    assert len(areas) == 1  # to the last bit: (0.1 + 0.2) + 0.3 is not 0.1 + (0.2 + 0.3)


@given(st.lists(st.tuples(st.floats(0, 500), st.integers(0, 3)), min_size=1), st.randoms(use_true_random=False))
def test_order_of_rows_does_not_matter(rows: list[tuple[float, int]], random: object) -> None:
    one = compute_risk_coverage(*np.array(rows).T)[1]
    random.shuffle(rows)
    np.testing.assert_array_equal(compute_risk_coverage(*np.array(rows).T)[1], one)


def test_oracle_is_best_and_random_is_the_mean(rng: np.random.Generator) -> None:
    error = rng.exponential(20, 4000)
    oracle, worst, random = (compute_aurc(error, score) for score in (error, -error, rng.random(4000)))
    assert random == pytest.approx(error.mean(), rel=0.05)
    assert oracle < 0.5 * random and worst > 1.5 * random


def test_coverage_by_hand() -> None:
    radius2 = -2 * np.log([0.5, 0.1])  # chi² of two degrees of freedom: 1 - exp(-d² / 2) within d²
    np.testing.assert_allclose(compute_coverage(np.array([1.38, 1.39, 4.6, 4.7]), (0.5, 0.9)), [0.25, 0.75])
    np.testing.assert_allclose(compute_coverage(np.repeat(radius2, 2) - 1e-9, (0.5, 0.9)), [0.5, 1.0])
    np.testing.assert_allclose(compute_coverage(np.array([0.0, np.nan, np.inf]), (0.9,)), [1 / 3])


def test_gaussian_samples_are_calibrated(rng: np.random.Generator) -> None:
    covariance = np.array([[9.0, 4.0], [4.0, 5.0]])
    offsets = rng.multivariate_normal([0, 0], covariance, 20000)
    distances = np.einsum("mi,ij,mj->m", offsets, np.linalg.inv(covariance), offsets)
    assert compute_coverage_error(distances) < 0.01
    assert compute_coverage(distances, (0.9,)) == pytest.approx([0.9], abs=0.01)
    assert compute_coverage_error(distances * 4) > 0.2  # ellipses half as wide


def test_coverage_error_is_the_mean_distance_from_expectation() -> None:
    assert len(LEVELS) == 19 and LEVELS[0] == 0.05 and LEVELS[-1] == 0.95
    assert compute_coverage_error(np.zeros(3)) == pytest.approx(0.5)  # 1 - mean of the levels
    assert compute_coverage_error(np.zeros(3), (0.2, 0.9)) == pytest.approx(0.45)


def test_coverage_without_distances_is_nan() -> None:
    assert np.isnan(compute_coverage(np.full(3, np.nan))).all() and np.isnan(compute_coverage_error(np.empty(0)))


def test_auroc_by_hand() -> None:
    score, positive = [0.9, 0.5, 0.5, 0.1], [True, False, True, False]
    assert compute_auroc(score, positive) == pytest.approx(3.5 / 4)  # one of four pairs is tied
    assert compute_auroc(-np.array(score), positive) == pytest.approx(0.5 / 4)


@pytest.mark.parametrize("positive", [[True, True], [False, False], []])
def test_auroc_of_one_class_is_nan(positive: list[bool]) -> None:
    assert np.isnan(compute_auroc(np.arange(len(positive)), positive))


def test_summary_by_hand() -> None:
    assert summarise_uncertainty(make_queries()) == {
        "spearman": 0.8,
        "aurc": 2.0,  # of errors in the order 1, 3, 2, 6: mean of 1, 2, 2, 3
        "aurc_oracle": 1.875,  # mean of 1, 1.5, 2, 3
        "aurc_random": 3.0,
        "aurc_share": 0.1111,
        "coverage@50%": 0.5,  # 0.1, 1, 1.3 and 0.5 of eight are below 1.386
        "coverage@90%": 0.75,
        "coverage@95%": 0.875,
        "ece": 0.0737,  # 1.4 / 19, summed over the levels
        "auroc_occluded": 0.6667,  # 0.3, 0.05, 0.9 against 0.1
        "auroc_absent": 1.0,
        "queries": 4,
    }  # fmt: skip


def test_random_entropy_has_a_share_near_one(rng: np.random.Generator) -> None:
    columns = {"visible": True, "n": 1, "hidden": 0, "outside": 0.0, "rmse_px": rng.exponential(9, 4000)}
    table = pd.DataFrame(columns).assign(mahalanobis2=[np.ones(1)] * 4000)
    assert summarise_uncertainty(table.assign(entropy=rng.random(4000)))["aurc_share"] == pytest.approx(1, abs=0.1)
    assert summarise_uncertainty(table.assign(entropy=table.rmse_px))["aurc_share"] == 0


def test_what_is_undefined_is_null_in_json_and_does_not_warn() -> None:
    nothing = [np.full(2, np.nan)] * 5
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chance = summarise_uncertainty(make_queries(entropy=5.0, outside=np.nan, mahalanobis2=nothing))
        exact = summarise_uncertainty(make_queries(rmse_px=2.0))
        empty = summarise_uncertainty(make_queries(visible=False))
        unknown = summarise_uncertainty(make_queries(entropy=np.nan))
    for summary in (chance, exact, empty, unknown):
        assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    defined = {name: value for name, value in chance.items() if value is not None}
    assert defined == {"aurc": 3.0, "aurc_oracle": 1.875, "aurc_random": 3.0, "aurc_share": 1.0, "queries": 4}
    assert exact["aurc_share"] is None and exact["spearman"] is None and exact["aurc"] == 2
    assert {value for name, value in empty.items() if name != "queries"} == {None}
    assert unknown["aurc"] is None and unknown["aurc_oracle"] == 1.875


def test_reliability_counts_by_bins_and_doubts_by_pairs() -> None:
    confidence, near = np.array([0.05, 0.15, 0.15, 0.95, 1.0]), np.array([0, 1, 0, 1, 1])
    rows = compute_reliability(confidence, near, np.array([0, 1, 2, 1, 2]))
    assert rows.index.tolist() == [0, 1, 9]
    np.testing.assert_allclose(rows.expected, [0.05, 0.15, 0.975])
    np.testing.assert_allclose(rows.observed, [0, 0.5, 1])
    np.testing.assert_allclose(rows.margin, [0, 1.96 * np.sqrt(0.5) / 2, 0])
    doubled = compute_reliability(np.repeat(confidence, 2), np.repeat(near, 2), np.repeat([0, 1, 2, 1, 2], 2))
    np.testing.assert_allclose(doubled.margin, rows.margin)  # more of the same pairs tells no more


def test_confidence_error_by_hand() -> None:
    modes = pd.DataFrame({"pair": [0, 1], "entropy": 0.0, "distance_px": [1.0, 99.0], "spread_px": 1e-3, "share": 1.0})
    assert compute_confidence_error(modes, radii_px=[5.0]) == pytest.approx(0.5)


def test_old_tables_cannot_be_recalibrated() -> None:
    known = Calibration(tuple(range(20)), tuple(range(20)), (1.0, 0.0, 0.0), 40)
    with pytest.raises(ValueError, match="queries must"):
        recalibrate(make_queries(), known)
    assert "ece_confidence" not in summarise_uncertainty(make_queries())
