"""Between pixels and rays of a pinhole camera: what a robot needs to reach for a mode."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def compute_rays(xy: ArrayLike, intrinsics: ArrayLike) -> np.ndarray:
    """Unit directions (…, 3) of pixels (…, 2) in the camera's frame: x to the right, y down, z forward, no unit.

    ``intrinsics`` as `read_intrinsics` takes them. Multiplied by z / ray z it is the point at depth z. A pixel that is
    NaN gives NaN. ValueError for other shapes.
    """
    xy, matrix = _check(xy, 2, "xy"), read_intrinsics(intrinsics)
    homogeneous = np.concatenate([xy, np.ones_like(xy[..., :1])], -1)
    rays = homogeneous @ np.linalg.inv(matrix).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def compute_pixels(points: ArrayLike, intrinsics: ArrayLike) -> np.ndarray:
    """Pixels (…, 2) of rays or points (…, 3) in the camera's frame, any unit; NaN where z is not in front of it.

    The inverse of `compute_rays`. ValueError for other shapes.
    """
    points, matrix = _check(points, 3, "points"), read_intrinsics(intrinsics)
    projected = points @ matrix.T
    depth = np.where(points[..., 2:] > 0, projected[..., 2:], np.nan)
    return projected[..., :2] / depth


def _check(values: np.ndarray, last: int, name: str) -> np.ndarray:
    values = np.asarray(values, float)
    if values.ndim < 1 or values.shape[-1] != last:
        raise ValueError(f"{name} must have shape (…, {last}), got {values.shape}")
    return values


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
