"""Dense features of an image that nothing here trained, and their values at pixels."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mmgsd.model import dinov2
from mmgsd.model.network import IMAGENET_MEAN, IMAGENET_STD, build_trunk, compute_taps, sample_descriptors
from mmgsd.numerics import own_numerics

Extractor = Callable[[np.ndarray], Any]  # (H, W, 3) uint8 -> (D, h, w)
LONGEST_PX = 640  # of what a network is given
MULTIPLE_PX = 32  # that EfficientNet-Lite0's sides are
TAP = 2  # of strides 4, 8, 16 and 32 px, that of 16: on the sample it finds the most


def sample_features(features: Any, xy: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Features (D, h, w) of an image of ``size`` at its pixels ``xy`` (S, 2), of length 1 each: (S, D) float32.

    ValueError for features of another form, or that are not finite.
    """
    values = features.detach().cpu().float().numpy() if isinstance(features, Tensor) else np.asarray(features)
    if values.ndim != 3 or values.dtype.kind not in "iuf":
        raise ValueError(f"extractor must return numbers (D, h, w), got {values.dtype} {values.shape}")
    values = torch.from_numpy(values.astype(np.float32))
    if 0 in values.shape or not values.isfinite().all():
        shape = tuple(values.shape)
        raise ValueError(f"extractor must return finite numbers (D, h, w), got others, or none, in {shape}")
    places = torch.from_numpy(np.asarray(xy, np.float32))[None]
    return F.normalize(sample_descriptors(values[None], places, size)[0], dim=-1).numpy()


@own_numerics()
def extract_imagenet(image: np.ndarray) -> Tensor:
    """Features (D, h, w) of EfficientNet-Lite0 as ImageNet taught it, of an image (H, W, 3) uint8."""
    scale = min(1, LONGEST_PX / max(image.shape[:2]))
    return compute_taps(_load_trunk(), _normalise(image, scale, MULTIPLE_PX))[TAP][0]


@own_numerics()
def extract_dinov2(image: np.ndarray) -> Tensor:
    """Features (384, h, w) of DINOv2's last block for 46 patches along the longer side of an image (H, W, 3) uint8."""
    x = _normalise(image, LONGEST_PX / max(image.shape[:2]), dinov2.PATCH)
    return dinov2.compute_features(x, dinov2.PATCH)[0, -dinov2.WIDTH :]


def _normalise(image: np.ndarray, scale: float, multiple: int) -> Tensor:
    """(1, 3, h, w) of an image, scaled, both sides a ``multiple`` of px, as ImageNet's networks are given images."""
    size = [max(1, round(side * scale / multiple)) * multiple for side in image.shape[1::-1]]
    x = torch.from_numpy(cv2.resize(image, size, interpolation=cv2.INTER_AREA)).permute(2, 0, 1)[None].float() / 255
    return (x - x.new_tensor(IMAGENET_MEAN).view(3, 1, 1)) / x.new_tensor(IMAGENET_STD).view(3, 1, 1)


@cache
def _load_trunk() -> nn.Module:
    return build_trunk().eval()
