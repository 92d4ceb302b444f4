"""Symmetry groups as permutations of an object's material points: data, not code.

A material point p of one image has its true matches at the points ``permutations[:, p]`` of every other image. A new
kind of object brings a new array and no new code.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np

from mmgsd.checks import check_choice
from mmgsd.config import N_POINTS, OBJECTS

GRID_GROUPS = ("identity", "c2", "v4", "c4", "d4")
LINE_GROUPS = ("identity", "c2")


@dataclasses.dataclass(frozen=True, eq=False)
class SymmetryGroup:
    """A finite group acting on P material points, one permutation a row.

    ``permutations`` is (G, P) integer; it is copied and made read-only. Raises ValueError where a row is no
    permutation, a row repeats, the identity is missing, or the composition of two rows is not a row.
    """

    name: str
    permutations: np.ndarray  # (G, P)

    def __post_init__(self) -> None:
        permutations = _as_integers("permutations", self.permutations).copy()
        _check_rows(permutations)
        _check_closed(permutations)
        permutations.setflags(write=False)
        object.__setattr__(self, "permutations", permutations)

    @property
    def order(self) -> int:
        """Number of elements G."""
        return self.permutations.shape[0]

    @property
    def n_points(self) -> int:
        """Number of material points P."""
        return self.permutations.shape[1]

    def orbit(self, points: np.ndarray | int) -> np.ndarray:
        """The true matches of material points, (...) to (..., G), with repetitions where an element fixes a point.

        Raises ValueError where a point is no integer in [0, P).
        """
        points = _as_integers("points", points)
        if points.size and not (points.min() >= 0 and points.max() < self.n_points):
            raise ValueError(f"points must be in [0, {self.n_points}), got {points.min()} to {points.max()}")
        return self.permutations.T[points]

    def distinct_modes(self, point: int) -> np.ndarray:
        """The distinct true matches of one material point, (n,) in increasing order."""
        return np.unique(self.orbit(point))

    def count_modes(self, points: np.ndarray | int) -> np.ndarray:
        """Number n of distinct true matches of material points, (...) to (...): 1 at a cloth's centre under c4."""
        members = np.sort(self.orbit(points), axis=-1)
        return 1 + (np.diff(members, axis=-1) != 0).sum(axis=-1)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, of which ``SymmetryGroup(**values)`` is the group again."""
        return {"name": self.name, "permutations": self.permutations.tolist()}


def grid_group(name: str, *, side: int = 25) -> SymmetryGroup:
    """A symmetry group of a square cloth whose material point (r, c) has the index ``r * side + c``.

    ``identity``; ``c2``: turned by 180°; ``v4``: row flip, column flip, both; ``c4``: the four rotations; ``d4``: all
    eight. Raises ValueError for any other name.
    """
    check_choice("name of a grid's group", name, GRID_GROUPS)
    grid = np.arange(side * side).reshape(side, side)
    rotations = [np.rot90(grid, k) for k in range(4)]
    elements = {
        "identity": [grid],
        "c2": [grid, rotations[2]],
        "v4": [grid, grid[::-1], grid[:, ::-1], rotations[2]],
        "c4": rotations,
        "d4": [*rotations, *(rotation[::-1] for rotation in rotations)],
    }
    return SymmetryGroup(name, np.stack([element.ravel() for element in elements[name]]))


def line_group(name: str, *, n: int = N_POINTS) -> SymmetryGroup:
    """A symmetry group of a rope of n points in order: ``identity``, or ``c2`` (end to end); ValueError for another."""
    check_choice("name of a line's group", name, LINE_GROUPS)
    line = np.arange(n)
    return SymmetryGroup(name, np.stack([line, line[::-1]][: 2 if name == "c2" else 1]))


def load_group(object: str, name: str) -> SymmetryGroup:
    """The named group of a ``cloth`` or ``rope`` on its 625 material points; ValueError for another object or group."""
    check_choice("object", object, OBJECTS)
    check_choice(f"group of a {object}", name, GRID_GROUPS if object == "cloth" else LINE_GROUPS)
    return grid_group(name) if object == "cloth" else line_group(name)


def locate_points(object: str, points: int = N_POINTS) -> np.ndarray:
    """(P, 2) in [0, 1], where material points lie on an object laid flat: a cloth's row by row, a rope's in its middle.

    ValueError for an unknown object.
    """
    check_choice("object", object, OBJECTS)
    if object == "rope":
        return np.stack([np.linspace(0, 1, points), np.full(points, 0.5)], axis=-1)
    rows, columns = np.divmod(np.arange(points), side := round(points**0.5))
    return np.stack([columns, rows], axis=-1) / (side - 1)


def load_mirror(object: str) -> np.ndarray:
    """Where each material point (625,) of a ``cloth`` or ``rope`` goes in a mirror image of it, seen from above.

    No symmetry of one shape: the mirror image of a cloth shows another cloth, whose columns count backwards; that of a
    rope another rope, its points in the same order. ValueError for an unknown object.
    """
    check_choice("object", object, OBJECTS)
    points = np.arange(N_POINTS)
    side = round(N_POINTS**0.5)
    return points.reshape(side, side)[:, ::-1].ravel() if object == "cloth" else points


def _as_integers(argument: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.size and not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{argument} must be integers, got an array of {array.dtype}")
    return array.astype(np.int64)


def _check_rows(permutations: np.ndarray) -> None:
    if permutations.ndim != 2 or 0 in permutations.shape:
        raise ValueError(f"permutations must be a (G, P) array with G, P >= 1, got the shape {permutations.shape}")
    points = np.arange(permutations.shape[1])
    wrong = np.flatnonzero((np.sort(permutations, axis=1) != points).any(axis=1))
    if len(wrong):
        raise ValueError(f"permutations must hold each of 0 to {len(points) - 1} once a row; row {wrong[0]} does not")


def _check_closed(permutations: np.ndarray) -> None:
    # A finite set of permutations that is closed under composition also holds every inverse.
    rows = {row.tobytes() for row in permutations}
    if len(rows) != len(permutations):
        raise ValueError(f"permutations must be {len(permutations)} different rows, got {len(rows)}")
    if np.arange(permutations.shape[1]).tobytes() not in rows:
        raise ValueError("permutations must contain the identity, got none")
    for (i, first), (j, second) in itertools.product(enumerate(permutations), repeat=2):
        if first[second].tobytes() not in rows:
            raise ValueError(f"permutations must be closed under composition: row {i} after row {j} is not a row")
