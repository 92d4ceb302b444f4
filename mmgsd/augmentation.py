"""Training images in memory, and augmented batches of them: labels move as the pixels do."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from mmgsd.config import TrainConfig
from mmgsd.dataset import Dataset
from mmgsd.network import compute_input_size

CACHE_SCALE = 1.25  # images are kept in memory at this multiple of the network's input size


@dataclass(frozen=True)
class TrainingImages:
    """A data set's images in memory at about the network's resolution, labels in full-image px."""

    images: list[np.ndarray]  # N of (h, w, 3) uint8
    masks: list[np.ndarray]  # N of (h, w) uint8, 255 on the object
    xy: np.ndarray  # (N, P, 2) px
    visible: np.ndarray  # (N, P) bool
    size: tuple[int, int]  # full (W, H) px
    mirror: np.ndarray | None = None  # (P,) where each point goes in a mirror image


@dataclass(frozen=True)
class Batch:
    """Augmented images as tensors."""

    image: Tensor  # (B, 3, h, w) in [0, 1]
    mask: Tensor  # (B, h, w) bool
    xy: Tensor  # (B, P, 2) full-image px
    askable: Tensor  # (B, P) bool, points visible and inside
    inside: Tensor  # (B, P) bool


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


def load_training_images(data: Dataset, input_px: int, *, indices: np.ndarray | None = None) -> TrainingImages:
    """Read images and masks once, reduced to a little more than the network's input size."""
    indices = np.arange(len(data)) if indices is None else indices
    width, height = (round(s * CACHE_SCALE) for s in compute_input_size(data.size, input_px))

    def load(index: int) -> tuple[np.ndarray, np.ndarray]:
        image, mask = data.load_image(index), data.load_mask(index).astype(np.uint8) * 255
        return tuple(cv2.resize(a, (width, height), interpolation=cv2.INTER_AREA) for a in (image, mask))

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        images, masks = zip(*pool.map(load, indices), strict=True)
    labels = data.xy[indices], data.visible[indices]
    return TrainingImages(list(images), list(masks), *labels, data.size, data.mirror)


def make_batch(
    images: TrainingImages, indices: np.ndarray, config: TrainConfig, rng: np.random.Generator, device: torch.device
) -> Batch:
    """Augment the images ``indices`` (B,), labels with them, and move them to the device.

    Half of them are mirrored where the object has a mirror image.
    """
    size = compute_input_size(images.size, config.input_px)
    visible = images.visible[indices].copy()  # (B, P)
    pixels, masks, points = [], [], []
    for k, index in enumerate(indices):
        affine, xy = np.eye(2, 3), images.xy[index]
        if config.augment:
            affine = sample_affine(images.size, rng, rotate=config.rotate)
            if images.mirror is not None and rng.random() < 0.5:
                affine = affine @ [[-1, 0, images.size[0] - 1], [0, 1, 0], [0, 0, 1]]
                xy, visible[k] = xy[images.mirror], visible[k][images.mirror]
        image = warp_image(images.images[index], affine, images.size, size)
        pixels.append(jitter_colours(image, rng) if config.augment else image)
        masks.append(warp_image(images.masks[index], affine, images.size, size) > 127)
        points.append(warp_points(xy, affine))
    xy = np.stack(points)
    inside = np.all((xy > -0.5) & (xy < np.array(images.size) - 0.5), axis=-1)
    image = torch.from_numpy(np.stack(pixels)).to(device).permute(0, 3, 1, 2).float() / 255
    tensors = (torch.from_numpy(a).to(device) for a in (np.stack(masks), xy.astype(np.float32)))
    askable = torch.from_numpy(inside & visible).to(device)
    return Batch(image, *tensors, askable, torch.from_numpy(inside).to(device))
