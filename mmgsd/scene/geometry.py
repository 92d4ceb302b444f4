"""What several builders and cameras compute of points and angles."""

from __future__ import annotations

import numpy as np


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
