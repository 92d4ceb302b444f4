"""Figures of `mmgsd.measure.uncertainty`, in the style of `mmgsd.figures.plots`: each returns a ``Figure``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmgsd.figures.style import COLUMN_IN, add_legend, check_filled, finish_axes, styled
from mmgsd.measure.uncertainty import LEVELS, compute_coverage, compute_risk_coverage, get_distances
from mmgsd.studies.models import CHANCE_STYLES, get_line_style

CURVE_POINTS = 200  # of a risk-coverage curve: a PDF of all queries would be large
_ORDER = ("mmgsd", "unimodal", "spcl", "pcl", "sift", "orb")
_THIN = {"linestyle": (0, (4, 1.5)), "linewidth": 0.8}

Tables = Mapping[str, Mapping[str, pd.DataFrame]]


@styled
def plot_risk_coverage(queries: Tables) -> Figure:
    """Mean error of the queries kept against their share, least entropy first; dashed: MMGSD ordered by its errors.

    ``queries`` {object: {method: table}}, a panel an object, a line a method; chance, which is never certain, is left
    out, as are queries with a hidden source. ValueError where there are none.
    """
    figure, axes = _make_panels("queries", queries)
    for axis, (name, methods) in zip(axes, queries.items(), strict=True):
        for method in _sort_methods(methods):
            seen = methods[method][methods[method].visible]
            style = get_line_style(method)
            _draw_risk(axis, seen.rmse_px, seen.entropy, style)
            if method == "mmgsd":
                _draw_risk(axis, seen.rmse_px, seen.rmse_px, style | _THIN | {"label": f"{style['label']}, oracle"})
        axis.set(title=name.capitalize(), xlabel="Queries kept (%)", xlim=(0, 100), ylim=(0, None))
    axes[0].set_ylabel("Mean RMSE (px)")
    add_legend(figure, axes)
    return finish_axes(figure)


@styled
def plot_calibration(before: Tables, after: Tables) -> Figure:
    """Share of true matches inside the ellipses against the share that they promise; grey: perfectly calibrated.

    ``before`` (thin, dashed) and ``after`` (solid) the calibration, {object: {method: table}} of the same
    objects; a method in one of them only has that line only. ValueError for other objects, or none.
    """
    if list(before) != list(after):
        raise ValueError(f"before and after must have the same objects, got {list(before)} and {list(after)}")
    figure, axes = _make_panels("before", before)
    for axis, name in zip(axes, before, strict=True):
        check_filled(f"after[{name!r}]", after[name])
        _draw_diagonal(axis, name, "Expected coverage (%)")
        for method in _sort_methods(after[name]):
            _draw_coverage(axis, after[name][method], get_line_style(method))
        for method in _sort_methods(before[name]):
            label = "" if method in after[name] else get_line_style(method)["label"]
            _draw_coverage(axis, before[name][method], get_line_style(method) | _THIN | {"label": label})
    axes[0].set_ylabel("Observed coverage (%)")
    axes[0].plot([], [], color="0.3", label="Before calibration", **_THIN)
    add_legend(figure, axes)
    return finish_axes(figure)


@styled
def plot_reliability(before: Mapping[str, pd.DataFrame], after: Mapping[str, pd.DataFrame]) -> Figure:
    """Reliability diagram: how often a match is near a mode, against the confidence that it is; grey: calibrated.

    ``before`` (rings) and ``after`` (dots with 95 % intervals) the calibration, {object: rows} of the same objects by
    `mmgsd.measure.uncertainty.compute_reliability`. ValueError for other objects, or none.
    """
    check_filled("before", before)
    if list(before) != list(after):
        raise ValueError(f"before and after must have the same objects, got {list(before)} and {list(after)}")
    figure, axes = _make_row(len(before))
    style = get_line_style("mmgsd")
    for axis, name in zip(axes, before, strict=True):
        _draw_diagonal(axis, name, "Confidence (%)")
        axis.plot(100 * before[name].expected, 100 * before[name].observed, "o", ms=3.5, mfc="white", mec="0.45",
                  mew=0.8, ls=_THIN["linestyle"], lw=_THIN["linewidth"], c="0.45", label="Gaussian")  # fmt: skip
        rows = 100 * after[name][["expected", "observed", "margin"]]
        axis.errorbar(rows.expected, rows.observed, rows.margin, fmt="o-", ms=3.5, lw=1, elinewidth=0.8,
                      color=style["color"], label="Calibrated", zorder=style["zorder"])  # fmt: skip
    axes[0].set_ylabel("A match is near (%)")
    add_legend(figure, axes)
    return finish_axes(figure)


def _draw_diagonal(axis: Axes, name: str, promised: str) -> None:
    """Axes in % and the line of what keeps its promise."""
    axis.plot([0, 100], [0, 100], color="0.75", lw=0.8, zorder=1)
    axis.set(title=name.capitalize(), xlabel=promised, xlim=(0, 100), ylim=(0, 100), aspect="equal",
             xticks=range(0, 101, 25), yticks=range(0, 101, 25))  # fmt: skip


def _make_panels(name: str, tables: Tables) -> tuple[Figure, np.ndarray]:
    """A row of axes, one an object; ValueError where there is no object, or one without methods."""
    check_filled(name, tables)
    for key, methods in tables.items():
        check_filled(f"{name}[{key!r}]", methods)
    return _make_row(len(tables))


def _make_row(count: int) -> tuple[Figure, np.ndarray]:
    figure, axes = plt.subplots(1, count, figsize=(COLUMN_IN, 2.2), layout="constrained", squeeze=False)
    return figure, axes[0]


def _sort_methods(methods: Iterable[str]) -> list[str]:
    """The methods that are not chance: those of the paper's tables in their order, then others."""
    others = [m for m in methods if m not in _ORDER and m not in CHANCE_STYLES]
    return [m for m in _ORDER if m in methods] + others


def _draw_risk(axis: Axes, error: pd.Series, score: pd.Series, style: dict) -> None:
    coverage, risk = compute_risk_coverage(error, score)
    chosen = np.unique((np.arange(1, CURVE_POINTS + 1) * len(risk) - 1) // CURVE_POINTS)  # the last always
    axis.plot(100 * coverage[chosen], risk[chosen], **style)


def _draw_coverage(axis: Axes, queries: pd.DataFrame, style: dict) -> None:
    axis.plot(100 * np.array(LEVELS), 100 * compute_coverage(get_distances(queries)), **style)
