"""One function a figure: each returns a matplotlib ``Figure`` and neither shows nor saves it."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb, rgb_to_hsv
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from mmgsd.figures import style

if TYPE_CHECKING:
    from mmgsd.match.match import Match

_ORBIT_COLOURS = ("#D55E00", "#56B4E9", "#FFE100", "#009E73")
MOST_MODES = 8  # of a material point under any group
TITLE = 40  # characters that fit above one of two panels
PAGE_QUERIES, PANEL_PX = 100, 640  # on one page at most; the longer side of an image in a panel of it


@style.styled
def plot_match(match: Match, index: int = 0) -> Figure:
    """Source image with the pixel of one query, target image with heatmap and modes; the title gives the entropy.

    Each mode has its 1-std ellipse, its marker's area shows its weight; of one that is hidden they are dashed. Where
    the pixel or the target does not show the object the title says so instead, where that is known.
    ValueError where ``index`` is not in [0, S).
    """
    whole = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if not whole or not 0 <= index < len(match):
        raise ValueError(f"index must be in [0, {len(match)}), got {index!r}")
    aspect = max(image.shape[0] / image.shape[1] for image in (match.image0, match.image1))
    figure, axes = style.make_grid([aspect], 2, style.PAGE_IN * 0.7)
    style.show_source(axes[0, 0], match, index)
    style.show_answer(axes[0, 1], match, index)
    axes[0, 0].set_title("Source")
    presence = textwrap.fill(match.say_presence(index), TITLE)
    axes[0, 1].set_title(presence or f"Matches · entropy {match.entropy[index]:.1f} nats")
    return figure


@style.styled
def plot_page(match: Match, names: Sequence[str] = ()) -> Figure:
    """All queries, two beside each other: the source's pixel, the answer, and above them number, pixel and entropy.

    ``names`` of places that were asked for stand instead of number and pixel.

    ValueError for none, or for more than `PAGE_QUERIES`.
    """
    if not 1 <= len(match) <= PAGE_QUERIES:
        raise ValueError(f"match must hold 1 to {PAGE_QUERIES} queries to be drawn, got {len(match)}")
    small = shrink_match(match)
    aspect = max(image.shape[0] / image.shape[1] for image in (match.image0, match.image1))
    columns = 4 if len(match) > 1 else 2
    figure, axes = style.make_grid([aspect] * -(-2 * len(match) // columns), columns, style.PAGE_IN)
    for axis in axes.flat[2 * len(match) :]:
        axis.set_axis_off()
    for index, (source, answer) in enumerate(axes.reshape(-1, 2)[: len(match)]):
        style.show_source(source, small, index)
        style.show_answer(answer, small, index)
        x, y = match.xy[index]
        source.set_title(names[index] if names else f"{index + 1} · pixel {x:g}, {y:g}")
        presence = match.say_presence(index).partition(":")[0]  # a panel has room for a word
        answer.set_title(presence or f"entropy {match.entropy[index]:.1f} nats")
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


@style.styled
def plot_teaser(matches: Mapping[str, Match]) -> Figure:
    """A row an object, of its match's first query: the source, the matches, to which lines lead, and the heatmap."""
    aspects = [match.image1.shape[0] / match.image1.shape[1] for match in matches.values()]
    figure, axes = style.make_grid(aspects, 3, style.COLUMN_IN)
    for (source, target, answer), (name, match) in zip(axes, matches.items(), strict=True):
        source.set_ylabel(name.capitalize())
        target.imshow(match.image1)
        target.autoscale(False)
        _lead_to_matches(source, target, match)
        style.show_source(source, match, 0)
        style.show_answer(answer, match, 0)
    for axis, title in zip(axes[0], ("Source", "Matches", "Heatmap"), strict=True):
        axis.set_title(title)
    return figure


