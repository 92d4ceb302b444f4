"""Tracks are counted as TAP-Vid counts them, by hand-made ones of which the counts are known."""

from __future__ import annotations

import numpy as np
import pytest

from mmgsd.measure.tracking import Truth, average_tracks, measure_track

SIZE = (512, 256)  # two px of a frame's width are one of the resized


def make_truth(frames: int = 3, points: int = 4) -> Truth:
    xy = np.zeros((frames, points, 2))
    return Truth(xy, np.ones((frames, points), bool), xy[:, None] + (200, 0), SIZE)


def test_a_perfect_track_has_all_points() -> None:
    truth = make_truth()
    measured = measure_track(truth.xy, truth.visible, truth)
    assert (measured["delta"], measured["jaccard"], measured["occlusion"], measured["swaps"]) == (1, 1, 1, 0)


def test_distances_are_of_the_resized_frame_and_thresholds_hold_their_border() -> None:
    truth = make_truth()
    xy = truth.xy + np.array([[8.0, 0], [8.1, 0], [0, 4], [0, 4.1]])  # 4, 4.05, 4 and 4.1 px resized
    measured = measure_track(xy, truth.visible, truth)
    assert [measured[f"delta@{t}px"] for t in (1, 2, 4, 8, 16)] == [0, 0, 0.5, 1, 1]
    assert measured["delta"] == pytest.approx(0.5) and measured["jaccard"] == pytest.approx((2 / 6 + 2) / 5)


def test_the_first_frame_and_hidden_points_do_not_count() -> None:
    truth = make_truth()
    truth.visible[:, 1] = False
    xy = truth.xy.copy()
    xy[0], xy[:, 1] = 500, 500
    assert measure_track(xy, truth.visible, truth)["delta"] == 1
    assert measure_track(xy, np.ones((3, 4), bool), truth)["occlusion"] == 0.75


def test_a_point_that_takes_its_like_ones_place_is_swapped() -> None:
    truth = make_truth()
    xy = truth.xy.copy()
    xy[1:, 0] += (101, 0)
    xy[1, 1] += (99, 0)
    xy[2, 2] = np.nan
    measured = measure_track(xy, np.isfinite(xy).all(-1), truth)
    assert measured["swaps"] == 2 / 8 and measured["delta@1px"] == 4 / 8
    assert measured["taken"] == 0  # half-way to the like point is at neither
    xy[1:, 0] += (70, 0)
    assert measure_track(xy, np.isfinite(xy).all(-1), truth)["taken"] == 2 / 8


def test_what_has_no_like_points_cannot_swap() -> None:
    truth = make_truth()
    alone = Truth(truth.xy, truth.visible, truth.likes[:, :0], SIZE)
    assert np.isnan(measure_track(truth.xy + 100, truth.visible, alone)["swaps"])


def test_points_that_a_fold_lays_upon_their_like_ones_are_no_swaps() -> None:
    truth = make_truth()
    truth.likes[2] = truth.xy[2] + (20, 0)  # 10 px resized
    xy = truth.xy + (15, 0)
    xy[1, 0] += (100, 0)
    assert measure_track(xy, truth.visible, truth)["swaps"] == 1 / 4  # the last frame does not count
    truth.likes[:] = truth.xy[:, None]
    assert np.isnan(measure_track(xy, truth.visible, truth)["swaps"])


def test_sequences_weigh_alike_and_what_one_has_not_does_not_count() -> None:
    assert average_tracks([{"delta": 0.5}, {"delta": 1.0}, {"delta": float("nan")}]) == {"delta": 0.75}
