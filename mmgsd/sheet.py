"""Sheets of your own: a flat shape by its outline, or a mesh file, and its symmetry, in one small JSON file.

    {"outline": [[0, 0], [90, 0], [90, 50], [0, 50]], "symmetry": "turns"}

``outline``: the corners of a polygon in any unit, y up; or ``mesh``: an OBJ file beside the JSON file. The longest side
becomes 1 m. ``symmetry`` is found from the rest shape, ``"turns"`` (about the vertical through the centre) or
``"turns and faces"`` (it may also lie on either face, and one looks like the other); or given: a list of
``{"turn_deg": 180}``, ``{"over_deg": 90}`` (turned over about the line of the plane at that angle to the x axis)
and 4 x 4 matrices as rows of 16 numbers (BOP's ``symmetries_discrete``), or ``{"permutations": [[...], ...]}`` of the
mesh's vertices. Compositions and the identity are added. ``image_size``, [485, 485] px if left out.

Every vertex is a material point. A sheet whose symmetry turns it over is laid on either face.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Polygon
from scipy.spatial import Delaunay, cKDTree

from mmgsd.symmetry import SymmetryGroup

SPACING = 1 / 36  # m between vertices, the square cloth's: what the physics is tuned to
EDGES = (0.5 * SPACING, 1.8 * SPACING)  # median length in m that a mesh file may have
TOLERANCE = 0.01  # m by which a symmetric shape may miss itself
MAX_ORDER = 24  # elements of a group
KEYS = ("outline", "mesh", "symmetry", "image_size")


@dataclass(frozen=True, eq=False)
class Sheet:
    """A sheet at rest in the plane z = 0, or a mesh about it, centred; every vertex is a material point."""

    name: str
    rest: np.ndarray  # (V, 3) m
    faces: np.ndarray  # (F, 3) or (F, 4)
    group: SymmetryGroup
    either_face: bool = False  # it may lie on its other face
    mirror: np.ndarray | None = None  # (V,) where a mirror image has each point; None where no mirror is like it
    size: tuple[int, int] = (485, 485)  # (width, height) px of its images

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        mirror = None if self.mirror is None else self.mirror.tolist()
        arrays = {"rest": self.rest.tolist(), "faces": self.faces.tolist(), "mirror": mirror}
        return {**vars(self), **arrays, "group": self.group.to_dict(), "size": list(self.size)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Sheet:
        """Rebuild a sheet from :meth:`to_dict`'s values."""
        mirror = None if values["mirror"] is None else np.array(values["mirror"])
        arrays = {"rest": np.array(values["rest"]), "faces": np.array(values["faces"]), "mirror": mirror}
        group, size = SymmetryGroup.from_dict(values["group"]), tuple(values["size"])
        return cls(**{**values, **arrays, "group": group, "size": size})


def load_sheet(path: Path | str) -> Sheet:
    """Read a sheet's JSON file (see the module) and build its mesh and group.

    FileNotFoundError where it or its mesh is missing; ValueError, which names the file and the key, for what it says.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: it should hold an object's outline or mesh, and its symmetry")
    try:
        return _build(path, json.loads(path.read_text()))
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: {error}") from error


def _build(path: Path, values: dict[str, Any]) -> Sheet:
    unknown = set(values) - set(KEYS)
    if unknown or ("outline" in values) == ("mesh" in values) or "symmetry" not in values:
        raise ValueError(f"must have outline or mesh, symmetry, and perhaps image_size; got {', '.join(values)}")
    size = tuple(values.get("image_size", (485, 485)))
    if len(size) != 2 or not all(isinstance(s, int) and 64 <= s <= 4096 for s in size):
        raise ValueError(f"image_size must be two integers from 64 to 4096 (width, height), got {list(size)}")
    symmetry, given = values["symmetry"], None
    if "outline" in values:
        corners = _read_outline(values["outline"])
        corners -= _refine(corners).mean(0)  # the one point that no symmetry moves
        transforms = _list_transforms(symmetry, _refine(corners))
        rest, faces = _triangulate(corners[:, :2], transforms)
    else:
        rest, faces = _read_obj(path.parent / values["mesh"])
        given = symmetry.get("permutations") if isinstance(symmetry, dict) else None
        transforms = [np.eye(3)] if given else _list_transforms(symmetry, rest)
    group = SymmetryGroup("own", np.array(given) if given else np.stack([_permute(rest, t) for t in transforms]))
    if group.n_points != len(rest):
        raise ValueError(f"permutations must be rows of {len(rest)}, one entry a vertex; got {group.n_points}")
    turned_over = [t for t in transforms if t[2, 2] < 0]
    mirror = _permute(rest, turned_over[0]) if turned_over else _find_mirror(rest)
    return Sheet(path.stem, rest, faces, group, bool(turned_over), mirror, size)


# Symmetry. ----------------------------------------------------------------------------------------------------------


def turn(degrees: float) -> np.ndarray:
    """Rotation (3, 3) about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def turn_over(degrees: float) -> np.ndarray:
    """Half a turn (3, 3) about the line of the plane at that angle to the x axis."""
    return turn(degrees) @ np.diag([1.0, -1.0, -1.0]) @ turn(-degrees)


