"""A video with truth for every frame: a sample's object, cut out and turned, scaled and shifted over a ground."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mmgsd.dataset import load_dataset

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "sample"


@dataclass(frozen=True)
class Video:
    """T frames of an object, and where its P material points are."""

    frames: np.ndarray  # (T, H, W, 3) uint8
    xy: np.ndarray  # (T, P, 2) px
    visible: np.ndarray  # (T, P) bool


def turn_sample(object: str, index: int, *, count: int = 24, degrees: float = 180.0) -> Video:
    """The ``index``-th test image's object, from beginning to end turned by so many ``degrees``."""
    data = load_dataset(SAMPLE / object, "test")
    image, mask, xy = data.load_image(index), data.load_mask(index), data.xy[index]
    width, height = data.size
    middle = np.array([width - 1, height - 1]) / 2
    ground = cv2.GaussianBlur(np.random.default_rng(0).integers(40, 150, (height, width, 3), np.uint8), (0, 0), 9)
    frames, places, seen = [], [], []
    for share in np.linspace(0, 1, count):
        angle, scale = np.radians(degrees) * share, 0.72 + 0.06 * np.sin(2 * np.pi * share)
        matrix = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        aim = middle + 0.05 * width * np.array([np.sin(np.pi * share), np.sin(2 * np.pi * share)])
        affine = np.column_stack([matrix, aim - matrix @ xy[data.visible[index]].mean(0)])
        cut = cv2.warpAffine(mask.astype(np.float32), affine, data.size, flags=cv2.INTER_AREA)[..., None]
        moved = cv2.warpAffine(image, affine, data.size, flags=cv2.INTER_AREA)
        frames.append(np.rint(moved * cut + ground * (1 - cut)).astype(np.uint8))
        places.append(xy @ matrix.T + affine[:, 2])
        seen.append(data.visible[index] & ((places[-1] >= 0) & (places[-1] <= (width - 1, height - 1))).all(1))
    return Video(np.stack(frames), np.stack(places), np.stack(seen))
