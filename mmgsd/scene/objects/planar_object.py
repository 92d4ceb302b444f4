"""Planar objects of your own: a flat shape by its outline, or a mesh file, and its symmetry, in one small JSON file.

    {"outline": [[0, 0], [90, 0], [90, 50], [0, 50]], "symmetry": "turns"}

``outline``: the corners of a polygon in any unit, y up, either way round; or ``mesh``: an OBJ file beside the JSON
file, or in a folder beside it (no absolute path, no ``..``), that lies flat with z up, or with ``"up": "y"`` as Blender
exports it. The longest side becomes 1 m.

``symmetry`` is found from the rest shape's outline: ``"turns"`` (about the vertical through the centre; of what is
round, 24 of them) or ``"turns and faces"`` (it may also lie on either face, and one looks like the other). Or it is
given: a list of ``{"turn_deg": 180}``, ``{"over_deg": 90}`` (turned over about the line of the plane at that angle to
the x axis) and 4 x 4 matrices as rows of 16 numbers (BOP's ``symmetries_discrete``), to which compositions and the
identity are added; or ``{"permutations": [[...], ...]}`` of the mesh's vertices, the whole group. ``image_size``,
[485, 485] px if left out.

Every vertex is a material point. A sheet whose symmetry turns it over is laid on either face.
"""

from __future__ import annotations

import difflib
import reprlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mmgsd.config import OBJECTS
from mmgsd.files import read_json
from mmgsd.scene.geometry import spin
from mmgsd.scene.objects.meshes import SPACING, UP, count_edges, is_number, read_obj, read_outline, refine, triangulate
from mmgsd.symmetry import SymmetryGroup

TOLERANCE = 0.01  # m by which a symmetric shape may miss itself
MAX_ORDER = 24  # elements of a group
KEYS = ("outline", "mesh", "up", "symmetry", "image_size")


@dataclass(frozen=True, eq=False)
class PlanarObject:
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
    def from_dict(cls, values: dict[str, Any]) -> PlanarObject:
        """Rebuild one from :meth:`to_dict`'s values."""
        mirror = None if values["mirror"] is None else np.array(values["mirror"])
        arrays = {"rest": np.array(values["rest"]), "faces": np.array(values["faces"]), "mirror": mirror}
        group, size = SymmetryGroup(**values["group"]), tuple(values["size"])
        return cls(**{**values, **arrays, "group": group, "size": size})


