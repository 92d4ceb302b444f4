"""What is to be folded, and from which states: one table of tasks.

A task's places are metres in the demonstration's frame: z up, the object flat about the origin, a cloth's rows along -y
and its columns along x, a rope's ends apart along x. Material points are those of `mmgsd.symmetry`: (r, c) of a cloth
is 25 r + c, 1/24 m apart; a rope's 625 run from end to end. Grippers take hold a little inside the rim, where a pixel
off still hits the object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mmgsd.checks import check_choice

STARTS = {"cloth": ("flat", "wrinkled", "corner"), "rope": ("straight", "bent", "heavily bent")}
GROUNDS = ("plain", "workspace")
MOTIONS = ("fold", "turn", "gripper", "hand")  # of films: a task's moves, half a turn, moves under the grippers that
# make them, half a turn with a hand that crosses the picture


@dataclass(frozen=True)
class Move:
    """One gripper: the material point (0 to 624) that it grasps, and where (m) it lays it down."""

    pick: int
    place: tuple[float, float]


@dataclass(frozen=True)
class Task:
    """What a robot is to do with an object; moves of one look are made at once, then the camera looks again."""

    name: str
    label: str
    object: str
    looks: tuple[tuple[Move, ...], ...]
    starts: tuple[str, ...]  # states that rollouts start from
    demonstrated_from: str  # the state that the demonstration starts from


def _grid_point(row: int, column: int) -> tuple[int, tuple[float, float]]:
    """A cloth's material point, and where (m) it lies when the cloth is flat."""
    return 25 * row + column, (column / 24 - 0.5, 0.5 - row / 24)


# corners, one point inside the rim, from the first row's first clockwise as seen from above
(_A, _AT_A), (_B, _AT_B), (_C, _AT_C), (_D, _AT_D) = (_grid_point(*rc) for rc in ((1, 1), (1, 23), (23, 23), (23, 1)))
_HALVE = (Move(_A, _AT_D), Move(_B, _AT_C))
_SPREAD = ("flat", "wrinkled")
_FIRST, _LAST = 8, 616  # of a rope, two centimetres from its ends
_REACH = 0.5 * 1.6 * (_LAST - _FIRST) / 624  # m from the middle of a straight rope

TASKS = {
    task.name: task
    for task in (
        Task("edge", "half, edge to edge", "cloth", (_HALVE,), _SPREAD, "flat"),
        Task("corner", "corner to opposite corner", "cloth", ((Move(_A, _AT_C),),), _SPREAD, "flat"),
        Task("centre", "four corners to the middle", "cloth",
             ((Move(_A, (-0.04, 0.04)), Move(_B, (0.04, 0.04)), Move(_C, (0.04, -0.04)), Move(_D, (-0.04, -0.04))),),
             _SPREAD, "flat"),
        # after the first look the cloth covers y < 0, its first row on top of its last
        Task("twice", "half and half again", "cloth",
             (_HALVE, (Move(_A, _AT_C), Move(_grid_point(11, 1)[0], (_AT_C[0], -1 / 24)))), _SPREAD, "flat"),
        Task("unfold", "flipped corner back", "cloth", ((Move(_A, _AT_A),),), ("corner",), "corner"),
        Task("ends", "both ends to the middle", "rope",
             ((Move(_FIRST, (-0.07, 0.16)), Move(_LAST, (0.07, 0.16))),), ("straight", "bent"), "straight"),
        Task("straighten", "ends pulled apart", "rope",
             ((Move(_FIRST, (-_REACH, 0.0)), Move(_LAST, (_REACH, 0.0))),), ("bent", "heavily bent"), "bent"),
    )
}  # fmt: skip

GRASP = Task("grasp", "a corner to the middle", "cloth", ((Move(_A, (0.0, 0.0)),),), STARTS["cloth"], "flat")


def find_task(name: str) -> Task:
    """The task of a name, one of `TASKS` or `GRASP`; ValueError, which names the accepted, for any other."""
    tasks = TASKS | {GRASP.name: GRASP}
    check_choice("task", name, tuple(tasks))
    return tasks[name]


def fit_motion(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The turn (2, 2) and shift (2,) of the plane that best map points (N, 2 or 3) m onto others: least squares.

    Kabsch, "A solution for the best rotation to relate two sets of vectors" (1976). ValueError where shapes differ.
    """
    if source.shape != target.shape:
        raise ValueError(f"target must have the shape of source, {source.shape}, got {target.shape}")
    source, target = source[:, :2].astype(float), target[:, :2].astype(float)
    middle, aim = source.mean(0), target.mean(0)
    product = (source - middle).T @ (target - aim)  # (2, 2)
    angle = np.arctan2(product[0, 1] - product[1, 0], np.trace(product))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn, aim - turn @ middle


def place_truth(places: np.ndarray, demonstrated: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Places (M, 2) m, moved as the ``demonstrated`` points (625, 3) m best map onto the rollout's (625, 3) m."""
    turn, shift = fit_motion(demonstrated, points)
    return np.asarray(places, dtype=float) @ turn.T + shift