def _list_transforms(symmetry: Any, shape: np.ndarray) -> list[np.ndarray]:
    """All rotations (3, 3) of the symmetry that a file names, the identity first; each leaves ``shape`` (N, 3)."""
    if symmetry in ("turns", "turns and faces"):
        found = [t for t in _candidates(shape, faces=symmetry != "turns") if _measure_miss(shape, t) < TOLERANCE]
        return _close(found)
    if not isinstance(symmetry, list):
        raise ValueError(f"symmetry must be 'turns', 'turns and faces', a list, or permutations of a mesh's vertices; "
                         f"got {symmetry!r}")  # fmt: skip
    transforms = _close([_read_transform(entry) for entry in symmetry])
    for transform in transforms:
        if (miss := _measure_miss(shape, transform)) > TOLERANCE:
            raise ValueError(f"symmetry: the shape misses itself by {miss:.3f} of its size after {symmetry}")
    return transforms


def _candidates(shape: np.ndarray, *, faces: bool) -> list[np.ndarray]:
    """Turns of up to eight-fold symmetry; half turns about every line through the centre and a point of the shape."""
    turns = [turn(360 * j / k) for k in range(2, 9) for j in range(1, k)]
    if not faces:
        return turns
    far = shape[np.hypot(*shape[:, :2].T) > 0.05]
    angles = np.unique(np.degrees(np.arctan2(far[:, 1], far[:, 0])).round(2) % 180)
    return turns + [turn_over(a) for a in (angles if len(angles) < 500 else np.arange(0, 180, 7.5))]


def _read_transform(entry: Any) -> np.ndarray:
    if isinstance(entry, dict) and len(entry) == 1 and set(entry) <= {"turn_deg", "over_deg"}:
        ((kind, degrees),) = entry.items()
        return (turn if kind == "turn_deg" else turn_over)(float(degrees))
    if isinstance(entry, list) and len(entry) == 16:
        matrix = np.array(entry, dtype=float).reshape(4, 4)[:3, :3]
        if np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0:
            return matrix
    raise ValueError("symmetry: an entry must be {'turn_deg': a}, {'over_deg': a} or the 16 numbers of a rigid "
                     f"4 x 4 matrix, got {entry!r}")  # fmt: skip


def _close(generators: list[np.ndarray]) -> list[np.ndarray]:
    """The group (3, 3) each that rotations generate, identity first."""
    group = [np.eye(3)]
    for element in group:  # grows while it is walked through
        for generator in generators:
            product = generator @ element
            if not any(np.allclose(product, known, atol=1e-3) for known in group):
                group.append(product)
            if len(group) > MAX_ORDER:
                raise ValueError(f"symmetry must generate at most {MAX_ORDER} elements: are its angles exact?")
    return group


def _measure_miss(shape: np.ndarray, transform: np.ndarray) -> float:
    """Greatest distance (m) from a moved point of the shape to the nearest one of the shape."""
    return float(cKDTree(shape).query(shape @ transform.T)[0].max())


