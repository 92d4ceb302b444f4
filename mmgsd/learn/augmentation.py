"""Training images in memory, and augmented batches of them: labels move as the pixels do."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from mmgsd.config import TrainConfig
from mmgsd.dataset import Dataset
from mmgsd.learn.compositing import composite, disturb, fill_object
from mmgsd.learn.texturing import retexture
from mmgsd.model.network import compute_input_size

CACHE_SCALE = 1.25  # images are kept in memory at this multiple of the network's input size
SHIFT, SCALE = 0.06, 0.2  # the most that an image is moved, of its size, and the log of its zoom
STRONG_SHIFT, STRONG_SCALE = 0.15, 0.35  # where augmentation is strong: objects are cut off by the image's border
RETEXTURED = 0.5  # share of the images whose object has another texture then
WAVES = 4  # that bend an image
BEND_ITERATIONS = 12


@dataclass(frozen=True)
class TrainingImages:
    """A data set's images in memory at about the network's resolution, labels in full-image px."""

    images: list[np.ndarray]  # N of (h, w, 3) uint8
    masks: list[np.ndarray]  # N of (h, w) uint8, 255 on the object
    xy: np.ndarray  # (N, P, 2) px
    visible: np.ndarray  # (N, P) bool
    size: tuple[int, int]  # full (W, H) px
    mirror: np.ndarray | None = None  # (P,) where each point goes in a mirror image
    present: np.ndarray | None = None  # (N,) bool, images that show the object; None: all of them


@dataclass(frozen=True)
class Batch:
    """Augmented images as tensors."""

    image: Tensor  # (B, 3, h, w) in [0, 1]
    mask: Tensor  # (B, h, w) bool
    xy: Tensor  # (B, P, 2) full-image px
    askable: Tensor  # (B, P) bool, points visible and inside
    inside: Tensor  # (B, P) bool, visible or not; none where the object is not present


@dataclass(frozen=True)
class Warp:
    """A smooth map of the image plane, in full-image px: an affine one, then gentle waves that bend it.

    Built from where a pixel of the new image comes from, ``find_grid_source``; ``move`` is the inverse.
    """

    affine: np.ndarray  # (2, 3)
    amplitudes: np.ndarray  # (K, 2) px
    wave_vectors: np.ndarray  # (K, 2) rad/px
    phases: np.ndarray  # (K,) rad

    def find_grid_source(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Old px of every new px of a grid, (rows, columns, 2): the sine of a sum by the sines of its parts."""
        across = columns[:, None] * self.wave_vectors[:, 0]  # (columns, K)
        down = rows[:, None] * self.wave_vectors[:, 1] + self.phases  # (rows, K)
        parts = np.concatenate([np.cos(down), np.sin(down)], axis=1)  # (rows, 2 K)
        waves = np.concatenate([np.sin(across), np.cos(across)], axis=1)  # (columns, 2 K)
        bend = np.einsum("rk,ck,kd->rcd", parts, waves, np.tile(self.amplitudes, (2, 1)), optimize=True)
        bent = np.stack(np.meshgrid(columns, rows), axis=-1) + bend
        return (bent - self.affine[:, 2]) @ np.linalg.inv(self.affine[:, :2]).T

    def move(self, xy: np.ndarray) -> np.ndarray:
        """New px of old px (..., 2); exact to 0.02 px."""
        straight = xy @ self.affine[:, :2].T + self.affine[:, 2]
        moved = straight
        for _ in range(BEND_ITERATIONS):  # a contraction: the waves' slopes sum to 0.5 at most
            moved = straight - np.sin(moved @ self.wave_vectors.T + self.phases) @ self.amplitudes
        return moved


