"""Moves a rope by its grasped points: an inextensible chain that is lifted, carried, laid down, and holds by friction.

Position-based and quasi-static as `rope_relax.py`, all lengths in diameters of the rope inside. What lies on the table
moves less readily than what is lifted, which stands for friction; the rope remembers no bends, and opens what is bent
tightly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mmgsd.scene.objects.rope_relax import STEP, STRIDES, bend, limit_bends, near_pairs, push_apart
from mmgsd.scene.objects.rope_shape import LENGTH, resample

LIFT = 5.0  # diameters that grippers rise: a U-turn of the tightest bend passes under them
STRIDE = 0.25  # diameters that the furthest gripper moves in a step
LEAST_STEPS = 40
ROUNDS = 8  # of all constraints in a step
SETTLE_ROUNDS = 250  # after the grippers let go
FALL = 0.03  # diameters a round
BEND_STRIDES = (2, 3)  # over which tight bends are opened, in particles
LYING = 0.25  # how readily a particle on the table moves, of one in the air
LOW = 0.75  # diameters: a particle below lies on the table


def pull_rope(
    centre: np.ndarray, thickness: float, grasps: Sequence[tuple[int, np.ndarray]], *,
    watched: list[np.ndarray] | None = None,
) -> np.ndarray:  # fmt: skip
    """The centre line (N, 3) m after its points ``grasps``, as (index, shift (2,) m), were carried at once.

    ``thickness`` is the rope's diameter (m). No grasp leaves the rope to settle. Centre lines on the way are added to
    ``watched``, where that is given. ValueError for an index of no point.
    """
    count = round(LENGTH / thickness / STEP) + 1
    for index, _ in grasps:
        if not 0 <= index < len(centre):
            raise ValueError(f"grasps must have indices from 0 to {len(centre) - 1}, got {index}")
    points = resample(centre, count) / thickness
    held = np.array([round(index / (len(centre) - 1) * (count - 1)) for index, _ in grasps], dtype=int)
    shifts = np.array([shift for _, shift in grasps], dtype=float).reshape(-1, 2) / thickness
    chain = _Chain(points, held)
    for targets in _carry(points[held], shifts):
        chain.move(targets, ROUNDS)
        if watched is not None:
            watched.append(resample(chain.points * thickness, len(centre)))
    chain.let_go()
    chain.move(np.empty((0, 3)), SETTLE_ROUNDS)
    settled = chain.points * thickness
    return resample(settled, len(centre))


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


class _Chain:
    """Particles (N, 3), STEP apart, of which some are held."""

    def __init__(self, points: np.ndarray, held: np.ndarray) -> None:
        self.points, self.held = points.copy(), held
        self._measure_reach()

    def let_go(self) -> None:
        """Hold nothing any more."""
        self.held = np.empty(0, dtype=int)
        self._measure_reach()

    def move(self, targets: np.ndarray, rounds: int) -> None:
        """Put what is held at ``targets`` (G, 3), and let the rest follow."""
        points = self.points
        for step in range(rounds):
            if step % ROUNDS == 0:
                pairs, distance = near_pairs(points, 0.0)
            points[self.held] = targets
            self._follow(targets)
            weights = np.where(points[:, 2] < LOW, LYING, 1.0)
            weights[self.held] = 1e-6
            for first in (0, 1, 0, 1):
                _keep_lengths(points, weights, first)
            for stride in STRIDES:
                bend(points, 0.0, stride)
            for stride in BEND_STRIDES:
                limit_bends(points, stride)
            push_apart(points, pairs, distance)
            points[:, 2] = np.maximum(points[:, 2] - FALL, 0.5)
        points[self.held] = targets

    def _measure_reach(self) -> None:
        index = np.arange(len(self.points))
        self._reach = STEP * np.abs(index - self.held[:, None])  # (G, N)

    def _follow(self, targets: np.ndarray) -> None:
        """No particle is further from a gripper than the rope between them is long."""
        for target, reach in zip(targets, self._reach, strict=True):
            offset = self.points - target
            distance = np.linalg.norm(offset, axis=1)
            self.points[:] = target + offset * np.minimum(1, reach / np.maximum(distance, 1e-9))[:, None]


def _keep_lengths(points: np.ndarray, weights: np.ndarray, first: int) -> None:
    """Restore the distance of every second pair of neighbours, the first of which is (first, first + 1)."""
    a, b = points[first:-1:2], points[first + 1 :: 2]
    gap = b - a
    distance = np.linalg.norm(gap, axis=1)
    share = (1 - STEP / np.maximum(distance, 1e-9)) / (weights[first:-1:2] + weights[first + 1 :: 2])
    a += (weights[first:-1:2] * share)[:, None] * gap
    b -= (weights[first + 1 :: 2] * share)[:, None] * gap
