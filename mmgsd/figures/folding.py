"""Rollouts of folding as pictures: what was shown, what was found, and what each policy made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill

import cv2
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

from mmgsd.figures.style import MARK, PAGE_IN, make_grid, mark_pixel, styled
from mmgsd.files import atomic_write

THUMBNAIL_PX, FRAME_PX = 160, 5  # sides of a picture, and of the frame that says whether it is a success
WRAPPED, ACROSS = 13, 120  # letters of a line beside such a picture, and of the lines above a row of them
SLIDE_PX, SLIDE_MS = 300, 1400  # sides of a slide's pictures, and how long it is shown
PANEL_IN = 2.4  # width of a picture with moves


@styled
def plot_moves(pictures: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Pictures beside each other, each (H, W, 3) uint8 with its moves (M, 2, 2) px: an arrow from pick to place.

    The keys are the titles.
    """
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
    """A row for each task, a column for each of its pictures: {task's label: {what it shows: (H, W, 3) uint8}}."""
    columns = list(next(iter(pictures.values())))
    width = PAGE_IN / len(columns)
    figure, axes = plt.subplots(len(pictures), len(columns), figsize=(PAGE_IN, width * len(pictures) + 0.3),
                                layout="constrained", squeeze=False)  # fmt: skip
    for line, (task, row) in zip(axes, pictures.items(), strict=True):
        for axis, picture in zip(line, row.values(), strict=True):
            axis.imshow(crop_square(picture))
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        line[0].set_ylabel(fill(task, WRAPPED), fontsize=6)
    for axis, title in zip(axes[0], columns, strict=True):
        axis.set_title(fill(title, max(6, ACROSS // len(columns)), break_long_words=False), fontsize=6)
    plt.close(figure)  # a notebook shows what a cell returns; an open figure would appear twice
    return figure


def mark_moves(picture: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) uint8 with moves (M, 2, 2) px: an arrow from each pick to its place."""
    drawn = picture.copy()
    for pick, place in np.rint(np.asarray(moves, float).reshape(-1, 2, 2)).astype(int).tolist():
        for colour, width in ((0, 0, 0), 7), ((255, 225, 0), 3):  # seen on any ground
            cv2.arrowedLine(drawn, pick, place, colour, width, cv2.LINE_AA, tipLength=0.08)
            cv2.circle(drawn, pick, width + 3, colour, -1, cv2.LINE_AA)
    return drawn


def save_slides(slides: Sequence[tuple[np.ndarray, np.ndarray]], path: Path) -> Path:
    """Write pairs of pictures (H, W, 3) uint8, their middle squares, as an animated WebP without end; its path."""
    frames = [Image.fromarray(np.hstack([crop_square(one, SLIDE_PX) for one in pair])) for pair in slides]
    with atomic_write(path) as aside:
        frames[0].save(aside, "WEBP", save_all=True, append_images=frames[1:], duration=SLIDE_MS, loop=0, quality=80)
    return path


def mark_success(picture: np.ndarray, success: bool) -> np.ndarray:
    """The middle square of a picture (H, W, 3) uint8 in a frame, green for a success and red for none."""
    framed = crop_square(picture).copy()
    cv2.rectangle(framed, (0, 0), (THUMBNAIL_PX - 1,) * 2, (0, 170, 80) if success else (215, 40, 40), 2 * FRAME_PX)
    return framed


def crop_square(picture: np.ndarray, size_px: int = THUMBNAIL_PX) -> np.ndarray:
    """The middle square of a picture (H, W, 3), ``size_px`` wide."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    return cv2.resize(picture[top : top + side, left : left + side], (size_px, size_px), interpolation=cv2.INTER_AREA)