def _permute(rest: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """The vertex (V,) nearest to where each goes; ValueError where two go to one."""
    permutation = cKDTree(rest).query(rest @ transform.T)[1]
    if len(np.unique(permutation)) != len(rest):
        raise ValueError("symmetry: two vertices of the mesh fall on one; make the mesh itself symmetric")
    return permutation


def _find_mirror(rest: np.ndarray) -> np.ndarray | None:
    """Where the mirror image of a flat sheet has each point, if it is a sheet of the same shape."""
    for transform in _candidates(rest, faces=True):
        if transform[2, 2] < 0 and _measure_miss(rest, transform) < TOLERANCE:
            return _permute(rest, transform)
    return None


# Meshes. ------------------------------------------------------------------------------------------------------------


def _read_outline(outline: Any) -> np.ndarray:
    corners = np.array(outline, dtype=float)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"outline must be 3 or more corners [x, y], got the shape {corners.shape}")
    x, y = corners.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    if abs(area) < 0.05 * np.ptp(corners, axis=0).max() ** 2:
        raise ValueError("outline must enclose an area, corners in order")
    corners = corners[:: int(np.sign(area))] / np.ptp(corners, axis=0).max()
    return np.column_stack([corners, np.zeros(len(corners))])


def _refine(corners: np.ndarray) -> np.ndarray:
    """Points on the outline no further apart than the mesh's vertices, corners included."""
    points = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        parts = max(1, round(np.linalg.norm(b - a) / SPACING))
        points.append(a + (b - a) * np.arange(parts)[:, None] / parts)
    return np.concatenate(points)


def _triangulate(corners: np.ndarray, transforms: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) m on the outline (N, 2) and on a grid inside it, in whole orbits, and triangles (F, 3)."""
    border = _refine(np.column_stack([corners, np.zeros(len(corners))]))
    steps = np.arange(-40, 41) * SPACING
    grid = np.stack(np.meshgrid(steps, -steps), axis=-1).reshape(-1, 2)
    inside = Polygon(corners).contains_points(grid) & (cKDTree(border[:, :2]).query(grid)[0] > 0.6 * SPACING)
    rest = _choose_orbits(np.concatenate([border, np.column_stack([grid[inside], np.zeros(inside.sum())])]), transforms)
    triangles = Delaunay(rest[:, :2]).simplices
    a, b, c = (rest[triangles[:, k], :2] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    triangles = np.where((area > 0)[:, None], triangles, triangles[:, ::-1])  # normals up
    within = Polygon(corners).contains_points((a + b + c) / 3) & (np.abs(area) > 0.02 * SPACING**2)
    used = np.unique(triangles[within])
    if len(used) != len(rest):
        raise ValueError("outline has parts narrower than the mesh's edges, 3 % of its size")
    return rest, triangles[within]


def _choose_orbits(candidates: np.ndarray, transforms: list[np.ndarray]) -> np.ndarray:
    """Candidates (N, 3) in order with all that they are moved to, but for orbits too near to what is there."""
    chosen = np.empty((0, 3))
    for candidate in candidates:
        moved = np.stack([t @ candidate for t in transforms])
        apart = np.linalg.norm(moved[:, None] - moved[None], axis=-1)
        first = np.array([not (apart[i, :i] < 1e-6).any() for i in range(len(moved))])  # a fixed point counts once
        orbit = moved[first]
        gaps = apart[np.ix_(first, first)] + np.eye(len(orbit))
        if gaps.min() > 0.55 * SPACING and (not len(chosen) or _gap(chosen, orbit) > 0.55 * SPACING):
            chosen = np.concatenate([chosen, orbit])
    return chosen


def _gap(chosen: np.ndarray, orbit: np.ndarray) -> float:
    return float(np.linalg.norm(chosen[:, None] - orbit[None], axis=-1).min())


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a Wavefront OBJ file; polygons are cut into triangles."""
    if not path.is_file():
        raise ValueError(f"mesh: {path} does not exist")
    vertices, faces = [], []
    for line in path.read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(w) for w in words[:3]])
        elif kind == "f":
            corners = [int(w.split("/")[0]) for w in words]
            corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
            faces += [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]
    rest, faces = np.array(vertices), np.array(faces)
    if not len(faces) or faces.min() < 0 or faces.max() >= len(rest):
        raise ValueError(f"mesh: {path} must be an OBJ file with vertices and faces")
    if len(np.unique(faces)) != len(rest):
        raise ValueError(f"mesh: {path} has vertices that belong to no face")
    rest = (rest - rest.mean(0)) / np.ptp(rest, axis=0).max()
    edges = np.linalg.norm(rest[faces[:, 0]] - rest[faces[:, 1]], axis=1)
    if not EDGES[0] <= np.median(edges) <= EDGES[1]:
        raise ValueError(f"mesh: edges of {path} must be {EDGES[0]:.3f} to {EDGES[1]:.3f} of its size long (median), "
                         f"got {np.median(edges):.3f}: remesh it")  # fmt: skip
    return rest, faces