def load_planar_object(path: Path | str) -> PlanarObject:
    """Read a planar object's JSON file (see the module) and build its mesh and group.

    FileNotFoundError where it is missing, with the nearest name that there is; ValueError, which names the file and
    the key, for what it says, and for a mesh that is missing.
    """
    path = Path(path)
    if not path.is_file():
        names = sorted({*OBJECTS, *(file.stem for file in path.parent.glob("*.json"))})
        close = difflib.get_close_matches(path.stem, names, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise FileNotFoundError(f"{path} does not exist{hint}: it should hold an object's outline or mesh, and its "
                                f"symmetry; there are {', '.join(names)}")  # fmt: skip
    values = read_json(path, remedy="write it anew")
    try:
        return _build(path, values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _build(path: Path, values: Any) -> PlanarObject:
    _check_keys(values)
    size = tuple(values.get("image_size", (485, 485)))
    permutations, symmetry = _read_permutations(values["symmetry"]) if "mesh" in values else None, values["symmetry"]
    if "outline" in values:
        rest, faces, border, transforms = _mesh_outline(read_outline(values["outline"]), symmetry)
    else:
        rest, faces = read_obj(_find_mesh(path, values["mesh"]), up=values.get("up", "z"))
        edges, times = count_edges(faces)
        border = Border(*rest[edges[times == 1].T]).centred()  # the rim, and that of holes
        transforms = [np.eye(3)] if permutations is not None else _list_transforms(symmetry, border)
        _check_vertices(rest, transforms)
    if permutations is None:
        permutations = np.stack([_permute(rest, t) for t in transforms])
    group = SymmetryGroup("own", permutations)
    if group.n_points != len(rest):
        raise ValueError(f"permutations must be rows of {len(rest)}, one entry a vertex; got {group.n_points}")
    turned_over = [t for t in transforms if t[2, 2] < 0]
    mirror = _permute(rest, turned_over[0]) if turned_over else _find_mirror(rest, border)
    return PlanarObject(path.stem, rest, faces, group, bool(turned_over), mirror, size)


def _check_keys(values: Any) -> None:
    """ValueError for other keys than a sheet has, and for values of a wrong type of those that are read at once."""
    if not isinstance(values, dict):
        raise ValueError('must be an object like {"outline": [[0, 0], [90, 0], [90, 50], [0, 50]], "symmetry": '
                         f'"turns"}}, got {reprlib.repr(values)}')  # fmt: skip
    if set(values) - set(KEYS) or ("outline" in values) == ("mesh" in values) or "symmetry" not in values:
        raise ValueError("must have outline or mesh, symmetry, and perhaps image_size, and up beside mesh; "
                         f"got {', '.join(values)}")  # fmt: skip
    if "up" in values and ("mesh" not in values or values["up"] not in UP):
        raise ValueError(f"up must be one of {', '.join(UP)}, beside mesh, got {reprlib.repr(values['up'])}")
    size = values.get("image_size", [485, 485])
    whole = isinstance(size, list) and all(type(s) is int and 64 <= s <= 4096 for s in size)
    if not whole or len(size) != 2:
        raise ValueError(f"image_size must be two integers from 64 to 4096 (width, height), got {reprlib.repr(size)}")


def _find_mesh(path: Path, name: Any) -> Path:
    """The mesh file beside an object's, which a shared object file cannot take from elsewhere."""
    outside = not isinstance(name, str) or not name or "\0" in name
    if outside or any({".."} & set(kind(name).parts) or kind(name).anchor for kind in (PurePosixPath, PureWindowsPath)):
        raise ValueError("mesh must be the name of an OBJ file beside this one, or in a folder beside it (no absolute "
                         f"path, no '..'), got {reprlib.repr(name)}")  # fmt: skip
    return path.parent / name


def _mesh_outline(corners: np.ndarray, symmetry: Any) -> tuple[np.ndarray, np.ndarray, Border, list[np.ndarray]]:
    """Vertices, triangles and border of the outline (N, 3), all about its centre, and its symmetry."""
    border = Border(corners, np.roll(corners, -1, axis=0))
    transforms = _list_transforms(symmetry, border.centred())
    centre = refine(corners).mean(0)
    if any(np.linalg.norm(t @ (centre - border.centre) - (centre - border.centre)) > 1e-9 for t in transforms):
        centre = border.centre  # corners that are unevenly spread pull the mean off the point that no symmetry moves
    return *triangulate(corners - centre, transforms), border.centred(), transforms


# Symmetry. ----------------------------------------------------------------------------------------------------------


class Border:
    """The rim of a shape as straight pieces, short ones: what it measures does not depend on where its corners are."""

    def __init__(self, starts: np.ndarray, ends: np.ndarray) -> None:
        """Edges from ``starts`` to ``ends`` (N, 3), in any order."""
        parts = np.maximum(1, np.ceil(np.linalg.norm(ends - starts, axis=1) / (SPACING / 2))).astype(int)
        edge = np.repeat(np.arange(len(starts)), parts)
        place = np.arange(len(edge)) - np.repeat(np.cumsum(parts) - parts, parts)  # of a piece on its edge
        step = ((ends - starts) / parts[:, None])[edge]
        self.points = starts[edge] + place[:, None] * step  # (P, 3) where pieces start
        self.steps = step
        self.middles = self.points + step / 2
        self.centre = np.average(self.middles, axis=0, weights=np.linalg.norm(step, axis=1))  # no symmetry moves it
        self._tree = cKDTree(self.middles)

    def centred(self) -> Border:
        """The same about its centre."""
        return Border(self.points - self.centre, self.points + self.steps - self.centre)

    def measure_miss(self, transform: np.ndarray) -> float:
        """Greatest distance (m) from a point of the moved border to the border."""
        points = self.points @ transform.T
        if len(points) > 100 and (miss := self._measure(points[:: len(points) // 20])) > 5 * TOLERANCE:
            return miss
        return self._measure(points)

    def _measure(self, points: np.ndarray) -> float:
        nearest = self._tree.query(points, k=min(4, len(self.points)))[1]  # (N, k) pieces
        start, step = self.points[nearest], self.steps[nearest]
        offset = points[:, None] - start
        share = np.clip((offset * step).sum(-1) / (step * step).sum(-1), 0, 1)
        return float(np.linalg.norm(offset - share[..., None] * step, axis=-1).min(axis=1).max())

    def list_axes(self) -> list[tuple[float, float]]:
        """Lines of the plane about which half a turn leaves it: (miss in m, angle in degrees), by their angles.

        An axis meets a border at a corner or in the middle of an edge: at a piece's start or in its middle.
        """
        ends = np.concatenate([self.points, self.middles])
        far = ends[np.hypot(*ends[:, :2].T) > 0.05]
        angles = np.degrees(np.arctan2(far[:, 1], far[:, 0]))
        rounded = angles.round(2)  # what is meant by an angle that is not exact in binary
        angles = np.where(np.abs(angles - rounded) < 1e-6, rounded, angles) % 180
        first = np.unique(angles.round(6), return_index=True)[1]
        missed = [(self.measure_miss(turn_over(a)), float(a)) for a in angles[first]]
        return [(miss, angle) for miss, angle in missed if miss < TOLERANCE]


def turn(degrees: float) -> np.ndarray:
    """Rotation (3, 3) about the vertical."""
    return spin(np.radians(degrees))


def turn_over(degrees: float) -> np.ndarray:
    """Half a turn (3, 3) about the line of the plane at that angle to the x axis."""
    return turn(degrees) @ np.diag([1.0, -1.0, -1.0]) @ turn(-degrees)


def _list_transforms(symmetry: Any, border: Border) -> list[np.ndarray]:
    """All rotations (3, 3) of the symmetry that a file names, the identity first; each leaves the border."""
    if symmetry in ("turns", "turns and faces"):
        return _find_transforms(border, faces=symmetry != "turns")
    if not isinstance(symmetry, list):
        raise ValueError(f"symmetry must be 'turns', 'turns and faces', a list, or permutations of a mesh's vertices; "
                         f"got {reprlib.repr(symmetry)}")  # fmt: skip
    transforms = _close([_read_transform(entry) for entry in symmetry])
    for transform in transforms:
        if (miss := border.measure_miss(transform)) > TOLERANCE:
            raise ValueError(f"symmetry: the shape misses itself by {miss:.3f} of its size after "
                             f"{reprlib.repr(symmetry)}")  # fmt: skip
    return transforms


def _find_transforms(border: Border, *, faces: bool) -> list[np.ndarray]:
    """The largest group of turns, and with ``faces`` of turns over, that leaves a border: of at most `MAX_ORDER`."""
    axes = border.list_axes() if faces else []
    most = MAX_ORDER // 2 if axes else MAX_ORDER
    fold = next(n for n in range(most, 0, -1) if all(border.measure_miss(turn(360 * j / n)) < TOLERANCE
                                                     for j in range(1, n)))  # fmt: skip
    transforms = [turn(360 * j / k) for k in range(2, fold + 1) if fold % k == 0 for j in range(1, k)]
    if axes:
        best = min(axes)[1]  # beside an axis, others that are nearly one also leave a border within the tolerance
        angles = ((best + 180 * j / fold) % 180 for j in range(fold))
        transforms += [turn_over(a) for a in sorted(round(a, 2) if abs(a - round(a, 2)) < 1e-6 else a for a in angles)]
    return _close(transforms)


def _read_transform(entry: Any) -> np.ndarray:
    if isinstance(entry, dict) and len(entry) == 1 and set(entry) <= {"turn_deg", "over_deg"}:
        ((kind, degrees),) = entry.items()
        if is_number(degrees):
            return (turn if kind == "turn_deg" else turn_over)(float(degrees))
    if isinstance(entry, list) and len(entry) == 16 and all(map(is_number, entry)):
        matrix = np.array(entry, dtype=float).reshape(4, 4)[:3, :3]
        if np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3) and np.linalg.det(matrix) > 0:
            return matrix
    raise ValueError("symmetry: an entry must be {'turn_deg': a}, {'over_deg': a} or the 16 numbers of a rigid "
                     f"4 x 4 matrix, got {reprlib.repr(entry)}")  # fmt: skip


def _read_permutations(symmetry: Any) -> np.ndarray | None:
    """The group (G, V) that a file spells out; None where it names the symmetry otherwise."""
    if not isinstance(symmetry, dict) or "permutations" not in symmetry:
        return None
    rows = symmetry["permutations"]
    listed = isinstance(rows, list) and 1 <= len(rows) <= MAX_ORDER and all(isinstance(row, list) for row in rows)
    if len(symmetry) > 1 or not listed or len({len(row) for row in rows}) > 1:
        raise ValueError(f"symmetry: permutations must be 1 to {MAX_ORDER} lists of a vertex's number each, all of one "
                         f"length and with nothing beside them, got {reprlib.repr(symmetry)}")  # fmt: skip
    if not all(type(entry) is int and abs(entry) < 2**31 for row in rows for entry in row):
        raise ValueError("symmetry: permutations must be integers, 0 for the mesh's first vertex")
    return np.array(rows)


def _close(generators: list[np.ndarray]) -> list[np.ndarray]:
    """The group (3, 3) each that rotations generate, identity first."""
    group = [np.eye(3)]
    for element in group:  # grows while it is walked through
        for generator in generators:
            product = generator @ element
            if np.abs(np.array(group) - product).max((1, 2)).min() > 1e-3:
                group.append(product)
            if len(group) > MAX_ORDER:
                raise ValueError(f"symmetry must generate at most {MAX_ORDER} elements, like turns by 360 / n degrees "
                                 f"with n up to {MAX_ORDER}: are its angles exact?")  # fmt: skip
    return group


def _check_vertices(rest: np.ndarray, transforms: list[np.ndarray]) -> None:
    """ValueError where a mesh's vertices are not as symmetric as its outline, or as its file says."""
    for transform in transforms:
        if (miss := _measure_miss(rest, transform)) > TOLERANCE:
            raise ValueError(f"symmetry: the mesh's outline has it, but its vertices miss each other by {miss:.3f} of "
                             "its size: make the mesh symmetric, or list what it has, [] for none")  # fmt: skip


def _measure_miss(rest: np.ndarray, transform: np.ndarray) -> float:
    """Greatest distance (m) from a moved vertex to the nearest vertex."""
    return float(cKDTree(rest).query(rest @ transform.T)[0].max())


def _permute(rest: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """The vertex (V,) nearest to where each goes; ValueError where two go to one."""
    permutation = cKDTree(rest).query(rest @ transform.T)[1]
    if len(np.unique(permutation)) != len(rest):
        raise ValueError("symmetry: two vertices of the mesh fall on one; make the mesh itself symmetric")
    return permutation


def _find_mirror(rest: np.ndarray, border: Border) -> np.ndarray | None:
    """Where the mirror image of a flat sheet has each vertex, if it is a sheet of the same shape, meshed the same."""
    for _, angle in border.list_axes():
        if _measure_miss(rest, turn_over(angle)) < TOLERANCE:
            try:
                return _permute(rest, turn_over(angle))
            except ValueError:  # as good as none
                continue
    return None
