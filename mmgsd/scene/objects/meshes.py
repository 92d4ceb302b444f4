"""Flat meshes of sheets, from the corners of an outline or from a Wavefront OBJ file, and what is refused of either.

The longest side becomes 1 m. What would be simulated for hours, or to no end, is refused here: ValueError names the
key of the object's file, what it has and what is accepted.
"""

from __future__ import annotations

import re
import reprlib
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.path import Path as Polygon
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, cKDTree

SPACING = 1 / 36  # m between vertices, the square cloth's: what the physics is tuned to
EDGES = (0.5 * SPACING, 1.8 * SPACING)  # median length in m that a mesh file may have
MERGED = 0.001  # m: corners of an outline nearer than this are one
STRAIGHT = 1e-4  # m by which a corner stands out from a straight edge at least
MIN_AREA = 0.05  # of the square around an outline
MAX_CORNERS = 10_000
MAX_LENGTH = 50.0  # m of an outline: at so small an area, a longer one has parts narrower than the mesh's edges
MAX_VERTICES = 10_000  # of a mesh file; with the shortest edges accepted, a square has 5,300
MAX_BYTES = 32 * 2**20  # of a mesh file, ten times what so many vertices take
MAX_RISE = 0.1  # m from the lowest to the highest vertex of a mesh that lies flat
UP = ("z", "y")  # axes of a mesh file that may point up


# Outlines. ----------------------------------------------------------------------------------------------------------


def read_outline(outline: Any) -> np.ndarray:
    """The corners (N, 3) m that an outline needs, counter-clockwise, from a list of [x, y] in any unit.

    Corners that repeat another, or lie on a straight edge, are left out. ValueError where the list is none of corners,
    or where the line crosses or touches itself, encloses too little or has too many corners.
    """
    corners = _check_corners(outline)
    extent = np.ptp(corners, axis=0).max()
    if not extent > 0:
        raise ValueError("outline must enclose an area, got one point again and again")
    scaled = (corners - corners[0]) / extent
    selected = _drop_straight(scaled, _drop_repeated(scaled))
    if len(selected) < 3:
        raise ValueError("outline must enclose an area, got corners on one line")
    if (meeting := _find_crossing(scaled[selected])) is not None:
        after = np.roll(corners[selected], -1, axis=0)
        written = [f"[{x:g}, {y:g}]" for k in meeting for x, y in (corners[selected][k], after[k])]
        raise ValueError("outline must not cross or touch itself: its edge from {} to {} meets the one from {} to {}"
                         .format(*written))  # fmt: skip
    x, y = scaled[selected].T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    if abs(area) < MIN_AREA:
        raise ValueError(f"outline must enclose an area of {MIN_AREA:.0%} of the square around it or more, "
                         f"got {abs(area):.1%}")  # fmt: skip
    if (length := np.linalg.norm(scaled[selected] - np.roll(scaled[selected], -1, axis=0), axis=1).sum()) > MAX_LENGTH:
        raise ValueError(f"outline must be at most {MAX_LENGTH:g} times as long as its longest side, got {length:.0f}")
    corners = corners[selected][:: int(np.sign(area))] / extent
    return np.column_stack([corners, np.zeros(len(corners))])


def _check_corners(outline: Any) -> np.ndarray:
    """Corners (N, 2) as they are written."""
    if not isinstance(outline, list) or not 3 <= len(outline) <= MAX_CORNERS:
        got = f"{len(outline)} of them" if isinstance(outline, list) else reprlib.repr(outline)
        raise ValueError(f"outline must be a list of 3 or more corners [x, y], {MAX_CORNERS} at most, got {got}")
    for number, corner in enumerate(outline, 1):
        if not isinstance(corner, list) or len(corner) != 2 or not all(map(is_number, corner)):
            nested = isinstance(corner, list) and any(isinstance(part, list) for part in corner)
            hint = ": give the corners of the one ring, without a list around them; holes are not accepted"
            raise ValueError(f"outline: each corner must be [x, y], two finite numbers, got {reprlib.repr(corner)} as "
                             f"corner {number}{hint if nested else ''}")  # fmt: skip
    return np.array(outline, dtype=float)