UNCHANGED = Warp(np.eye(2, 3), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def sample_warp(
    size: tuple[int, int], rng: np.random.Generator, *, rotate: bool = True, scale: float = SCALE,
    shift: float = SHIFT, bend: float = 0.0,
) -> Warp:  # fmt: skip
    """A random similarity of the image plane about the image's centre, bent by ``WAVES`` random waves.

    Angle uniform over the circle (0 without ``rotate``), size times exp(± ``scale``), moved by up to ``shift`` of the
    image's size; the waves are half to a whole image long and stretch or squeeze by up to ``bend`` in all.
    """
    width, height = size
    angle = rng.uniform(-np.pi, np.pi) if rotate else 0.0
    zoom = np.exp(rng.uniform(-scale, scale))
    cosine, sine = zoom * np.cos(angle), zoom * np.sin(angle)
    linear = np.array([[cosine, -sine], [sine, cosine]])
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    move = rng.uniform(-shift, shift, 2) * (width, height)
    affine = np.column_stack([linear, centre - linear @ centre + move])
    direction, towards = rng.uniform(0, 2 * np.pi, (2, WAVES))
    number = rng.uniform(1, 2, WAVES) * 2 * np.pi / max(size)  # rad/px
    amplitude = rng.uniform(0, bend / WAVES, WAVES) / number
    waves, pushes = (np.stack([np.cos(a), np.sin(a)], axis=-1) for a in (direction, towards))
    return Warp(affine, amplitude[:, None] * pushes, number[:, None] * waves, rng.uniform(0, 2 * np.pi, WAVES))


def warp_images(
    images: Sequence[np.ndarray], warp: Warp, full: tuple[int, int], size: tuple[int, int]
) -> list[np.ndarray]:
    """Apply a ``warp`` to (possibly smaller) copies of an image and resample them to ``size``.

    ``images`` (h, w, 3) uint8 or (h, w) uint8, all of one resolution, of an image of ``full`` = (W, H) px. What
    enters from outside is mirrored background, or nothing (0) for a mask. Returns (size[1], size[0], …) each.
    """
    columns, rows = (rescale(np.arange(n), n, whole) for n, whole in zip(size, full, strict=True))
    grid = warp.find_grid_source(columns, rows)
    source = rescale(grid, full, images[0].shape[1::-1]).astype(np.float32)
    borders = [cv2.BORDER_CONSTANT if image.ndim == 2 else cv2.BORDER_REFLECT_101 for image in images]
    return [cv2.remap(image, source, None, cv2.INTER_LINEAR, borderMode=border)
            for image, border in zip(images, borders, strict=True)]  # fmt: skip


def rescale(positions: np.ndarray, source: ArrayLike, target: ArrayLike) -> np.ndarray:
    """Px of an image with ``source`` px a side as px of its copy with ``target``, pixel centres integer."""
    return (positions + 0.5) * (np.asarray(target) / np.asarray(source)) - 0.5


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


def load_training_images(data: Dataset, input_px: int) -> TrainingImages:
    """Read images and masks once, reduced to a little more than the network's input size."""
    width, height = (round(s * CACHE_SCALE) for s in compute_input_size(data.size, input_px))

    def load(index: int) -> tuple[np.ndarray, np.ndarray]:
        """One image and its mask, reduced."""
        image, mask = data.load_image(index), data.load_mask(index).astype(np.uint8) * 255
        return tuple(cv2.resize(a, (width, height), interpolation=cv2.INTER_AREA) for a in (image, mask))

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        images, masks = map(list, zip(*pool.map(load, range(len(data))), strict=True))
    return TrainingImages(images, masks, data.xy, data.visible, data.size, data.mirror, data.present)


def make_batch(
    images: TrainingImages, indices: np.ndarray, config: TrainConfig, rng: np.random.Generator, device: torch.device
) -> Batch:
    """Augment the images ``indices`` (B,), labels with them, and move them to the device.

    Half of them are mirrored where the object has a mirror image, so that it keeps its heading where ``config.rotate``
    is off; with ``config.clutter`` they are also put together
    anew (`mmgsd.learn.compositing`), with ``config.strong`` retextured (`mmgsd.learn.texturing`).
    """
    samples = [_make_one(images, int(index), config, rng) for index in indices]
    image, mask, xy, visible, present = (np.stack(values) for values in zip(*samples, strict=True))
    inside = np.all((xy > -0.5) & (xy < np.array(images.size) - 0.5), axis=-1) & present[:, None]
    image = torch.from_numpy(image).to(device).permute(0, 3, 1, 2).float() / 255
    tensors = (torch.from_numpy(a).to(device) for a in (mask, xy.astype(np.float32), inside & visible, inside))
    return Batch(image, *tensors)


def _make_one(images: TrainingImages, index: int, config: TrainConfig, rng: np.random.Generator) -> tuple:
    """One augmented image (h, w, 3) uint8, its mask (h, w) bool, points (P, 2) px, which are visible, and presence."""
    size, warp, xy = compute_input_size(images.size, config.input_px), UNCHANGED, images.xy[index]
    visible, present = images.visible[index], images.present is None or bool(images.present[index])
    if config.augment:
        reach = {"scale": STRONG_SCALE, "shift": STRONG_SHIFT} if config.strong else {}
        warp = sample_warp(images.size, rng, rotate=config.rotate, bend=config.bend, **reach)
        if images.mirror is not None and rng.random() < 0.5:
            warp = dataclasses.replace(warp, affine=warp.affine @ _make_mirror(images, rotate=config.rotate))
            xy, visible = xy[images.mirror], visible[images.mirror]
    planes = [images.images[index], images.masks[index]]
    if config.strong:
        image, mask = _warp_once(planes, warp, images.size, size)
    else:
        image, mask = warp_images(planes, warp, images.size, size)
    xy = warp.move(xy)
    if config.strong and present and rng.random() < RETEXTURED:
        there = rescale(xy, images.size, size)
        image = retexture(image, mask, there, visible, config.object, lambda: _borrow(images, rng), rng)
    if config.clutter:
        beside = not config.strong or config.object == "rope"
        composited = composite(image, mask, lambda: _borrow(images, rng), rng, lookalikes_beside=beside)
        image, mask, present = composited.image, composited.mask, present and composited.present
        visible = visible & ~_look_up(composited.covered, xy, images.size) & present
    image = jitter_colours(image, rng) if config.augment else image
    return disturb(image, rng) if config.clutter else image, mask > 127, xy, visible, present


def _make_mirror(images: TrainingImages, *, rotate: bool) -> np.ndarray:
    """(3, 3) columns backwards, or rows where points keep their order, as a rope's, and it must not ``rotate``."""
    (width, height), same = images.size, np.array_equal(images.mirror, np.arange(len(images.mirror)))
    if same and not rotate:  # columns backwards turn it end for end
        return np.array([[1, 0, 0], [0, -1, height - 1], [0, 0, 1]])
    return np.array([[-1, 0, width - 1], [0, 1, 0], [0, 0, 1]])


def _warp_once(
    planes: list[np.ndarray], warp: Warp, full: tuple[int, int], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """`warp_images` of an image and its mask, without what the mirrored background shows of the object once more."""
    image, mask = warp_images([np.dstack(planes), planes[1]], warp, full, size)
    copies = np.where(mask > 0, 0, image[..., 3])
    image = np.ascontiguousarray(image[..., :3])
    return (fill_object(image, copies) if copies.any() else image), mask


def _borrow(images: TrainingImages, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    index = int(rng.integers(len(images.images)))
    return images.images[index], images.masks[index]


def _look_up(covered: np.ndarray, xy: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which of the px (P, 2) of an image of ``size`` are covered in its copy (h, w) bool."""
    columns, rows = np.rint(rescale(xy, size, covered.shape[::-1])).astype(int).T
    return covered[rows.clip(0, covered.shape[0] - 1), columns.clip(0, covered.shape[1] - 1)]
