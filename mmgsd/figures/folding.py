"""Rollouts of folding as pictures: what was shown, what was found, and what each policy made of it."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.figures.style import PAGE_IN, check_filled, styled

THUMBNAIL_PX = 160  # sides of a picture


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
    return figure


def crop_square(picture: np.ndarray) -> np.ndarray:
    """The middle square of a picture (H, W, 3), `THUMBNAIL_PX` wide."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return cv2.resize(picture[top : top + side, left : left + side], (THUMBNAIL_PX, THUMBNAIL_PX),
                      interpolation=cv2.INTER_AREA)  # fmt: skip