def is_number(value: Any) -> bool:
    """Whether a JSON value is a finite number that can be computed with."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e100


def _drop_repeated(points: np.ndarray) -> list[int]:
    """Indices of the points (N, 2) of a ring that do not repeat the one before, nor the last ones the first."""
    selected: list[int] = []
    for i, point in enumerate(points):
        if not selected or np.hypot(*(point - points[selected[-1]])) >= MERGED:
            selected.append(i)
    while len(selected) > 1 and np.hypot(*(points[selected[-1]] - points[selected[0]])) < MERGED:
        selected.pop()
    return selected


def _drop_straight(points: np.ndarray, ring: list[int]) -> list[int]:
    """Those indices of a ring of points (N, 2) at which it turns; a point at which it turns back is kept."""
    place = (points[:, 0] + 1j * points[:, 1]).tolist()
    selected: list[int] = []
    for position, i in enumerate(ring):
        before, after = place[selected[-1] if selected else ring[-1]], place[ring[(position + 1) % len(ring)]]
        chord, step = after - before, place[i] - before
        aside = abs((chord.conjugate() * step).imag) > STRAIGHT * abs(chord)
        if aside or (step.conjugate() * (after - place[i])).real <= 0:
            selected.append(i)
    return selected


def _find_crossing(points: np.ndarray) -> tuple[int, int] | None:
    """The first two edges of a ring (N, 2), by the corners they start at, that cross or touch but for neighbours."""
    after, count = np.roll(points, -1, axis=0), len(points)
    for i, (a, b) in enumerate(zip(points, after, strict=True)):
        side = _cross(b - a, points - a)
        ours = _cross(after - points, a - points) * _cross(after - points, b - points)
        crossed = (side * np.roll(side, -1) < 0) & (ours < 0)
        along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        touched = np.linalg.norm(a + along[:, None] * (b - a) - points, axis=1) < 1e-6
        touched[[i, (i + 1) % count]] = False
        if (crossed | touched).any():
            return i, int(np.argmax(crossed | touched))
    return None


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def refine(corners: np.ndarray) -> np.ndarray:
    """Points on the outline no further apart than the mesh's vertices, corners included."""
    points = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        parts = max(1, round(np.linalg.norm(b - a) / SPACING))
        points.append(a + (b - a) * np.arange(parts)[:, None] / parts)
    return np.concatenate(points)


def triangulate(corners: np.ndarray, transforms: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) m on the outline (N, 3) and on a grid inside it, in whole orbits, and triangles (F, 3)."""
    border, shape = refine(corners), Polygon(corners[:, :2])
    steps = np.arange(-40, 41) * SPACING
    grid = np.stack(np.meshgrid(steps, -steps), axis=-1).reshape(-1, 2)
    inside = shape.contains_points(grid) & (cKDTree(border[:, :2]).query(grid)[0] > 0.6 * SPACING)
    rest = _choose_orbits(np.concatenate([border, np.column_stack([grid[inside], np.zeros(inside.sum())])]), transforms)
    triangles = Delaunay(rest[:, :2]).simplices
    area = _measure_areas(rest, triangles)
    triangles = np.where((area > 0)[:, None], triangles, triangles[:, ::-1])  # normals up
    longest = np.linalg.norm(rest[triangles] - rest[np.roll(triangles, 1, axis=1)], axis=2).max(axis=1)
    least = np.where(longest > 2.5 * SPACING, 0.1 * longest, 0.02 * SPACING)  # no slivers at the rim
    thick = np.abs(area) > least * SPACING
    within = shape.contains_points(rest[triangles, :2].mean(axis=1)) & thick
    if len(np.unique(triangles[within])) != len(rest):
        raise ValueError("outline has parts narrower than the mesh's edges, 3 % of its size")
    return rest, triangles[within]


def _measure_areas(rest: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Areas (F,) m² of triangles seen from above, positive where they are counter-clockwise."""
    a, b, c = (rest[triangles[:, k], :2] for k in range(3))
    return 0.5 * _cross(b - a, c - a)


