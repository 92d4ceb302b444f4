"""Where on a cloth a symmetry group's errors lie: by region, and as maps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.config import N_POINTS
from mmgsd.figures.style import PAGE_IN, check_filled, finish_axes, styled
from mmgsd.measure.metrics import compute_point_errors

SIDE = round(N_POINTS**0.5)
CORNER, BORDER, INTERIOR = 5, 3, 13  # points: side of a corner's block, width of the edge, side of the interior


def find_regions(side: int = SIDE) -> dict[str, np.ndarray]:
    """Material points (side²,) bool of a cloth's ``corner`` blocks, the rest of its ``edge``, and its ``interior``."""
    row, column = np.divmod(np.arange(side * side), side)
    from_edge = np.stack([np.minimum(v, side - 1 - v) for v in (row, column)])
    corner = (from_edge < CORNER).all(0)
    edge = (from_edge < BORDER).any(0) & ~corner
    return {"corner": corner, "edge": edge, "interior": (from_edge >= (side - INTERIOR) // 2).all(0)}


def summarise_regions(queries: pd.DataFrame) -> dict[str, dict[str, float]]:
    """{region: mean ``rmse_px``, mean ``entropy`` (nats) and number of queries with a visible source}."""
    seen = queries[queries.visible]
    summary = {}
    for region, points in find_regions().items():
        part = seen[points[seen.point]]
        means = {name: float(part[name].mean()) if len(part) else None for name in ("rmse_px", "entropy")}
        summary[region] = {**means, "queries": len(part)}
    return summary


@styled
def plot_symmetry_study(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """Maps of the RMSE over the cloth on one scale, ``tables`` {group: queries}, and error and entropy by region."""
    check_filled("tables", tables)
    ratios = [1.0] * len(tables) + [1.0, 1.0]
    figure, axes = plt.subplots(1, len(ratios), figsize=(PAGE_IN, 1.75), layout="constrained", width_ratios=ratios)
    maps = [compute_point_errors(table).reshape(SIDE, SIDE) for table in tables.values()]
    for axis, group, values in zip(axes, tables, maps, strict=False):
        image = axis.imshow(values, cmap=colormaps["viridis"].with_extremes(bad="0.85"), vmin=0, vmax=np.nanmax(maps))
        axis.set(title=group, xticks=[0, 12, 24], yticks=[0, 12, 24])
    figure.colorbar(image, ax=axes[: len(tables)], label="RMSE (px)", shrink=0.75)
    regions = {group: summarise_regions(table) for group, table in tables.items()}
    for axis, name, label in zip(axes[-2:], ("rmse_px", "entropy"), ("RMSE (px)", "Entropy (nats)"), strict=True):
        for k, (group, rows) in enumerate(regions.items()):
            heights = [row[name] if row[name] is not None else np.nan for row in rows.values()]
            axis.bar(np.arange(len(rows)) + (k - (len(tables) - 1) / 2) * 0.26, heights, 0.24, label=group)
        axis.set(title=label, xticks=range(len(rows)))
        axis.set_xticklabels(rows, rotation=30, ha="right")
    axes[-2].legend(handlelength=1, loc="best", framealpha=0.8, frameon=True)
    axes[-1].set_ylim(bottom=min(r["entropy"] or 0 for rows in regions.values() for r in rows.values()) - 1)
    return finish_axes(figure, keep_box=axes[: len(tables)])
