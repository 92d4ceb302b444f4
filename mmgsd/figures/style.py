"""What the figures share: style, panels that show images, and saving.

Sizes are those of a two-column paper (3.5 and 7.1 in).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import matplotlib
import numpy as np
import seaborn
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from mmgsd.files import atomic_write

if TYPE_CHECKING:
    from mmgsd.match.match import Match

COLUMN_IN, PAGE_IN = 3.5, 7.1  # widths of a column and of a page
MARK = "#FFE100"  # the asked pixel
TRUE = "#00FF6A"  # the sign of true matches
MODE = "#00E0FF"  # that of modes

HEAT = colormaps["inferno"](np.linspace(0.3, 1, 256))[:, :3].astype(np.float32)  # from cold to hot
FAINT = 0.35  # opacity of modes where there is no answer
OPAQUE = 0.05  # weight from which on a mode is drawn in full; with less it fades, and with none it is not seen
LOWEST = 0.75  # height of a panel, at least, by its width
FADED = 0.75  # brightness of an image under a heatmap

_SANS = ["DejaVu Sans"]  # comes with matplotlib: the same letters everywhere
_STYLE = seaborn.axes_style("ticks") | seaborn.plotting_context("paper") | {
    "font.sans-serif": _SANS, "font.size": 7, "axes.labelsize": 7.5, "axes.titlesize": 7.5, "xtick.labelsize": 7,
    "ytick.labelsize": 7, "legend.fontsize": 7, "legend.frameon": False, "axes.linewidth": 0.6, "lines.linewidth": 1.2,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "xtick.major.size": 2.5, "ytick.major.size": 2.5,
    "axes.titlepad": 3, "figure.dpi": 100, "pdf.fonttype": 42, "figure.constrained_layout.h_pad": 0.02,
    "figure.constrained_layout.w_pad": 0.02,
}  # fmt: skip
styled = matplotlib.rc_context(_STYLE)


def save_figure(figure: Figure, path: Path, kinds: Sequence[str] = ("pdf", "png")) -> list[Path]:
    """Write ``path`` as PDF without a date (a second run gives the same bytes) and as PNG of 200 dpi; the paths."""
    written = []
    for kind in kinds:
        metadata = {"CreationDate": None} if kind == "pdf" else None
        target = path.with_suffix(f".{kind}")
        with matplotlib.rc_context(_STYLE), atomic_write(target) as aside:
            figure.savefig(aside, format=kind, dpi=200, metadata=metadata, bbox_inches="tight", pad_inches=0.01)
        written.append(target)
    return written


def compute_point_colours(object: str, count: int) -> np.ndarray:
    """(count, 3) colours: mixed from those of a square cloth's four corners, else in the order of the points."""
    if object != "cloth":
        return colormaps["turbo"](np.linspace(0.05, 0.95, count))[:, :3]
    side = round(count**0.5)
    row, column = (v.ravel()[:, None] for v in np.mgrid[0 : 1 : side * 1j, 0 : 1 : side * 1j])
    corners = np.array([[0.86, 0.08, 0.24], [1.0, 0.75, 0.0], [0.25, 0.1, 0.8], [0.0, 0.7, 0.5]])
    top = corners[0] * (1 - column) + corners[1] * column
    return (1 - row) * top + row * (corners[2] * (1 - column) + corners[3] * column)


def show_source(axis: Axes, match: Match, index: int) -> None:
    """Source image with the pixel of one query."""
    axis.imshow(match.image0)
    height, width = match.image0.shape[:2]
    if height < LOWEST * width:  # a rope laid flat
        axis.set_ylim(height / 2 + LOWEST * width / 2, height / 2 - LOWEST * width / 2)
    axis.autoscale(False)
    mark_pixel(axis, *match.xy[index])


def show_answer(axis: Axes, match: Match, index: int, *, modes: bool = True) -> None:
    """Target with heatmap, and the modes with their 1-std ellipses where asked for."""
    axis.imshow(blend_heatmap(match.image1, match.compute_heatmap(index)))
    axis.autoscale(False)  # a wide ellipse must not shrink the image
    if modes:
        draw_modes(axis, match, index)


