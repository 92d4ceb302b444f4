"""How near an object comes to the demonstration's end: error, overlap, success, and their intervals."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.stats import binomtest

from mmgsd.fold.tasks import fit_motion
from mmgsd.scene.geometry import grid_faces

SIDES_M = {"cloth": 1.0, "rope": 1.6}  # of the cloth, or the rope's length
SUCCESS = 0.05  # of the side: an error below it is a success
CELL_M = 0.005  # of the pictures whose overlap is measured
ROPE_M = 0.02  # how wide a rope is drawn in them
DRAWS = 2000  # of a bootstrap


@dataclass(frozen=True)
class Outcome:
    """How a rollout ended; both are after the best motion in the plane, the error's least over the symmetry group."""

    error_m: float  # mean distance of the material points to the demonstration's
    overlap: float  # intersection over union of the silhouettes from above, in [0, 1]


def measure_outcome(points: np.ndarray, wanted: np.ndarray, permutations: np.ndarray, object: str) -> Outcome:
    """Of material points (P, 3) m beside the demonstration's end (P, 3) m under a group (G, P).

    The rigid motion in the plane is that of least squares; heights count in the error. NaN points give an infinite
    error and no overlap.
    """
    if not np.isfinite(points).all():
        return Outcome(float("inf"), 0.0)
    best, moved = np.inf, points
    for order in permutations:
        turn, shift = fit_motion(points[order], wanted)
        candidate = np.column_stack([points[order][:, :2] @ turn.T + shift, points[order][:, 2]])
        error = float(np.linalg.norm(candidate - wanted, axis=1).mean())
        if error < best:
            best, moved = error, candidate
    return Outcome(best, measure_overlap(moved, wanted, object))


def measure_overlap(points: np.ndarray, wanted: np.ndarray, object: str) -> float:
    """Intersection over union, in [0, 1], of the silhouettes from above of two (P, 3) m."""
    low = np.minimum(points.min(0), wanted.min(0))[:2] - 0.05
    size = np.ceil((np.maximum(points.max(0), wanted.max(0))[:2] + 0.05 - low) / CELL_M).astype(int)
    drawn = [_draw(points_[:, :2], low, size, object) for points_ in (points, wanted)]
    return float((drawn[0] & drawn[1]).sum() / max(1, (drawn[0] | drawn[1]).sum()))


def _draw(xy: np.ndarray, low: np.ndarray, size: np.ndarray, object: str) -> np.ndarray:
    """(h, w) bool, a cell a `CELL_M`: the grid's quads of a cloth, a rope's line."""
    picture, cells = np.zeros(size[::-1], np.uint8), np.round((xy - low) / CELL_M).astype(np.int32)
    if object == "rope":
        cv2.polylines(picture, [cells], False, 1, thickness=max(1, round(ROPE_M / CELL_M)))
        return picture.astype(bool)
    side = round(len(cells) ** 0.5)
    for quad in cells[grid_faces(side, side)]:
        cv2.fillConvexPoly(picture, quad, 1)
    return picture.astype(bool)


def estimate_mean(values: np.ndarray) -> dict[str, float | int | None]:
    """Mean of (N,) values, its 95 % interval by bootstrap ("low", "high"), and their count; None of no value."""
    values = np.asarray(values, float)
    if not len(values):
        return _summarise(0, None, None, None)
    drawn = np.random.default_rng(0).choice(values, (DRAWS, len(values))).mean(1)
    return _summarise(len(values), values.mean(), *np.quantile(drawn, [0.025, 0.975]))


def estimate_share(values: Sequence[bool]) -> dict[str, float | int | None]:
    """As `estimate_mean` of (N,) successes, by Wilson's interval: 0 and 100 % have one that is wider than nothing.

    Wilson, "Probable inference, the law of succession, and statistical inference" (1927).
    """
    if not len(values):
        return _summarise(0, None, None, None)
    result = binomtest(int(np.sum(values)), len(values))
    return _summarise(len(values), result.statistic, *result.proportion_ci(method="wilson"))


def _summarise(count: int, *numbers: float | None) -> dict[str, float | int | None]:
    rounded = [None if number is None else round(float(number), 5) for number in numbers]
    return dict(zip(("mean", "low", "high"), rounded, strict=True)) | {"count": count}


def compare_rollouts(
    rows: Mapping[str, Sequence[float]], others: Mapping[str, Sequence[float]], among: Collection[str]
) -> dict[str, dict[str, float | int | None]]:
    """How much more error and success ``others`` have than ``rows``, paired by rollout: `estimate_mean` of each.

    Both hold (error, success) by a rollout's name; those count that both hold and that are ``among`` these names.
    """
    shared = [name for name in rows if name in others and name in among]
    return {key: estimate_mean([float(others[name][k]) - float(rows[name][k]) for name in shared])
            for k, key in enumerate(("error", "success"))}  # fmt: skip
