"""Physics of a rope: an elastic beam that settles on the table, and an inextensible chain under grippers.

Both are position-based and quasi-static, all lengths in diameters of the rope, and no part passes through another.
While a rope settles its length is not conserved (a knot tightens as rope slides out of it): material points are placed
afterwards, equally spaced. A rope that grippers lift, carry and lay down keeps its length and holds by friction: what
lies on the table moves less readily than what is lifted. It remembers no bends, and opens what is bent tightly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from mmgsd.scene.geometry import measure_arc

LENGTH = 1.6  # m, of every rope
STEP = 1 / 3  # distance between particles, in diameters
EXCLUDE = 2.2  # contact is not tested between parts nearer than this along the rope, in diameters
REST_RADIUS = 2.0  # of the tightest bend a rope likes to keep, in diameters
MIN_RADIUS = 1.7  # of a bend, in diameters: below about 1 a rope's inner side folds into itself
BEAM_STRIDES = (1, 2)  # of the beam: the longer one carries bends over long distances in few rounds
RELAX_ROUNDS = 400
GRAVITY = 0.004  # diameters a round; against the beam's stiffness it gives a lifted strand its span
CLEARANCE = 1.04  # distance between particles that contact restores, in diameters: strands come 3 % nearer between them

# of a rope under grippers
LIFT = 5.0  # diameters that grippers rise: a U-turn of the tightest bend passes under them
STRIDE = 0.25  # diameters that the furthest gripper moves in a step
LEAST_STEPS = 40
ROUNDS = 8  # of all constraints in a gripper's step
SETTLE_ROUNDS = 250  # after the grippers let go
FALL = 0.03  # diameters a round
LYING = 0.25  # how readily a particle on the table moves, of one in the air
LOW = 0.75  # diameters: a particle below lies on the table


def resample(points: np.ndarray, count: int) -> np.ndarray:
    """Equally spaced points (count, 3) on the smooth curve through ``points`` (N, 3), end to end."""
    for _ in range(2):  # the first pass measures arc length on chords, the second on a fine curve
        arc = measure_arc(points)
        points = CubicSpline(arc, points)(np.linspace(0, arc[-1], max(count, 4 * len(points))))
    arc = measure_arc(points)
    return CubicSpline(arc, points)(np.linspace(0, arc[-1], count))


def relax(points: np.ndarray, tension: np.ndarray, ball_radius: float) -> np.ndarray:
    """Settle particles (N, 3), in diameters, on the table: bending, tension (N,), gravity and contact in turn."""
    points = points.copy()
    rests = {stride: _residual(points, 0.0, stride) for stride in BEAM_STRIDES}
    for stride, rest in rests.items():
        most = (stride * STEP) ** 2 / (2 * REST_RADIUS)
        rests[stride] = (rest[:, :2] * _normals(points, stride)).sum(1).clip(-most, most)
    floor = np.full(len(points), 0.5)
    floor[0] = max(0.5, ball_radius)
    for step in range(RELAX_ROUNDS):
        if step % 4 == 0:
            pairs, reach = _near_pairs(points, ball_radius)
        pull = tension * min(1.0, 2 * step / RELAX_ROUNDS, 4 - 4 * step / RELAX_ROUNDS)  # let go at the end
        for stride, rest in rests.items():
            bend(points, rest * (1 - pull[stride:-stride]), stride)
        points[1:-1] -= 0.15 * pull[1:-1, None] * _residual(points, 0.0, 1)
        points[:, 2] -= GRAVITY
        _limit_bends(points)
        _push_apart(points, pairs, reach)
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


def _limit_bends(points: np.ndarray) -> None:
    """Open bends that are tighter than MIN_RADIUS, seen over two and over three particles."""
    for stride in (2, 3):
        chord = (points[2 * stride :] + points[: -2 * stride]) / 2 - points[stride:-stride]
        depth = np.linalg.norm(chord, axis=1, keepdims=True)
        span = np.linalg.norm(points[2 * stride :] - points[: -2 * stride], axis=1, keepdims=True) / 2
        most = MIN_RADIUS - np.sqrt(np.maximum(MIN_RADIUS**2 - span**2, 0))
        move = 0.5 * chord * np.maximum(0, 1 - most / np.maximum(depth, 1e-9))
        points[stride:-stride] += move
        points[2 * stride :] -= move / 2
        points[: -2 * stride] -= move / 2


def _near_pairs(points: np.ndarray, ball_radius: float) -> tuple[np.ndarray, np.ndarray]:
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


def _push_apart(points: np.ndarray, pairs: np.ndarray, reach: np.ndarray) -> None:
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


def pull_rope(
    centre: np.ndarray, thickness: float, grasps: Sequence[tuple[int, np.ndarray]]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Carry points of a rope, ``grasps`` as (index, shift (2,) m), at once: centre lines (N, 3) m meanwhile, and after.

    ``thickness`` is the rope's diameter (m). No grasp leaves the rope to settle.
    """
    count = round(LENGTH / thickness / STEP) + 1
    points = resample(centre, count) / thickness
    grasped = np.array([round(index / (len(centre) - 1) * (count - 1)) for index, _ in grasps], dtype=int)
    shifts = np.array([shift for _, shift in grasps], dtype=float).reshape(-1, 2) / thickness
    passed = []
    for targets in _carry(points[grasped], shifts):
        _move(points, grasped, targets, ROUNDS)
        passed.append(resample(points * thickness, len(centre)))
    _move(points, grasped[:0], np.empty((0, 3)), SETTLE_ROUNDS)  # the grippers let go
    return passed, resample(points * thickness, len(centre))


