"""Errors of predicted modes, one row a query; aggregation is separate."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from mmgsd.config import N_POINTS
from mmgsd.model.calibration import compute_share

PCK_PX = (5, 10, 20)
LISTS = ("mahalanobis2", "distance_px", "spread_px", "share")  # columns with n numbers a query
BIN_PX = 0.5  # width of the bins of an error's histogram


@dataclass(frozen=True)
class ErrorSummary:
    """A method's ``rmse_px`` over the queries with a visible source: by material point, and their distribution."""

    asked: np.ndarray  # (625,) queries of each material point
    mean_px: np.ndarray  # (625,) mean error of each, NaN where none was asked
    histogram: np.ndarray  # (K,) errors in each bin of BIN_PX from 0


def assign_modes(modes: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Index (S, n) of the predicted mode that each true one is paired with: the least total squared error.

    ``modes`` and ``true`` (S, n, 2) px.
    """
    squared = np.square(true[:, :, None] - modes[:, None]).sum(-1)  # (S, true, predicted)
    n = true.shape[1]
    if n <= 4:
        orders = np.array(list(permutations(range(n))))  # (n!, n)
        costs = squared[:, np.arange(n), orders].sum(-1)  # (S, n!)
        return orders[costs.argmin(1)]
    return np.array([linear_sum_assignment(cost)[1] for cost in squared], dtype=int).reshape(-1, n)


def compute_mode_errors(modes: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distances in px (S, n) of true modes to the predicted ones paired with them, both (S, n, 2) px."""
    return np.linalg.norm(true - _pair(modes, true), axis=-1)


def compute_swaps(modes: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Which predicted modes lie nearer to another true one than to their own, (S, n) bool in the true ones' order."""
    distances = np.linalg.norm(true[:, None] - _pair(modes, true)[:, :, None], axis=-1)  # (S, predicted, true)
    return distances.min(-1) < np.diagonal(distances, axis1=1, axis2=2)


def _pair(modes: np.ndarray, true: np.ndarray) -> np.ndarray:
    """The predicted modes (S, n, 2) in the order of the true ones that they are paired with."""
    return np.take_along_axis(modes, assign_modes(modes, true)[..., None], 1)


def compute_mahalanobis2(modes: np.ndarray, covariances: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (S, n) of true modes under the predicted ones paired with them.

    ``modes`` and ``true`` (S, n, 2) px, ``covariances`` (S, n, 2, 2) px²; NaN where these are.
    """
    assigned = assign_modes(modes, true)
    x, y = np.moveaxis(true - np.take_along_axis(modes, assigned[..., None], 1), -1, 0)
    paired = np.take_along_axis(covariances, assigned[..., None, None], 1)
    a, b, c = paired[..., 0, 0], paired[..., 0, 1], paired[..., 1, 1]  # by hand: NumPy would start threads for 2 x 2
    return (c * x * x - 2 * b * x * y + a * y * y) / (a * c - b * b)


def compute_mode_lists(
    modes: np.ndarray, covariances: np.ndarray, weights: np.ndarray, true: np.ndarray
) -> dict[str, np.ndarray]:
    """What a calibration needs of (S, n, 2) modes, most probable first: the columns `LISTS`, each value (S, n).

    ``mahalanobis2`` from each mode of the true match paired with it, ``distance_px`` of the nearest one, ``spread_px``
    and ``share`` of an equal mode's weight.
    """
    paired = np.take_along_axis(compute_mahalanobis2(modes, covariances, true), assign_modes(modes, true).argsort(1), 1)
    distances = np.linalg.norm(true[:, None] - modes[:, :, None], axis=-1)  # (S, predicted, true)
    spread = np.sqrt(np.trace(covariances, axis1=-2, axis2=-1) / 2)
    values = paired, distances.min(-1), spread, compute_share(weights)
    return dict(zip(LISTS, values, strict=True))


def compute_query_errors(
    modes: np.ndarray, covariances: np.ndarray, true: np.ndarray, seen: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Per-query metrics of (S, n, 2) modes, most probable first, and their (S, n, 2, 2) covariances: each value (S,).

    ``rmse_px`` is the root mean square over a query's modes (the paper's formula lacks the root of its name),
    ``nearest_px`` the distance of the most probable mode to the nearest true one, ``best_px`` that of the mode with the
    least spread (the first where no spread is known), ``pck@5px`` … the share of true modes found that near,
    ``swapped`` that of modes nearer to a wrong point of the orbit than to their own. Where it is known which true
    matches are ``seen`` (S, n) bool, ``rmse_seen_px`` is that over those alone, NaN where there is none.
    """
    errors = compute_mode_errors(modes, true)
    nearest = np.linalg.norm(true - modes[:, :1], axis=-1).min(1)
    spread = np.nan_to_num(np.trace(covariances, axis1=-2, axis2=-1), nan=np.inf)
    best = np.take_along_axis(modes, spread.argmin(1)[:, None, None], 1)  # (S, 1, 2)
    shares = {f"pck@{t}px": (errors <= t).mean(1) for t in PCK_PX}
    if seen is not None:
        count = seen.sum(1)
        mean = np.where(seen, np.square(errors), 0).sum(1) / count.clip(min=1)
        shares["rmse_seen_px"] = np.where(count > 0, np.sqrt(mean), np.nan)
    return {
        "rmse_px": np.sqrt(np.square(errors).mean(1)),
        "nearest_px": nearest,
        "best_px": np.linalg.norm(true - best, axis=-1).min(1),
        "swapped": compute_swaps(modes, true).mean(1),
        **shares,
    }


def aggregate(queries: pd.DataFrame) -> dict[str, float]:
    """Summary of a table of queries: ``rmse_mean``, ``rmse_pooled``, ``median`` (px), nearest and shares.

    And ``rmse_seen``, the mean over queries with a match that is seen, where the table has it.
    """
    error = queries.rmse_px
    seen = {"rmse_seen": queries.rmse_seen_px.mean()} if "rmse_seen_px" in queries else {}
    summary = {
        "rmse_mean": error.mean(),
        "rmse_pooled": np.sqrt(np.square(error).mean()),
        "median": error.median(),
        "nearest_mean": queries.nearest_px.mean(),
        "best_mean": queries.best_px.mean(),
        "swap_rate": queries.swapped.mean(),
        **{f"pck@{t}px": queries[f"pck@{t}px"].mean() for t in PCK_PX},
        **seen,
    }
    return {name: round(float(value), 4) for name, value in summary.items()} | {"queries": len(queries)}


def summarise_errors(queries: pd.DataFrame) -> ErrorSummary:
    """Summary of a table of queries, of which it reads ``point``, ``visible`` and ``rmse_px``."""
    seen = queries[queries.visible]
    bins = (seen.rmse_px.to_numpy(float) // BIN_PX).astype(int)
    by_point = seen.groupby("point").rmse_px
    query_counts = by_point.size().reindex(range(N_POINTS), fill_value=0).to_numpy()
    return ErrorSummary(query_counts, compute_point_errors(queries), np.bincount(bins))


def compute_point_errors(queries: pd.DataFrame) -> np.ndarray:
    """(625,) mean ``rmse_px`` of each material point as a visible source, NaN where it never was one."""
    mean = queries[queries.visible].groupby("point").rmse_px.mean()
    return mean.reindex(range(N_POINTS)).to_numpy(float)