def _choose_orbits(candidates: np.ndarray, transforms: list[np.ndarray]) -> np.ndarray:
    """Candidates (N, 3) in order with all that they are moved to, but for orbits too near to what is there."""
    chosen = np.empty((0, 3))
    for candidate in candidates:
        if np.linalg.norm(chosen - candidate, axis=1).min(initial=np.inf) <= 0.55 * SPACING:  # as near as all its orbit
            continue
        moved = np.stack([t @ candidate for t in transforms])
        distance = np.linalg.norm(moved[:, None] - moved[None], axis=-1)
        first = np.array([not (distance[i, :i] < 1e-6).any() for i in range(len(moved))])  # a fixed point counts once
        orbit = moved[first]
        gaps = distance[np.ix_(first, first)] + np.eye(len(orbit))
        if gaps.min() > 0.55 * SPACING:
            chosen = np.concatenate([chosen, orbit])
    return chosen


# Mesh files. --------------------------------------------------------------------------------------------------------


def read_obj(path: Path, *, up: str = "z") -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) m and triangles (F, 3) of a Wavefront OBJ file; polygons are cut into triangles.

    ``up`` is the file's axis that points up, "z" or "y" (as Blender exports). ValueError for a file that is no OBJ, and
    for a mesh that is too large, too coarse or too fine, does not lie flat, or is not one sheet of one layer.
    """
    if not path.is_file():
        raise ValueError(f"mesh: {path} does not exist")
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ValueError(f"mesh: {path} must have at most {MAX_BYTES} bytes and {MAX_VERTICES} vertices, got {size} "
                         "bytes: remesh it")  # fmt: skip
    try:
        rest, faces = _parse_obj(path.read_bytes())
        _check_indices(rest, faces)
        rest = _lay_flat(rest, up)
        _check_edges(rest, faces)
        _check_one_layer(rest, faces)
    except ValueError as error:
        raise ValueError(f"mesh: {path} {error}") from error
    return rest, faces


def _parse_obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) as written and triangles (F, 3); names may be in any encoding, they are not read."""
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    data = re.sub(rb"#[^\r\n]*", b"", data.removeprefix(b"\xef\xbb\xbf"))
    for line in re.sub(rb"\\[ \t]*(\r\n|\r|\n)", b" ", data).splitlines():
        kind, *words = line.split() or [b""]
        try:
            if kind == b"v":
                vertices.append(_read_vertex(words))
            elif kind == b"f":
                faces += _read_face(words, len(vertices))
        except ValueError as error:
            written = reprlib.repr(line.decode("latin-1").strip())
            raise ValueError(f"must be an OBJ file: the line {written} {error}") from None
        if len(vertices) > MAX_VERTICES or len(faces) > 4 * MAX_VERTICES:
            raise ValueError(f"must have at most {MAX_VERTICES} vertices and {4 * MAX_VERTICES} triangles: remesh it")
    if not vertices or not faces:
        raise ValueError("must be a Wavefront OBJ file with vertices and faces, got "
                         f"{len(vertices)} and {len(faces)}")  # fmt: skip
    return np.array(vertices), np.array(faces)


def _read_vertex(words: list[bytes]) -> list[float]:
    """x, y and z; a weight or a colour may follow."""
    try:
        place = [float(word) for word in words[:3]]
    except ValueError:
        place = []
    if len(place) != 3 or not all(map(is_number, place)):
        raise ValueError("must hold three finite numbers")
    return place