def draw_modes(axis: Axes, match: Match, index: int) -> None:
    """Rings at the modes of one query, their area the weight, and the 1-std ellipses; of hidden ones dashed.

    Faint where the query has no answer (`Match.say_presence`), and where a mode has next to no weight.
    """
    opacity, hidden = FAINT if match.say_presence(index) else 1.0, match.find_hidden(index)
    for k in np.flatnonzero(np.isfinite(match.modes[index]).all(-1)):
        radii, angle = compute_ellipse(match.covariances[index, k])
        alpha = opacity * min(1.0, match.weights[index, k] / OPAQUE)
        stroke = {"linestyle": (0, (2, 1.5)) if hidden[k] else "-", "alpha": alpha}
        x, y = match.modes[index, k]
        ellipse = Ellipse((x, y), *(2 * radii), angle=np.degrees(angle), fill=False, ec="white", lw=0.7, **stroke)
        axis.add_patch(ellipse)
        size = 4 + 40 * match.weights[index, k]
        axis.scatter(x, y, s=size, c="none", edgecolors=MODE, linewidths=0.9, **stroke)


def compute_ellipse(covariance: np.ndarray) -> tuple[np.ndarray, float]:
    """The 1-std ellipse of a (2, 2) covariance: its radii (2,), the longer first, and that one's angle in rad."""
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(values[::-1], 0)), np.arctan2(vectors[1, 1], vectors[0, 1])


def mark_pixel(axis: Axes, x: float, y: float) -> None:
    """The sign of an asked pixel."""
    axis.scatter(x, y, s=22, facecolors=MARK, edgecolors="black", linewidths=0.8, zorder=3)


def mark_true(axis: Axes, xy: np.ndarray) -> None:
    """Crosses at true matches (n, 2) px."""
    axis.scatter(*np.transpose(xy), s=22, marker="+", c=TRUE, linewidths=1.0, zorder=3)


def blend_heatmap(image: np.ndarray, heatmap: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: the faded image under the (H, W) heatmap, which is widened a little so as to be seen."""
    strength = compute_strength(heatmap)
    colours = HEAT[(255 * strength).astype(np.uint8)]  # (H, W, 3)
    strength = strength[..., None]
    return (255 * ((1 - strength) * fade_image(image) * FADED + strength * colours)).astype(np.uint8)


def compute_strength(heatmap: np.ndarray) -> np.ndarray:
    """(H, W) float32 in [0, 1], how much of the heat covers the image at each pixel of an (H, W) heatmap."""
    wide = cv2.GaussianBlur(heatmap.astype(np.float32), (0, 0), 0.008 * heatmap.shape[1])
    return np.nan_to_num(np.sqrt(wide / max(wide.max(), 1e-30)))


def fade_image(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) grey in [0.15, 0.85] of an (H, W, 3) uint8 image, stretched so that dark objects show."""
    grey = image.mean(-1, dtype=np.float32)
    low, high = np.percentile(grey[::3, ::3], (1, 99))
    faded = 0.15 + 0.7 * np.clip((grey - low) / max(high - low, 1), 0, 1)
    return np.repeat(faded[..., None].astype(np.float32), 3, axis=-1)


def make_grid(aspects: Sequence[float], columns: int, width: float) -> tuple[Figure, np.ndarray]:
    """Axes without ticks for a table of images, rows of height/width ``aspects``."""
    gap = 0.04  # in
    cell = (width - 0.15) / columns
    height = sum(aspects) * (cell - gap) + 0.2 * len(aspects)
    figure, axes = plt.subplots(len(aspects), columns, figsize=(width, height), height_ratios=aspects, squeeze=False,
                                layout="compressed")  # fmt: skip
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    plt.close(figure)  # a notebook shows what a cell returns; an open figure would appear twice
    return figure, axes


def add_legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """One legend for all lines of the axes, below the figure and at a distance from the axes' labels."""
    figure.get_layout_engine().set(h_pad=0.06)
    entries = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=4, handlelength=1.6)


def name_grid(axes: Sequence[Axes]) -> None:
    """Ticks and names of maps over the cloth's 25 × 25 material points, in a row."""
    for axis in axes:
        axis.set(xticks=[0, 12, 24], yticks=[0, 12, 24], xlabel="Column of the grid")
    axes[0].set_ylabel("Row of the grid")


def finish_axes(figure: Figure, *, keep_box: Sequence[Axes] = ()) -> Figure:
    """Take the upper and right spines away, but for ``keep_box``, and close the figure for pyplot."""
    for axis in figure.axes:
        axis.tick_params(labelsize=7)
        if axis not in list(keep_box):
            seaborn.despine(ax=axis)
    plt.close(figure)
    return figure
