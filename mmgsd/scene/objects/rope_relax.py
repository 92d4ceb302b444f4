"""Settles a rope's particles on the table: an elastic beam under gravity that cannot pass through itself.

Position-based and quasi-static, all lengths in diameters of the rope. The rope's length is not conserved
while it settles (a knot tightens as rope slides out of it): material points are placed afterwards, equally spaced.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mmgsd.scene.geometry import measure_arc

STEP = 1 / 3  # distance between particles, in diameters
EXCLUDE = 2.2  # contact is not tested between parts nearer than this along the rope, in diameters
REST_RADIUS = 2.0  # of the tightest bend a rope likes to keep, in diameters
MIN_RADIUS = 1.7  # of a bend, in diameters: below about 1 a rope's inner side folds into itself
STRIDES = (1, 2)  # of the beam: the longer one carries bends over long distances in few rounds
ROUNDS = 400
GRAVITY = 0.004  # diameters a round; against the beam's stiffness it gives a lifted strand its span
CLEARANCE = 1.04  # distance between particles that contact restores, in diameters: strands come 3 % nearer between them


def relax(points: np.ndarray, tension: np.ndarray, ball_radius: float) -> np.ndarray:
    """Settle particles (N, 3), in diameters, on the table: bending, tension (N,), gravity and contact in turn."""
    points = points.copy()
    rests = {stride: _residual(points, 0.0, stride) for stride in STRIDES}
    for stride, rest in rests.items():
        most = (stride * STEP) ** 2 / (2 * REST_RADIUS)
        rests[stride] = (rest[:, :2] * _normals(points, stride)).sum(1).clip(-most, most)
    floor = np.full(len(points), 0.5)
    floor[0] = max(0.5, ball_radius)
    for step in range(ROUNDS):
        if step % 4 == 0:
            pairs, reach = near_pairs(points, ball_radius)
        pull = tension * min(1.0, 2 * step / ROUNDS, 4 - 4 * step / ROUNDS)  # rises, and is let go at the end
        for stride, rest in rests.items():
            bend(points, rest * (1 - pull[stride:-stride]), stride)
        points[1:-1] -= 0.15 * pull[1:-1, None] * _residual(points, 0.0, 1)
        points[:, 2] -= GRAVITY
        for stride in (2, 3):
            limit_bends(points, stride)
        push_apart(points, pairs, reach)
        np.maximum(points[:, 2], floor, out=points[:, 2])
    return points


def _normals(points: np.ndarray, stride: int) -> np.ndarray:
    """Unit normals in the plane (N - 2 stride, 2), left of the chord between neighbours ``stride`` away; 0 of none."""
    chord = points[2 * stride :, :2] - points[: -2 * stride, :2]
    length = np.linalg.norm(chord, axis=1, keepdims=True)
    return np.stack([-chord[:, 1], chord[:, 0]], axis=1) / np.maximum(length, 1e-9)


def _residual(points: np.ndarray, rest: np.ndarray | float, stride: int) -> np.ndarray:
    """Where inner particles lie (N - 2 stride, 3), seen from ``rest`` to the left of their neighbours' midpoint."""
    residual = points[stride:-stride] - (points[2 * stride :] + points[: -2 * stride]) / 2
    residual[:, :2] -= np.reshape(rest, (-1, 1)) * _normals(points, stride)
    return residual


def bend(points: np.ndarray, rest: np.ndarray | float, stride: int) -> None:
    """One descent step on an elastic beam's energy, the sum of squared residuals: bends go back to their rest."""
    residual = 0.35 * _residual(points, rest, stride)
    points[stride:-stride] -= residual
    points[2 * stride :] += residual / 2
    points[: -2 * stride] += residual / 2


def limit_bends(points: np.ndarray, stride: int) -> None:
    """Open bends that are tighter than MIN_RADIUS, seen over a stride of particles."""
    chord = (points[2 * stride :] + points[: -2 * stride]) / 2 - points[stride:-stride]
    depth = np.linalg.norm(chord, axis=1, keepdims=True)
    span = np.linalg.norm(points[2 * stride :] - points[: -2 * stride], axis=1, keepdims=True) / 2
    most = MIN_RADIUS - np.sqrt(np.maximum(MIN_RADIUS**2 - span**2, 0))
    move = 0.5 * chord * np.maximum(0, 1 - most / np.maximum(depth, 1e-9))
    points[stride:-stride] += move
    points[2 * stride :] -= move / 2
    points[: -2 * stride] -= move / 2


def near_pairs(points: np.ndarray, ball_radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of particles (P, 2) that might touch, and the distance (P,) each must keep."""
    arc = measure_arc(points)
    pairs = cKDTree(points).query_pairs(1.3, output_type="ndarray")
    pairs = pairs[np.abs(arc[pairs[:, 0]] - arc[pairs[:, 1]]) > EXCLUDE]
    reach = np.full(len(pairs), CLEARANCE)
    if ball_radius:
        others = np.flatnonzero(arc > 2 * ball_radius + 2)
        pairs = np.concatenate([pairs, np.stack([np.zeros_like(others), others], axis=1)])
        reach = np.concatenate([reach, np.full(len(others), ball_radius + 0.55)])
    return pairs, reach


def push_apart(points: np.ndarray, pairs: np.ndarray, reach: np.ndarray) -> None:
    """Move touching pairs (P, 2) apart along the line between them, each particle by the mean of its pushes."""
    gap = points[pairs[:, 0]] - points[pairs[:, 1]]
    distance = np.linalg.norm(gap, axis=1)
    touching = distance < reach
    if not touching.any():
        return
    first, second = pairs[touching].T
    push = gap[touching] * (0.5 * (reach / np.maximum(distance, 1e-6) - 1)[touching])[:, None]
    both = np.concatenate([first, second])
    times = np.maximum(np.bincount(both, minlength=len(points)), 1)
    for axis in range(3):
        points[:, axis] += np.bincount(both, np.concatenate([push[:, axis], -push[:, axis]]), len(points)) / times
