"""Points, angles, cameras and random draws that several builders of a scene need; without Blender."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; the centre of the top-left pixel is (0, 0), x = column."""

    intrinsics: np.ndarray  # (3, 3)
    pose: np.ndarray  # (4, 4) camera to world, OpenCV axes (x right, y down, z forward)
    size: tuple[int, int]  # (width, height) px

    @classmethod
    def build(cls, rotation: np.ndarray, place: np.ndarray, focal: float, size: tuple[int, int]) -> Camera:
        """Of a rotation (3, 3) to the world, a place (3,) m, a focal length (px) and a size (width, height) px."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, place
        return cls(np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]]), pose, size)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of world points (N, 3) m."""
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        image = local @ self.intrinsics.T
        return image[:, :2] / image[:, 2:]

    def contains(self, xy: np.ndarray) -> np.ndarray:
        """Which pixels (N, 2) round to a pixel of the image: (N,) bool."""
        return np.all((xy > -0.5) & (xy < np.array(self.size) - 0.5), axis=1)


def spin(angle: float) -> np.ndarray:
    """The rotation (3, 3) by an angle (rad) about the vertical."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def compute_direction(elevation: float, azimuth: float) -> np.ndarray:
    """Unit vector (3,) towards an elevation above the horizon and an azimuth (rad)."""
    return np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])


def find_middle(points: np.ndarray) -> np.ndarray:
    """Centre (D,) of the bounding box of points (N, D)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def measure_arc(points: np.ndarray) -> np.ndarray:
    """Lengths (N,) along a polyline (N, D) from its start to each of its points."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def grid_faces(rows: int, columns: int, *, closed: bool = False) -> np.ndarray:
    """Quads (F, 4) of a row-major grid of vertices; a ``closed`` one goes on from its last column to its first."""
    row, column = np.mgrid[: rows - 1, : columns if closed else columns - 1]
    after = (column + 1) % columns
    corners = [row * columns + column, row * columns + after, (row + 1) * columns + after, (row + 1) * columns + column]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def choose(rng: np.random.Generator, shares: Mapping[str, float]) -> str:
    """One of the names, each with the probability that ``shares`` gives it; they must sum to 1."""
    return str(rng.choice(list(shares), p=list(shares.values())))


def log_uniform(rng: np.random.Generator, low: float, high: float, size: int | None = None) -> np.ndarray | float:
    """A number, or ``size`` of them, from ``low`` to ``high``: each doubling is as likely as any other."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))
