"""Geometric and photometric augmentation: labels move as the pixels do."""

from __future__ import annotations

import cv2
import numpy as np


def sample_affine(
    size: tuple[int, int], rng: np.random.Generator, *, rotate: bool = True, scale: float = 0.2, shift: float = 0.06
) -> np.ndarray:
    """A random similarity of the image plane about the image's centre, as a (2, 3) matrix on full-image px.

    Angle uniform over the circle (0 without ``rotate``), size times exp(± ``scale``), moved by up to ``shift`` of the
    image's size.
    """
    width, height = size
    angle = rng.uniform(-np.pi, np.pi) if rotate else 0.0
    zoom = np.exp(rng.uniform(-scale, scale))
    cosine, sine = zoom * np.cos(angle), zoom * np.sin(angle)
    linear = np.array([[cosine, -sine], [sine, cosine]])
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    move = rng.uniform(-shift, shift, 2) * (width, height)
    return np.column_stack([linear, centre - linear @ centre + move])


def warp_points(xy: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Apply a (2, 3) ``affine`` to (..., 2) px."""
    return xy @ affine[:, :2].T + affine[:, 2]


def warp_image(image: np.ndarray, affine: np.ndarray, full: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Apply a full-image ``affine`` to a (possibly smaller) copy of the image and resample it to ``size``.

    ``image`` (h, w, 3) uint8 or (h, w) uint8, of any resolution of an image of ``full`` = (W, H) px. What enters from
    outside is mirrored background, or nothing (0) for a mask. Returns (size[1], size[0], …).
    """
    to_full = compute_scaling((image.shape[1], image.shape[0]), full)
    matrix = compute_scaling(full, size) @ np.vstack([affine, [0, 0, 1]]) @ to_full
    border = cv2.BORDER_CONSTANT if image.ndim == 2 else cv2.BORDER_REFLECT_101
    return cv2.warpAffine(image, matrix[:2], size, flags=cv2.INTER_LINEAR, borderMode=border)


def compute_scaling(source: tuple[int, int], target: tuple[int, int]) -> np.ndarray:
    """(3, 3) matrix from px of a ``source``-sized image to px of its ``target``-sized copy, pixel centres integer."""
    sx, sy = target[0] / source[0], target[1] / source[1]
    return np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])


def jitter_colours(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random gain and offset of each channel, gamma, mixed channels and noise, on (h, w, 3) uint8; returns uint8."""
    values = np.arange(256) / 255
    gamma, gain, offset = np.exp(rng.uniform(-0.3, 0.3)), rng.uniform(0.75, 1.25, 3), rng.uniform(-0.08, 0.08, 3)
    table = values[:, None] ** gamma * gain + offset  # (256, 3)
    table = (table.clip(0, 1) * 255).astype(np.uint8)
    image = np.stack([table[image[..., c], i] for i, c in enumerate(rng.permutation(3))], axis=-1)
    if rng.random() < 0.5:
        noise = rng.normal(0, rng.uniform(0, 10), image.shape)
        image = (image + noise).clip(0, 255).astype(np.uint8)
    return image
