"""Where on a cloth the errors lie: by region, and point by point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from mmgsd.config import N_POINTS
from mmgsd.measure.metrics import compute_point_errors

SIDE = round(N_POINTS**0.5)
CORNER, BORDER, INTERIOR = 5, 3, 13  # points: side of a corner's block, width of the edge, side of the interior
MAP = "map_px"  # the key of the error of each point


def _count_from_edge() -> np.ndarray:
    """(2, 625) rows and columns between each material point and the nearest edge."""
    return np.stack([np.minimum(v, SIDE - 1 - v) for v in np.divmod(np.arange(N_POINTS), SIDE)])


def find_regions() -> dict[str, np.ndarray]:
    """Material points (625,) bool of a cloth's ``corner`` blocks, the rest of its ``edge``, and its ``interior``."""
    from_edge = _count_from_edge()
    corner = (from_edge < CORNER).all(0)
    edge = (from_edge < BORDER).any(0) & ~corner
    return {"corner": corner, "edge": edge, "interior": (from_edge >= (SIDE - INTERIOR) // 2).all(0)}


def measure_rings(errors: Sequence[float | None]) -> list[float | None]:
    """Mean of a cloth's 625 values by ring, from the border inwards; None of a ring without any."""
    means = pd.Series(np.array(errors, float)).groupby(_count_from_edge().min(0)).mean()
    return [None if np.isnan(mean) else round(float(mean), 2) for mean in means]


def summarise_regions(queries: pd.DataFrame) -> dict[str, dict[str, float]]:
    """{region: mean ``rmse_px``, mean ``entropy`` (nats) and number of queries with a visible source}."""
    seen = queries[queries.visible]
    summary = {}
    for region, points in find_regions().items():
        part = seen[points[seen.point]]
        means = {name: float(part[name].mean()) if len(part) else None for name in ("rmse_px", "entropy")}
        summary[region] = {**means, "queries": len(part)}
    return summary


def summarise_places(queries: pd.DataFrame) -> dict[str, Any]:
    """What the symmetry study's figure needs: ``regions`` (`summarise_regions`), ``map_px``, of each of the 625 points.

    The latter is the mean RMSE over queries whose source is visible, None where there is none.
    """
    errors = [round(float(error), 2) if np.isfinite(error) else None for error in compute_point_errors(queries)]
    return {"regions": summarise_regions(queries), MAP: errors}
