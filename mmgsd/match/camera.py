"""Between pixels and rays of a pinhole camera: what a robot needs to reach for a mode."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def compute_rays(xy: ArrayLike, intrinsics: ArrayLike) -> np.ndarray:
    """Unit directions (…, 3) of pixels (…, 2) in the camera's frame: x to the right, y down, z forward, no unit.

    ``intrinsics`` as `read_intrinsics` takes them. Multiplied by z / ray z it is the point at depth z. A pixel that is
    NaN gives NaN. ValueError for other shapes.
    """
    xy, matrix = np.asarray(xy, float), read_intrinsics(intrinsics)
    if xy.ndim < 1 or xy.shape[-1] != 2:
        raise ValueError(f"xy must have shape (…, 2), got {xy.shape}")
    homogeneous = np.concatenate([xy, np.ones_like(xy[..., :1])], -1)
    rays = homogeneous @ np.linalg.inv(matrix).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def read_intrinsics(intrinsics: ArrayLike) -> np.ndarray:
    """The matrix (3, 3) px of a pinhole camera, from itself, from its 9 numbers in order or from fx, fy, cx, cy.

    ValueError for anything else: its last row is 0 0 1, its focal lengths are above 0.
    """
    numbers = np.asarray(intrinsics, float).ravel()
    if numbers.size == 4:
        fx, fy, cx, cy = numbers
        numbers = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    if (numbers.size != 9 or not np.isfinite(numbers).all() or min(numbers[0], numbers[4]) <= 0
            or numbers[6:].tolist() != [0, 0, 1]):  # fmt: skip
        raise ValueError("intrinsics must be a 3 x 3 matrix whose last row is 0 0 1, or fx, fy, cx, cy, px with "
                         f"fx and fy above 0, got {np.asarray(intrinsics).tolist()!r:.200}")  # fmt: skip
    return numbers.reshape(3, 3)
