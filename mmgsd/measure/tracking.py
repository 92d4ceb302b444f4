"""How well points are followed through frames, as TAP-Vid counts it, and whether they stay themselves.

Doersch et al., "TAP-Vid: a benchmark for tracking any point in a video" (NeurIPS 2022): distances are of frames resized
to 256 × 256 px, the frame in which a point was asked for does not count, and positions count where a point is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

RESIZED_PX = 256
THRESHOLDS_PX = (1, 2, 4, 8, 16)  # of a resized frame
APART_PX = THRESHOLDS_PX[-1]  # points nearer to each other cannot be told apart by where an answer lies


@dataclass(frozen=True, eq=False)
class Truth:
    """Where S points truly are in T frames of ``size`` (width, height) px, and where the points that look like them."""

    xy: np.ndarray  # (T, S, 2) px
    visible: np.ndarray  # (T, S) bool
    likes: np.ndarray  # (T, G, S, 2) px, the other members of each point's orbit; G may be 0
    size: tuple[int, int]


def measure_track(xy: np.ndarray, visible: np.ndarray, truth: Truth) -> dict[str, float]:
    """Shares of points in frames after the first one, of positions (T, S, 2) px and ``visible`` (T, S) bool.

    ``delta@1px`` … and their mean ``delta``, positions as near as that; ``swaps``, positions nearer to a like point's
    truth than to their own; ``taken``, positions within `APART_PX` of a like point's truth and not of their own;
    ``occlusion``, points of which it is rightly said whether they are seen; ``jaccard``, the mean over thresholds of
    points rightly said to be there, of these and all errors. A position that is NaN is far from all. For swaps count
    like points more than `APART_PX` apart, of points that have some: a fold lays like ones upon each other.
    """
    scale = RESIZED_PX / np.array(truth.size)
    own = _measure_distance(xy, truth.xy, scale)[1:]  # (T - 1, S)
    separated = _measure_distance(truth.xy[:, None], truth.likes, scale)[1:] > APART_PX  # (T - 1, G, S)
    like = _measure_distance(xy[:, None], truth.likes, scale)[1:]
    swapped, could = (separated & (like < own[:, None])).any(1), separated.any(1)
    taken = (separated & (like <= APART_PX) & (own > APART_PX)[:, None]).any(1)
    seen, predicted = truth.visible[1:], np.asarray(visible, bool)[1:]
    near = own[..., None] <= THRESHOLDS_PX  # (T - 1, S, thresholds)
    right = (near & (seen & predicted)[..., None]).sum((0, 1))
    wrong = (predicted[..., None] & ~(near & seen[..., None])).sum((0, 1))
    deltas = near[seen].mean(0) if seen.any() else np.full(len(THRESHOLDS_PX), np.nan)
    return {
        **{f"delta@{t}px": float(delta) for t, delta in zip(THRESHOLDS_PX, deltas, strict=True)},
        "delta": float(deltas.mean()),
        "swaps": _average(swapped[seen & could]),
        "taken": _average(taken[seen & could]),
        "occlusion": float((seen == predicted).mean()),
        "jaccard": float(np.mean(right / np.maximum(seen.sum() + wrong, 1))),
    }


def _average(chosen: np.ndarray) -> float:
    return float(chosen.mean()) if len(chosen) else float("nan")


def _measure_distance(xy: np.ndarray, true: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.nan_to_num(np.linalg.norm((xy - true) * scale, axis=-1), nan=np.inf)


def average_tracks(measured: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean of each measure over sequences, as TAP-Vid averages; measures that a sequence has not do not count."""
    return {name: round(float(np.nanmean([one[name] for one in measured])), 4) for name in measured[0]}
