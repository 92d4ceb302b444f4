"""One function a figure: each returns a matplotlib ``Figure`` and neither shows nor saves it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb, rgb_to_hsv
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter1d

from mmgsd.config import N_POINTS
from mmgsd.experiments import ROWS, get_colour, get_label
from mmgsd.figures.style import (
    CHANCE_STYLES,
    COLUMN_IN,
    MARK,
    PAGE_IN,
    add_legend,
    check_filled,
    compute_point_colours,
    fade_image,
    finish_axes,
    get_line_style,
    make_grid,
    name_grid,
    show_answer,
    show_source,
    styled,
)
from mmgsd.match.describe import say_presence
from mmgsd.match.match import Match
from mmgsd.measure.metrics import BIN_PX, ErrorSummary

_ORBIT_COLOURS = ("#D55E00", "#56B4E9", "#FFE100", "#009E73")
SEGMENTS = 25  # of a rope
OTHER_SEED = re.compile(r"mmgsd-[1-9]")
SHOWN = 0.95  # share of a method's errors that the axis of their distribution holds
MOST_MODES = 8  # of a material point under any group
PAGE_QUERIES, PANEL_PX = 100, 640  # on one page at most; the longer side of an image in a panel of it


@styled
def plot_match(match: Match, index: int = 0) -> Figure:
    """Source image with the pixel of one query, target image with heatmap and modes; the title gives the entropy.

    Each mode has its 1-std ellipse, its marker's area shows its weight; of one that is hidden they are dashed. Where
    the pixel or the target does not show the object the title says so instead, where that is known.
    ValueError where ``index`` is not in [0, S).
    """
    whole = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if not whole or not 0 <= index < len(match):
        raise ValueError(f"index must be in [0, {len(match)}), got {index!r}")
    figure, axes = make_grid([match.image0.shape[0] / match.image0.shape[1]], 2, PAGE_IN * 0.7)
    show_source(axes[0, 0], match, index)
    show_answer(axes[0, 1], match, index)
    axes[0, 0].set_title("Source")
    axes[0, 1].set_title(say_presence(match, index) or f"Matches · entropy {match.entropy[index]:.1f} nats")
    return figure


@styled
def plot_page(match: Match) -> Figure:
    """All queries, two beside each other: the source's pixel, the answer, and above them number, pixel and entropy.

    ValueError for none, or for more than `PAGE_QUERIES`.
    """
    if not 1 <= len(match) <= PAGE_QUERIES:
        raise ValueError(f"match must hold 1 to {PAGE_QUERIES} queries to be drawn, got {len(match)}")
    small = shrink_match(match)
    aspect = max(image.shape[0] / image.shape[1] for image in (match.image0, match.image1))
    columns = 4 if len(match) > 1 else 2
    figure, axes = make_grid([aspect] * -(-2 * len(match) // columns), columns, PAGE_IN)
    for axis in axes.flat[2 * len(match) :]:
        axis.set_axis_off()
    for index, (source, answer) in enumerate(axes.reshape(-1, 2)[: len(match)]):
        show_source(source, small, index)
        show_answer(answer, small, index)
        x, y = match.xy[index]
        source.set_title(f"{index + 1} · pixel {x:g}, {y:g}")
        said = say_presence(match, index).partition(":")[0]  # a panel has room for a word
        answer.set_title(said or f"entropy {match.entropy[index]:.1f} nats")
    return figure


def shrink_match(match: Match) -> Match:
    """The same answer about images of at most PANEL_PX: what a panel of a page shows, in a page's memory."""
    places = {}
    for name in ("image0", "image1"):
        image = getattr(match, name)
        height, width = image.shape[:2]
        scale = min(1, PANEL_PX / max(width, height))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        places[name] = cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.array(size) / (width, height)
    (image0, scale0), (image1, scale1) = places["image0"], places["image1"]
    return dataclasses.replace(
        match, image0=image0, image1=image1, xy=(match.xy + 0.5) * scale0 - 0.5, modes=(match.modes + 0.5) * scale1
        - 0.5, covariances=match.covariances * scale1[:, None] * scale1,
    )  # fmt: skip


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
def plot_sigma_ablation(
    results: Mapping[str, Mapping[str, Mapping[str, float]]], *, seeds: Mapping[str, Mapping[str, Any]] | None = None
) -> Figure:
    """``rmse_mean`` of MMGSD against the std σ of its targets: ``results`` {object: {σ px: {metric: value}}}.

    Rings at σ = 1 px are ``seeds`` {object: {"mmgsd-1": {metric: value}}} of the same training, but for the seed 0.
    """
    for name, rows in {"": results, **results}.items():
        check_filled(f"results[{name!r}]" if name else "results", rows)
    figure, axes = plt.subplots(1, len(results), figsize=(COLUMN_IN, 1.7), layout="constrained", squeeze=False)
    for axis, (name, rows) in zip(axes[0], results.items(), strict=True):
        points = sorted((float(sigma), metrics["rmse_mean"]) for sigma, metrics in rows.items())
        sigma, error = zip(*points, strict=True)
        axis.plot(sigma, error, "o-", ms=3.5, color=get_colour("mmgsd"))
        others = [row["rmse_mean"] for key, row in (seeds or {}).get(name, {}).items() if OTHER_SEED.match(key)]
        axis.plot([1.0] * len(others), others, "o", ms=3.5, mfc="none", color=get_colour("mmgsd"))
        for x, y in points:
            axis.annotate(f"{y:.1f}", (x, y), xytext=(0, 4), textcoords="offset points", ha="center", fontsize=6.5)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sigma, [f"{s:g}" for s in sigma])
        axis.set(title=name.capitalize(), xlabel="σ of the targets (px)", ylim=(0, 1.2 * max(error)))
        axis.margins(x=0.15)
    axes[0, 0].set_ylabel("RMSE of MMGSD (px)")
    return finish_axes(figure)


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
def plot_samples(images: Sequence[np.ndarray], titles: Sequence[str] | None = None, *, columns: int = 6) -> Figure:
    """Contact sheet of (H, W, 3) images of one size. ValueError where there are none, or not one title each."""
    check_filled("images", images)
    if titles is not None and len(titles) != len(images):
        raise ValueError(f"titles must be {len(images)}, one an image, got {len(titles)}")
    aspect = images[0].shape[0] / images[0].shape[1]
    figure, axes = make_grid([aspect] * -(-len(images) // columns), columns, PAGE_IN)
    for axis, image, title in zip(axes.flat, images, titles or [""] * len(images), strict=False):
        axis.imshow(image)
        axis.set_title(title)
    for axis in axes.flat[len(images) :]:
        axis.remove()
    return figure


@styled
def plot_labels(
    image: np.ndarray, xy: np.ndarray, visible: np.ndarray, *, object: str = "cloth", orbit: Sequence[int] = ()
) -> Figure:
    """Image, and its material points ``xy`` (P, 2) px coloured by place on the object, hidden ones hollow.

    The points of an ``orbit`` are ringed on both. ValueError where ``visible`` is not (P,).
    """
    if xy.ndim != 2 or visible.shape != xy.shape[:1] or not len(xy):
        raise ValueError(f"xy must be (P, 2) and visible (P,), P > 0, got {xy.shape} and {visible.shape}")
    figure, axes = make_grid([image.shape[0] / image.shape[1]], 2, PAGE_IN * 0.7)
    colours = compute_point_colours(object, len(xy))
    axes[0, 0].imshow(image)
    axes[0, 1].imshow(fade_image(image))
    for axis in axes[0]:
        axis.autoscale(False)
    axes[0, 1].scatter(*xy[~visible].T, s=4, facecolors="none", edgecolors=colours[~visible], linewidths=0.4)
    axes[0, 1].scatter(*xy[visible].T, s=4, c=colours[visible], linewidths=0)
    for axis in axes[0]:
        chosen = xy[list(orbit)].reshape(-1, 2)
        axis.scatter(*chosen.T, s=50, facecolors="none", edgecolors="black", linewidths=2.2)
        axis.scatter(*chosen.T, s=50, facecolors="none", edgecolors=MARK, linewidths=1.2)
    return figure


@styled
def plot_orbits(image: np.ndarray, xy: np.ndarray, groups: Mapping[str, Sequence[Sequence[int]]]) -> Figure:
    """A panel a symmetry group ({name: orbits, each of indices into ``xy`` (P, 2) px}), an orbit a colour."""
    check_filled("groups", groups)
    figure, axes = make_grid([image.shape[0] / image.shape[1]], len(groups), PAGE_IN)
    for axis, (name, orbits) in zip(axes[0], groups.items(), strict=True):
        axis.imshow(fade_image(image))
        axis.autoscale(False)
        for colour, orbit in zip(_ORBIT_COLOURS, orbits, strict=False):
            axis.scatter(*xy[list(orbit)].T, s=26, color=colour, edgecolors="black", linewidths=0.6)
        axis.set_title(name)
    return figure


@styled
def plot_variety(tables: Mapping[str, pd.DataFrame], modes: Mapping[str, Mapping[str, Sequence[int]]]) -> Figure:
    """How the images differ, a row an object: states, visible share, hue of object and background, modes a point.

    ``tables`` {object: `mmgsd.dataset.measure_images`}, ``modes`` {object: {group: (P,) modes of each point}}.
    """
    check_filled("tables", tables)
    figure, axes = plt.subplots(len(tables), 4, figsize=(PAGE_IN, 1.6 * len(tables)), layout="constrained",
                                squeeze=False)  # fmt: skip
    for line, (name, table) in zip(axes, tables.items(), strict=True):
        share = 100 * table.state.value_counts(normalize=True).sort_index()
        line[0].barh(share.index, share, color="0.5")
        line[0].set(xlabel="Images (%)", title=name.capitalize())
        line[1].hist(100 * table.visible, np.arange(0, 101, 5), color="0.5")
        line[1].set(xlabel="Visible material points (%)", ylabel="Images", xlim=(0, 100))
        _draw_hues(line[2], table)
        _draw_modes_a_point(line[3], modes[name])
    return finish_axes(figure)


def _draw_modes_a_point(axis: Axes, groups: Mapping[str, Sequence[int]]) -> None:
    """Material points by how many modes they have, a bar a group; a number of modes has one colour for all objects."""
    counts = pd.DataFrame({group: pd.Series(modes).value_counts() for group, modes in groups.items()}).sort_index()
    bottom = np.zeros(counts.shape[1])
    for n, row in counts.fillna(0).iterrows():
        colour = colormaps["viridis"](np.log2(n) / np.log2(MOST_MODES))
        axis.bar(counts.columns, row, 0.7, bottom, color=colour, label=n)
        bottom += row.to_numpy()
    axis.set(ylabel="Material points", xlabel="Symmetry group", xlim=(-0.6, counts.shape[1] - 0.4))
    axis.set_xticks(range(counts.shape[1]), counts.columns, rotation=40, ha="right", rotation_mode="anchor")
    axis.legend(title="Modes", loc="center left", bbox_to_anchor=(1, 0.5), fontsize=6, title_fontsize=6)


def _draw_hues(axis: Axes, table: pd.DataFrame) -> None:
    """Histogram of hue, object upwards and background downwards, greys in a bar of their own at the left."""
    edges = np.linspace(0, 1, 13)
    for part, sign in (("object", 1), ("background", -1)):
        hsv = rgb_to_hsv(np.stack(table[f"{part}_colour"].to_list()) / 255)
        vivid = hsv[:, 1] > 0.15
        counts = sign * np.histogram(hsv[vivid, 0], edges)[0]
        colours = hsv_to_rgb(np.stack([edges[:-1] + 1 / 24, np.full(12, 0.65), np.full(12, 0.85)], -1))
        axis.bar(edges[:-1], counts, 1 / 12, align="edge", color=colours)
        axis.bar(-1 / 12, sign * np.sum(~vivid), 1 / 12, align="edge", color="0.6")
        axis.text(0.98, 0.5 + 0.45 * sign, part, ha="right", va="center", fontsize=6.5, transform=axis.transAxes)
    axis.axhline(0, color="black", lw=0.6)
    most = max(abs(limit) for limit in axis.get_ylim())
    axis.set(xlabel="Hue (left: greys)", ylabel="Images", xticks=[], ylim=(-most, most))
    axis.yaxis.set_major_formatter(lambda count, _: f"{abs(count):g}")  # downwards as many


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
