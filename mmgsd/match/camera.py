"""Between pixels and rays of a pinhole camera: what a robot needs to reach for a mode."""

from __future__ import annotations

import numpy as np


def compute_rays(xy: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Unit directions (…, 3) of pixels (…, 2) in the camera's frame: x to the right, y down, z forward, no unit.

    ``intrinsics`` (3, 3) or its 9 numbers in order, px, as in a data set's table of labels. Multiplied by z / ray z
    it is the point at depth z. A pixel that is NaN gives NaN. ValueError for other shapes.
    """
    xy, matrix = _check(xy, 2, "xy"), _check_intrinsics(intrinsics)
    homogeneous = np.concatenate([xy, np.ones_like(xy[..., :1])], -1)
    rays = homogeneous @ np.linalg.inv(matrix).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def compute_pixels(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels (…, 2) of rays or points (…, 3) in the camera's frame, any unit; NaN where z is not in front of it.

    The inverse of `compute_rays`. ValueError for other shapes.
    """
    points, matrix = _check(points, 3, "points"), _check_intrinsics(intrinsics)
    projected = points @ matrix.T
    depth = np.where(points[..., 2:] > 0, projected[..., 2:], np.nan)
    return projected[..., :2] / depth


def _check(values: np.ndarray, last: int, name: str) -> np.ndarray:
    values = np.asarray(values, float)
    if values.ndim < 1 or values.shape[-1] != last:
        raise ValueError(f"{name} must have shape (…, {last}), got {values.shape}")
    return values


def _check_intrinsics(intrinsics: np.ndarray) -> np.ndarray:
    matrix = np.asarray(intrinsics, float)
    if matrix.size != 9 or matrix.reshape(3, 3)[2].tolist() != [0, 0, 1]:
        raise ValueError(f"intrinsics must be a 3 x 3 matrix whose last row is 0 0 1, got {matrix.tolist()}")
    return matrix.reshape(3, 3)
