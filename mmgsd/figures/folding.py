"""Rollouts of folding as pictures: what was shown, what was found, and what each policy made of it."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.figures.style import MARK, PAGE_IN, check_filled, make_grid, mark_pixel, styled

THUMBNAIL_PX = 160  # sides of a picture
PANEL_IN = 2.4  # width of a picture with moves


@styled
def plot_moves(pictures: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Pictures beside each other, each (H, W, 3) uint8 with its moves (M, 2, 2) px: an arrow from pick to place.

    The keys are the titles. ValueError where there is no picture.
    """
    check_filled("pictures", pictures)
    aspects = [max(image.shape[0] / image.shape[1] for image, _ in pictures.values())]
    figure, axes = make_grid(aspects, len(pictures), min(PAGE_IN, PANEL_IN * len(pictures)))
    for axis, (title, (image, moves)) in zip(axes[0], pictures.items(), strict=True):
        axis.imshow(image)
        axis.autoscale(False)  # a place may lie outside
        for pick, place in np.asarray(moves, float).reshape(-1, 2, 2):
            for colour, width in (("black", 2.6), (MARK, 1.4)):  # seen on any ground
                axis.annotate("", place, pick, arrowprops={"arrowstyle": "->", "color": colour, "lw": width})
            mark_pixel(axis, *pick)
        axis.set_title(title)
    return figure


@styled
def plot_rollouts(pictures: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """A row for each task, a column for each of its pictures (H, W, 3) uint8: {task's label: {what it shows: picture}}.

    ValueError where there is no task, or tasks have other columns.
    """
    check_filled("pictures", pictures)
    columns = list(next(iter(pictures.values())))
    for task, row in pictures.items():
        if list(row) != columns:
            raise ValueError(f"pictures must have the columns {columns} for each task, got {list(row)} of {task!r}")
    width = PAGE_IN / len(columns)
    figure, axes = plt.subplots(len(pictures), len(columns), figsize=(PAGE_IN, width * len(pictures) + 0.3),
                                layout="constrained", squeeze=False)  # fmt: skip
    for line, (task, row) in zip(axes, pictures.items(), strict=True):
        for axis, picture in zip(line, row.values(), strict=True):
            axis.imshow(crop_square(picture))
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        line[0].set_ylabel(task, fontsize=7)
    for axis, shown in zip(axes[0], columns, strict=True):
        axis.set_title(shown, fontsize=7)
    plt.close(figure)  # a notebook shows what a cell returns; an open figure would appear twice
    return figure


def crop_square(picture: np.ndarray) -> np.ndarray:
    """The middle square of a picture (H, W, 3), `THUMBNAIL_PX` wide."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return cv2.resize(picture[top : top + side, left : left + side], (THUMBNAIL_PX, THUMBNAIL_PX),
                      interpolation=cv2.INTER_AREA)  # fmt: skip
