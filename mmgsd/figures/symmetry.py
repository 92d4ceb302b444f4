"""Where on a cloth a symmetry group's errors lie: by region, and as maps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmgsd.config import N_POINTS
from mmgsd.experiments import get_colour
from mmgsd.figures.style import PAGE_IN, check_filled, finish_axes, name_grid, styled
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
    ratios = [1.0] * len(tables) + [1.4, 1.4]
    figure, axes = plt.subplots(1, len(ratios), figsize=(PAGE_IN, 1.9), layout="constrained", width_ratios=ratios)
    maps = [compute_point_errors(table).reshape(SIDE, SIDE) for table in tables.values()]
    for axis, group, values in zip(axes, tables, maps, strict=False):
        image = axis.imshow(values, cmap=colormaps["viridis"].with_extremes(bad="0.85"), vmin=0, vmax=np.nanmax(maps))
        axis.set_title(group)
    name_grid(axes[: len(tables)])
    bar = figure.colorbar(image, ax=axes[: len(tables)], shrink=0.75)
    bar.ax.set_title("RMSE\n(px)", fontsize=7)
    regions = {group: summarise_regions(table) for group, table in tables.items()}
    for axis, name, label in zip(axes[-2:], ("rmse_px", "entropy"), ("RMSE (px)", "Entropy (nats)"), strict=True):
        _draw_regions(axis, {group: {r: row[name] for r, row in rows.items()} for group, rows in regions.items()})
        axis.set_ylabel(label)
    figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside upper right", ncols=len(tables), handlelength=1)
    return finish_axes(figure, keep_box=axes[: len(tables)])


def _draw_regions(axis: Axes, groups: Mapping[str, Mapping[str, float | None]]) -> None:
    """A bar from 0 for each region's value in each group, which is written in it."""
    width = 0.86 / len(groups)
    for k, (group, rows) in enumerate(groups.items()):
        heights = [np.nan if value is None else value for value in rows.values()]
        places = np.arange(len(rows)) + (k - (len(groups) - 1) / 2) * width
        axis.bar(places, heights, 0.92 * width, color=get_colour(group), label=group)
        for x, height in zip(places, heights, strict=True):
            if np.isfinite(height):
                axis.text(x, 0, f" {height:.1f}", ha="center", va="bottom", fontsize=5.5, c="w", rotation=90)
    axis.set_xticks(range(len(rows)), rows, rotation=30, ha="right", rotation_mode="anchor")
    axis.set_ylim(min(0, *axis.get_ylim()), None)