def _read_face(words: list[bytes], count: int) -> list[list[int]]:
    """The triangles of a polygon; a negative index counts back from the last of ``count`` vertices."""
    try:
        numbers = [int(word.split(b"/")[0]) for word in words]
    except ValueError:
        numbers = []
    corners = [c - 1 if c > 0 else count + c for c in numbers]
    if len(numbers) < 3 or 0 in numbers or min(corners) < 0:
        raise ValueError("must hold the numbers of three or more vertices")
    if len(set(corners)) != len(corners):
        raise ValueError("must hold different vertices")
    return [[corners[0], corners[i], corners[i + 1]] for i in range(1, len(corners) - 1)]


def _check_indices(rest: np.ndarray, faces: np.ndarray) -> None:
    if faces.max() >= len(rest):
        raise ValueError(f"has {len(rest)} vertices, and faces that refer to vertex {faces.max() + 1}")
    unused = np.setdiff1d(np.arange(len(rest)), faces)
    if len(unused):
        raise ValueError(f"has {len(unused)} vertices that belong to no face, like vertex {unused[0] + 1}: remove them")


def _lay_flat(rest: np.ndarray, up: str) -> np.ndarray:
    """The vertices (V, 3), the longest side 1 m, about the plane z = 0; ValueError where they do not lie flat."""
    turned = _turn_up(rest, up)
    extent = np.ptp(turned, axis=0)
    if not extent.max() > 0:
        raise ValueError("has all its vertices in one place")
    if extent[2] > MAX_RISE * extent.max():
        other = "y" if up == "z" else "z"
        fits = np.ptp(_turn_up(rest, other)[:, 2]) <= MAX_RISE * extent.max()
        advice = f'write "up": "{other}" in the object\'s file' if fits else "lay it flat"
        raise ValueError(f"must lie flat, {MAX_RISE:.0%} of its size high at most with its {up} axis up, got "
                         f"{extent[2] / extent.max():.0%}: {advice}")  # fmt: skip
    return (turned - turned.mean(0)) / extent.max()


def _turn_up(rest: np.ndarray, up: str) -> np.ndarray:
    """Vertices (V, 3) from a file's axes to ours; Blender's exporter writes x, z, -y where y is up."""
    return rest if up == "z" else rest[:, [0, 2, 1]] * (1, -1, 1)


def _check_edges(rest: np.ndarray, faces: np.ndarray) -> None:
    edges = np.linalg.norm(rest[faces[:, 0]] - rest[faces[:, 1]], axis=1)
    if not EDGES[0] <= np.median(edges) <= EDGES[1]:
        raise ValueError(f"must have edges {EDGES[0]:.3f} to {EDGES[1]:.3f} of its size long (median), "
                         f"got {np.median(edges):.3f}: remesh it")  # fmt: skip


def _check_one_layer(rest: np.ndarray, faces: np.ndarray) -> None:
    """ValueError where faces lie on each other, have no area, or hang together otherwise than a sheet's."""
    area = _measure_areas(rest, faces)
    flat = np.flatnonzero(np.abs(area) < 1e-4 * SPACING**2)
    if len(flat):
        numbers = ", ".join(str(v + 1) for v in faces[flat[0]])
        raise ValueError(f"has a face without an area seen from above, at the vertices {numbers}: triangulate it anew")
    if (area > 0).any() and (area < 0).any():
        raise ValueError(f"must have one layer whose faces look one way, got {np.sum(area > 0)} triangles that look "
                         f"up and {np.sum(area < 0)} down: remove a layer, or recalculate the normals")  # fmt: skip
    edges, times = count_edges(faces)
    if times.max() > 2:
        a, b = edges[np.argmax(times)] + 1
        raise ValueError(f"has an edge, from vertex {a} to {b}, that {times.max()} faces share: a sheet's edge has two")
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(rest), len(rest)))
    if (parts := connected_components(graph, directed=False)[0]) > 1:
        raise ValueError(f"must be in one piece, got {parts}: merge vertices in the same place, or give one piece")


def count_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges (E, 2) of faces, lower index first, and how many faces (E,) each has."""
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    return np.unique(sides, axis=0, return_counts=True)
