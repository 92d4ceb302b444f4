"""Where on a cloth a symmetry group's errors lie: as maps, by ring, and by region."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmgsd.figures.style import PAGE_IN, check_filled, finish_axes, name_grid, styled
from mmgsd.measure.regions import MAP, SIDE, measure_rings
from mmgsd.studies.models import get_colour


@styled
def plot_symmetry_study(places: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Maps of the RMSE over the cloth on one scale, and the error by ring, from the border inwards, and by region.

    ``places`` {group: what `mmgsd.measure.regions.summarise_places` gives}.
    """
    check_filled("places", places)
    ratios = [1.0] * len(places) + [1.4, 1.4]
    figure, axes = plt.subplots(1, len(ratios), figsize=(PAGE_IN, 1.9), layout="constrained", width_ratios=ratios)
    maps = [np.array(row[MAP], float).reshape(SIDE, SIDE) for row in places.values()]
    for axis, group, values in zip(axes, places, maps, strict=False):
        image = axis.imshow(values, cmap=colormaps["viridis"].with_extremes(bad="0.85"), vmin=0, vmax=np.nanmax(maps))
        axis.set_title(group)
    name_grid(axes[: len(places)])
    bar = figure.colorbar(image, ax=axes[: len(places)], shrink=0.75)
    bar.ax.set_title("RMSE\n(px)", fontsize=7)
    for group, row in places.items():
        axes[-2].plot(np.array(measure_rings(row[MAP]), float), color=get_colour(group))
    axes[-2].set(xlabel="Points from the border", ylabel="RMSE (px)", ylim=(0, None), xlim=(0, SIDE // 2))
    _draw_regions(axes[-1], {group: {r: row["rmse_px"] for r, row in shown["regions"].items()}
                             for group, shown in places.items()})  # fmt: skip
    axes[-1].set_ylabel("RMSE (px)")
    figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside upper right", ncols=len(places), handlelength=1)
    return finish_axes(figure, keep_box=axes[: len(places)])


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