def _carry(start: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Where the grippers (G, 3) are at each step (T, G, 3): up, along, and down onto the table."""
    steps = max(LEAST_STEPS, int(np.linalg.norm(shifts, axis=1).max(initial=0.0) / STRIDE))
    if not len(start):
        return np.empty((0, 0, 3))
    progress = np.linspace(0, 1, steps)
    along = np.clip((progress - 0.1) / 0.8, 0, 1)  # (T,)
    raised = LIFT * np.clip(np.minimum(progress, 1 - progress) / 0.1, 0, 1)
    paths = np.repeat(start[None], steps, axis=0)
    paths[:, :, :2] += along[:, None, None] * shifts
    paths[:, :, 2] += raised[:, None] + along[:, None] * (0.5 - start[:, 2])
    return paths


def _move(points: np.ndarray, grasped: np.ndarray, targets: np.ndarray, rounds: int) -> None:
    """Put the ``grasped`` of particles (N, 3), STEP apart, at ``targets`` (G, 3), and let the rest follow."""
    reach = STEP * np.abs(np.arange(len(points)) - grasped[:, None])  # (G, N)
    for step in range(rounds):
        if step % ROUNDS == 0:
            pairs, distance = _near_pairs(points, 0.0)
        points[grasped] = targets
        _follow(points, targets, reach)
        weights = np.where(points[:, 2] < LOW, LYING, 1.0)
        weights[grasped] = 1e-6
        for first in (0, 1, 0, 1):
            _keep_lengths(points, weights, first)
        for stride in BEAM_STRIDES:
            bend(points, 0.0, stride)
        _limit_bends(points)
        _push_apart(points, pairs, distance)
        points[:, 2] = np.maximum(points[:, 2] - FALL, 0.5)
    points[grasped] = targets


def _follow(points: np.ndarray, targets: np.ndarray, reach: np.ndarray) -> None:
    """No particle is further from a gripper than the rope between them is long, reach (G, N)."""
    for target, most in zip(targets, reach, strict=True):
        offset = points - target
        distance = np.linalg.norm(offset, axis=1)
        points[:] = target + offset * np.minimum(1, most / np.maximum(distance, 1e-9))[:, None]


def _keep_lengths(points: np.ndarray, weights: np.ndarray, first: int) -> None:
    """Restore the distance of every second pair of neighbours, the first of which is (first, first + 1)."""
    a, b = points[first:-1:2], points[first + 1 :: 2]
    gap = b - a
    distance = np.linalg.norm(gap, axis=1)
    share = (1 - STEP / np.maximum(distance, 1e-9)) / (weights[first:-1:2] + weights[first + 1 :: 2])
    a += (weights[first:-1:2] * share)[:, None] * gap
    b -= (weights[first + 1 :: 2] * share)[:, None] * gap