def _lead_to_matches(source: Axes, target: Axes, match: Match) -> None:
    for mode in match.modes[0][np.isfinite(match.modes[0]).all(-1)]:
        ends = {"xyA": tuple(match.xy[0]), "xyB": tuple(mode), "coordsA": source.transData, "coordsB": target.transData}
        for colour, width in (("black", 1.8), (style.MARK, 0.8)):
            source.figure.add_artist(ConnectionPatch(**ends, color=colour, lw=width, zorder=2))
        style.mark_pixel(target, *mode)


@style.styled
def plot_samples(images: Sequence[np.ndarray], *, columns: int = 6) -> Figure:
    """Contact sheet of (H, W, 3) images of one size."""
    aspect = images[0].shape[0] / images[0].shape[1]
    figure, axes = style.make_grid([aspect] * -(-len(images) // columns), columns, style.PAGE_IN)
    for axis, image in zip(axes.flat, images, strict=False):
        axis.imshow(image)
    for axis in axes.flat[len(images) :]:
        axis.remove()
    return figure


@style.styled
def plot_labels(
    image: np.ndarray, xy: np.ndarray, visible: np.ndarray, *, object: str = "cloth", orbit: Sequence[int] = ()
) -> Figure:
    """Image, and its material points ``xy`` (P, 2) px coloured by place on the object, hidden ones hollow.

    The points of an ``orbit`` are ringed on both.
    """
    figure, axes = style.make_grid([image.shape[0] / image.shape[1]], 2, style.PAGE_IN * 0.7)
    colours = style.compute_point_colours(object, len(xy))
    axes[0, 0].imshow(image)
    axes[0, 1].imshow(style.fade_image(image))
    for axis in axes[0]:
        axis.autoscale(False)
    axes[0, 1].scatter(*xy[~visible].T, s=4, facecolors="none", edgecolors=colours[~visible], linewidths=0.4)
    axes[0, 1].scatter(*xy[visible].T, s=4, c=colours[visible], linewidths=0)
    for axis in axes[0]:
        chosen = xy[list(orbit)].reshape(-1, 2)
        axis.scatter(*chosen.T, s=50, facecolors="none", edgecolors="black", linewidths=2.2)
        axis.scatter(*chosen.T, s=50, facecolors="none", edgecolors=style.MARK, linewidths=1.2)
    return figure


@style.styled
def plot_orbits(image: np.ndarray, xy: np.ndarray, groups: Mapping[str, Sequence[Sequence[int]]]) -> Figure:
    """A panel a symmetry group ({name: orbits, each of indices into ``xy`` (P, 2) px}), an orbit a colour."""
    figure, axes = style.make_grid([image.shape[0] / image.shape[1]], len(groups), style.PAGE_IN)
    for axis, (name, orbits) in zip(axes[0], groups.items(), strict=True):
        axis.imshow(style.fade_image(image))
        axis.autoscale(False)
        for colour, orbit in zip(_ORBIT_COLOURS, orbits, strict=False):
            axis.scatter(*xy[list(orbit)].T, s=26, color=colour, edgecolors="black", linewidths=0.6)
        axis.set_title(name)
    return figure


@style.styled
def plot_variety(tables: Mapping[str, pd.DataFrame], modes: Mapping[str, Mapping[str, Sequence[int]]]) -> Figure:
    """How the images differ, a row an object: states, visible share, hue of object and background, modes a point.

    ``tables`` {object: `mmgsd.dataset.measure_images`}, ``modes`` {object: {group: (P,) modes of each point}}.
    """
    figure, axes = plt.subplots(len(tables), 4, figsize=(style.PAGE_IN, 1.6 * len(tables)), layout="constrained",
                                squeeze=False)  # fmt: skip
    for line, (name, table) in zip(axes, tables.items(), strict=True):
        share = 100 * table.state.value_counts(normalize=True).sort_index()
        line[0].barh(share.index, share, color="0.5")
        line[0].set(xlabel="Images (%)", title=name.capitalize())
        line[1].hist(100 * table.visible, np.arange(0, 101, 5), color="0.5")
        line[1].set(xlabel="Visible material points (%)", ylabel="Images", xlim=(0, 100))
        _draw_hues(line[2], table)
        _draw_modes_a_point(line[3], modes[name])
    return style.finish_axes(figure)


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
