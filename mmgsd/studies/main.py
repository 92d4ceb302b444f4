"""The main table's methods: how large their errors are and where, and what they answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter1d

from mmgsd.config import N_POINTS
from mmgsd.figures.answers import get_aspect
from mmgsd.figures.style import (
    COLUMN_IN,
    MARK,
    PAGE_IN,
    add_legend,
    blend_heatmap,
    check_filled,
    finish_axes,
    make_grid,
    mark_true,
    name_grid,
    show_answer,
    show_source,
    styled,
)
from mmgsd.match.match import Match
from mmgsd.measure.metrics import BIN_PX, ErrorSummary
from mmgsd.studies.models import CHANCE_STYLES, ROWS, get_colour, get_label, get_line_style

SEGMENTS = 25  # of a rope
SHOWN = 0.95  # share of a method's errors that the axis of their distribution holds


@styled
def plot_rmse_pdf(errors: Mapping[str, Mapping[str, ErrorSummary]], object_sizes_px: Mapping[str, float]) -> Figure:
    """Probability density of the error of a query with a visible source, as a percentage of the object's size.

    ``errors`` {object: {method: summary}}, a panel an object, a line a method, chance dashed. The object's size is the
    diagonal of its bounding box, mean over the test images (``compute_object_size``). Smoothed with a std of 1 %.
    """
    for name, methods in {"": errors, **errors}.items():
        check_filled(f"errors[{name!r}]" if name else "errors", methods)
    figure, axes = plt.subplots(len(errors), 1, figsize=(COLUMN_IN, 0.4 + 1.4 * len(errors)), layout="constrained",
                                sharex=True, squeeze=False)  # fmt: skip
    far = 0.0
    for axis, (name, methods) in zip(axes[:, 0], errors.items(), strict=True):
        step = 100 * BIN_PX / object_sizes_px[name]  # %
        for method, summary in methods.items():
            axis.plot(*compute_density(summary.histogram, step), **get_line_style(method))
            cumulated = np.cumsum(summary.histogram)
            if method not in CHANCE_STYLES or len(methods) == 1:  # chance would leave half of the axis empty
                far = max(far, step * (1 + int(np.searchsorted(cumulated, SHOWN * cumulated[-1]))))
        axis.set(title=name.capitalize(), ylabel="Density per %", ylim=(0, None))
    axes[-1, 0].set(xlabel="Error (% of the object's bounding-box diagonal)", xlim=(0, far))
    add_legend(figure, axes[:, 0])
    return finish_axes(figure)


@styled
def plot_spatial_rmse(
    errors: Mapping[str, Mapping[str, ErrorSummary]], *, mapped: Sequence[str] = ("mmgsd", "spcl")
) -> Figure:
    """Mean error over the rope's length for every method (1-D), and over the cloth's area for those ``mapped`` (2-D).

    ``errors`` {"rope", "cloth": {method: summary}}; each map, of the ``mapped`` that are in it, has a scale of its own,
    so that a lesser error's map is not flat; points never asked stay grey.
    """
    for name in ("rope", "cloth"):
        check_filled(f"errors[{name!r}]", errors.get(name, {}))
    mapped = [method for method in mapped if method in errors["cloth"]]
    figure, axes = plt.subplots(1, 1 + len(mapped), figsize=(PAGE_IN, 2.1), layout="constrained",
                                width_ratios=[1.8] + [1.0] * len(mapped))  # fmt: skip
    for method, summary in errors["rope"].items():
        seen = np.flatnonzero(summary.asked)
        mean = pd.Series(summary.mean_px[seen]).groupby(seen * SEGMENTS // N_POINTS).mean()
        axes[0].plot((mean.index + 0.5) * 100 / SEGMENTS, mean, **get_line_style(method))
    axes[0].set(title="Rope", xlabel="Position along the rope (%)", ylabel="RMSE (px)", xlim=(0, 100), ylim=(0, None))
    maps = [errors["cloth"][method].mean_px.reshape(25, 25) for method in mapped]
    for axis, method, values in zip(axes[1:], mapped, maps, strict=True):
        image = axis.imshow(values, cmap=colormaps["viridis"].with_extremes(bad="0.85"))
        axis.set_title(f"Cloth · {get_label(method, short=True)}, RMSE (px)")
        figure.colorbar(image, ax=axis, shrink=0.8)
    name_grid(axes[1:])
    add_legend(figure, axes[:1])
    return finish_axes(figure, keep_box=axes[1:])


@styled
def plot_training(logs: Mapping[str, pd.DataFrame], *, columns: int = 4) -> Figure:
    """Loss against step, a panel a model: ``logs`` {"cloth mmgsd": columns step, loss, seconds}, last word the method.

    Losses of different methods have different scales. Dark: mean of a tenth of the steps.
    """
    check_filled("logs", logs)
    columns = min(columns, len(logs))
    rows = -(-len(logs) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(PAGE_IN * columns / 4, 1.5 * rows), layout="constrained",
                                squeeze=False)  # fmt: skip
    for axis, (name, log) in zip(axes.flat, logs.items(), strict=False):
        colour = get_colour(name.split()[-1])
        axis.plot(log.step, log.loss, color=colour, alpha=0.3, lw=0.6)
        axis.plot(log.step, log.loss.rolling(max(1, len(log) // 10), min_periods=1).mean(), color=colour)
        title = " ".join(get_label(word, short=True) if word in ROWS else word.capitalize() for word in name.split())
        axis.set(title=f"{title} · {log.seconds.iloc[-1] / 60:.1f} min", xlabel="Step")
    for axis in axes[:, 0]:
        axis.set_ylabel("Loss")
    for axis in axes.flat[len(logs) :]:
        axis.remove()
    return finish_axes(figure)


@styled
def plot_combined(
    answers: Mapping[str, Mapping[str, Match]], true: Mapping[str, np.ndarray], inwards: Mapping[str, Match],
    *, sigma_px: float = 10.0,
) -> Figure:  # fmt: skip
    """A: contrastive answers, B: the true and MMGSD's distribution of the same query, C: queries moved inwards.

    ``answers`` {object: {"pcl", "spcl", "mmgsd": match}}, first query of each, contrastive ones where they are
    trained; ``true`` {object: (n, 2) px}, crosses, and in B Gaussians of ``sigma_px``, wide enough to be seen;
    ``inwards`` {object: match of four queries, extremity first}. Modes are rings with their 1-std ellipses.
    """
    check_filled("answers", answers)
    for name, match in inwards.items():
        if len(match.xy) != 4:
            raise ValueError(f"inwards[{name!r}] must hold 4 queries, got {len(match.xy)}")
    aspects = [get_aspect(m["mmgsd"]) for m in answers.values()] + [get_aspect(m) for m in inwards.values()]
    figure, axes = make_grid(aspects, 5, PAGE_IN)
    for line, (name, methods) in zip(axes, answers.items(), strict=False):
        _draw_comparison(line, methods, true[name], sigma_px)
        line[0].set_ylabel(name.capitalize())
    for line, (name, match) in zip(axes[len(answers) :], inwards.items(), strict=True):
        _draw_inwards(line, match)
        line[0].set_ylabel(name.capitalize())
    for axis, title in zip(axes[0], (r"$\bf{A}$  Source", "PCL", "SPCL", r"$\bf{B}$  True", "MMGSD"), strict=True):
        axis.set_title(title)
    if inwards:
        axes[len(answers), 0].set_title(r"$\bf{C}$  Sources 1–4")
    return figure


def _draw_comparison(line: Sequence[Axes], methods: Mapping[str, Match], true: np.ndarray, sigma_px: float) -> None:
    match = methods["mmgsd"]
    show_source(line[0], match, 0)
    for axis, method in zip(line[[1, 2, 4]], ("pcl", "spcl", "mmgsd"), strict=True):
        if method in methods:
            show_answer(axis, methods[method], 0)
            mark_true(axis, true)
        else:
            axis.set_axis_off()
            axis.text(0.5, 0.5, "not trained", ha="center", va="center", fontsize=6, transform=axis.transAxes)
    ys, xs = np.mgrid[: match.image1.shape[0], : match.image1.shape[1]]
    mixture = sum(np.exp(-((xs - x) ** 2 + (ys - y) ** 2) / (2 * sigma_px**2)) for x, y in true)
    line[3].imshow(blend_heatmap(match.image1, mixture))
    mark_true(line[3], true)


def _draw_inwards(line: Sequence[Axes], match: Match) -> None:
    line[0].imshow(match.image0)
    for index, (x, y) in enumerate(match.xy):
        line[0].text(x, y, str(index + 1), ha="center", va="center", fontsize=5.5, zorder=3,
                     bbox={"boxstyle": "circle,pad=0.15", "fc": MARK, "ec": "black", "lw": 0.6})  # fmt: skip
        show_answer(line[index + 1], match, index)
        line[index + 1].set_title(f"{index + 1} · {match.entropy[index]:.1f} nats")


def compute_object_size(masks: Sequence[np.ndarray]) -> float:
    """Diagonal of the object's bounding box in px, mean over (H, W) bool masks."""
    check_filled("masks", masks)
    spans = [np.ptp(np.argwhere(mask), axis=0) + 1 for mask in masks]
    return float(np.linalg.norm(spans, axis=1).mean())


def compute_density(histogram: np.ndarray, step: float, *, bandwidth: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Centres (K,) and density (K,) of a histogram of values ≥ 0 in bins of width ``step``.

    It is smoothed by a Gaussian, mirrored at zero. ValueError where the histogram counts nothing.
    """
    check_filled("histogram", histogram[histogram > 0])
    padded = np.pad(histogram, (0, int(np.ceil(5 * bandwidth / step))))
    density = gaussian_filter1d(padded / (padded.sum() * step), bandwidth / step, mode="reflect")
    return (np.arange(len(padded)) + 0.5) * step, density
