"""A square cloth, or a sheet of another shape, dropped, pinned, dragged and folded over by cloth physics."""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from mmgsd.config import RenderConfig
from mmgsd.scene import SceneError, blender
from mmgsd.scene.blender import DeformedObject, add_mesh, read_vertices
from mmgsd.scene.geometry import choose, grid_faces
from mmgsd.scene.objects.meshes import SPACING, count_edges
from mmgsd.scene.objects.planar_object import PlanarObject
from mmgsd.symmetry import grid_group

SIDE = 37  # simulated vertices a side; with 49 a frame takes nearly twice as long
RENDERED_SIDE = 2 * SIDE - 1  # once subdivided: every third vertex is a material point
EXTENT = 1.0  # m
OWN_RADIUS = 0.004  # m; less than the distance that self-collision keeps between two layers
STATES = {"flat": 0.10, "wrinkled": 0.24, "folded": 0.26, "folded twice": 0.10, "corner": 0.20, "crumpled": 0.10}
# in a workspace: lying about as on a table, and folded as grippers fold
WORKSPACE_STATES = {
    "flat": 0.14, "wrinkled": 0.22, "folded": 0.16, "folded twice": 0.06, "corner": 0.12, "crumpled": 0.08,
    "grasped": 0.16, "grasped twice": 0.06,
}  # fmt: skip
SETTLE_FRAMES = 8
FRICTION = 40.0  # of the floor, in Blender's units
ATTEMPTS = 3  # at a move, before the cloth starts anew
STARTS = 100  # of one cloth at most; a crumpled T-shirt or towel takes two on average
MAX_STRETCH = 1.22  # of the 99th percentile of edges
MAX_HEIGHT = 0.17  # m
MAX_CROSSINGS = 9  # pairs of quads, of 1296, that cut each other: more are seen as spots of the other layer


Grasps = dict[int, np.ndarray]  # displacements (F, 3) m of vertices from their start, one a frame; zeros pin one
Plan = Callable[[np.random.Generator, np.ndarray], tuple[Grasps, int]]


def build_cloth(rng: np.random.Generator, config: RenderConfig, planar: PlanarObject | None = None) -> DeformedObject:
    """Deform a cloth, or a ``planar`` sheet, into a random state and add it to the current scene (see `add_cloth`)."""
    states = STATES
    if planar is None and config.scene == "workspace":
        planar, states = draw_rectangle(rng), WORKSPACE_STATES
    state = choose(rng, states)
    vertices, frames = deform(rng, state, planar)
    return add_cloth(vertices, {"state": state, "physics_frames": frames}, planar)


def add_cloth(
    vertices: np.ndarray, info: dict[str, str | float | int], planar: PlanarObject | None = None
) -> DeformedObject:
    """Add simulated vertices (V, 3) m of a sheet (None: the square) to the scene, smoothly subdivided, on the floor.

    The 625 points of a square or a rectangle are (25, 25) row-major vertices of the rendered surface itself; of another
    sheet, each of its vertices is a material point.
    """
    planar = planar or square_cloth()
    mesh = _add_rendered(vertices, planar)
    chosen = slice(len(vertices))  # subdivision appends the new ones
    if planar.name == "cloth":
        chosen = _order_row_major(mesh.data)[::3, ::3].ravel()
    points = read_vertices(mesh.data)[chosen]
    return DeformedObject(mesh, points, info, lambda hits, i: np.linalg.norm(hits - points[i], axis=1) < OWN_RADIUS)


def deform(rng: np.random.Generator, state: str, planar: PlanarObject | None = None) -> tuple[np.ndarray, int]:
    """Simulate one state of ``MOVES`` of a sheet (None: the square cloth): vertices (V, 3) m, and physics frames.

    ValueError for another state; SceneError, which counts why, where the sheet never comes to lie in it.
    """
    if state not in MOVES:
        raise ValueError(f"state must be one of {', '.join(MOVES)}, got {state!r}")
    planar, frames, faults = planar or square_cloth(), 0, Counter()
    for _ in range(STARTS):
        vertices = _rippled(rng, planar, 0.001 if state == "flat" else 0.008)
        for move in MOVES[state]:
            vertices, count = _perform(rng, planar, vertices, move, faults)
            frames += count
            if vertices is None:
                break
        else:
            return vertices, frames
    reasons = ", ".join(f"{fault} {count} times" for fault, count in faults.most_common())
    raise SceneError(f"{planar.name} did not come to lie in the state {state!r} in {STARTS} starts with {ATTEMPTS} "
                     f"attempts at a move each: it ended {reasons}")  # fmt: skip


def _perform(
    rng: np.random.Generator, planar: PlanarObject, start: np.ndarray, move: tuple[Plan, ...], faults: Counter[str]
) -> tuple[np.ndarray | None, int]:
    """The vertices after a move, None where it failed too often, and all attempts' frames; ``faults`` counts why."""
    frames = 0
    for _ in range(ATTEMPTS):
        vertices = start.copy()
        for plan in move:
            grasps, count = plan(rng, vertices)
            vertices = simulate(planar, vertices, grasps, count)[-1]
            frames += count
        if not (fault := _find_fault(planar, vertices)):
            return vertices, frames
        faults[fault] += 1
    return None, frames


def _find_fault(planar: PlanarObject, vertices: np.ndarray) -> str:
    """How a cloth lies that is no good; empty where it lies hardly stretched and hardly cutting through itself."""
    if not np.isfinite(vertices).all():
        return "nowhere"
    if measure_stretch(planar, vertices) > MAX_STRETCH:
        return f"stretched to more than {MAX_STRETCH:g} of its length"
    if np.ptp(vertices[:, 2]) >= MAX_HEIGHT:
        return f"{MAX_HEIGHT:g} m high or higher"
    if count_crossings(vertices, planar.faces) > MAX_CROSSINGS:
        return f"cutting through itself at more than {MAX_CROSSINGS} places"
    return ""


def measure_stretch(planar: PlanarObject, vertices: np.ndarray) -> float:
    """How much longer than at rest the edges of a cloth (V, 3) m are: the 99th percentile of their shares."""
    a, b = count_edges(planar.faces)[0].T
    now, at_rest = (np.linalg.norm(points[a] - points[b], axis=-1) for points in (vertices, planar.rest))
    return float(np.quantile(now / at_rest, 0.99))


def count_crossings(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Pairs of faces (F, 3 or 4) of a cloth (V, 3) that intersect and share no vertex."""
    tree = BVHTree.FromPolygons(vertices.tolist(), faces.tolist())
    a, b = np.array(tree.overlap(tree), dtype=int).reshape(-1, 2).T
    neighbours = (faces[a][:, :, None] == faces[b][:, None, :]).any(axis=(1, 2))
    return int(np.sum(~neighbours & (a < b)))


def flat_vertices() -> np.ndarray:
    """The rest shape (1369, 3) m, row-major, centred: row r runs along -y, column c along x."""
    axis = np.linspace(-EXTENT / 2, EXTENT / 2, SIDE)
    y, x = np.meshgrid(-axis, axis, indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


@functools.cache
def square_cloth() -> PlanarObject:
    """The simulated square cloth."""
    faces = grid_faces(SIDE, SIDE)[:, ::-1]  # normals up
    return PlanarObject("cloth", flat_vertices(), faces, grid_group("c4", side=SIDE))


def draw_rectangle(rng: np.random.Generator) -> PlanarObject:
    """The square cloth, or one up to 1.5 times longer than wide, whose points and symmetry are those of the square."""
    square = square_cloth()
    width = rng.choice([1.0, rng.uniform(0.93, 1.0), rng.uniform(1 / 1.5, 0.93)], p=[0.5, 0.15, 0.35])
    return dataclasses.replace(square, rest=square.rest * (width, 1.0, 1.0))


def _rippled(rng: np.random.Generator, planar: PlanarObject, height: float) -> np.ndarray:
    """The rest shape with long random waves of about ``height`` m: gives physics something to buckle along."""
    vertices = planar.rest.copy()
    if planar.either_face and rng.random() < 0.5:
        vertices *= (1, -1, -1)
    for _ in range(6):
        wave = rng.normal(size=2) * 9.0  # rad/m
        vertices[:, 2] += height * rng.normal() * np.sin(vertices[:, :2] @ wave + rng.uniform(0, 2 * np.pi))
    vertices[:, 2] += 0.012 - vertices[:, 2].min()
    return vertices


# Plans: (rng, vertices) -> (grasps, frames) of one simulation; they may move the vertices first. --------------------


def _settle(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Let go."""
    return {}, SETTLE_FRAMES


def _drop(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Raise and tilt the cloth in place, pin it at up to two random points in the air, let the rest fall."""
    tilt = rng.uniform(-0.25, 0.25, size=2)
    vertices[:, 2] += vertices[:, :2] @ tilt
    vertices[:, 2] += rng.uniform(0.02, 0.08) - vertices[:, 2].min()
    picked = rng.choice(len(vertices), size=rng.integers(0, 3), replace=False)
    frames = 16
    return {int(i): np.zeros((frames, 3)) for i in picked}, frames


def _drag(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Push two to four random points across the floor, roughly inwards, so that wrinkles form between them."""
    frames = 14
    picked = rng.choice(len(vertices), size=rng.integers(2, 5), replace=False)
    progress = np.linspace(0, 1, frames)[:, None]
    inward = -vertices[picked, :2] * rng.uniform(0.15, 0.45, size=(len(picked), 1))
    target = inward + rng.normal(scale=0.04, size=(len(picked), 2))
    return {int(i): progress * np.append(t, 0.01) for i, t in zip(picked, target, strict=True)}, frames


def _gather(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Lift random points and bring them together: a crumpled heap."""
    frames = 26
    picked = rng.choice(len(vertices), size=rng.integers(4, 8), replace=False)
    centre = rng.uniform(-0.1, 0.1, size=2)
    grasps = {}
    for i in picked:
        offset = (centre - vertices[i, :2]) * rng.uniform(0.4, 0.75)
        shift = np.append(offset, rng.uniform(0.0, 0.06))
        grasps[int(i)] = arc_path(shift, rng.uniform(0.05, 0.3), frames)
    return grasps, frames


def _fold(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Fold along a line parallel to an edge or oblique, grasping the far rim where it is furthest."""
    angle = rng.integers(4) * np.pi / 2 + rng.choice([0.0, np.pi / 4, rng.uniform(0, np.pi / 2)])
    return _fold_over(rng, vertices, angle, rng.uniform(0.35, 0.7))


def _fold_corner(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Fold one corner over, so that some of the under-side shows."""
    angle = rng.integers(4) * np.pi / 2 + np.pi / 4 + rng.uniform(-0.35, 0.35)
    return _fold_over(rng, vertices, angle, rng.uniform(0.2, 0.4))


def _fold_over(rng: np.random.Generator, vertices: np.ndarray, angle: float, share: float) -> tuple[Grasps, int]:
    """Move the vertices furthest in direction ``angle`` (rad) over the line that cuts off ``share`` of the cloth."""
    normal, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    along = vertices[:, :2] @ normal
    line = along.max() - share * np.ptp(along)
    tangent = vertices[:, :2] @ across
    rim = np.flatnonzero(along > along.max() - 1.5 * SPACING)
    grasped = {int(rim[np.argmin(tangent[rim])]), int(rim[np.argmax(tangent[rim])]), int(rim[len(rim) // 2])}
    frames = int(15 + 20 * (along.max() - line))
    reach, skew = rng.uniform(0.85, 1.0), rng.normal(scale=0.05)
    grasps = {}
    for i in sorted(grasped):
        shift = -2 * reach * (along[i] - line) * (normal + skew * across)
        grasps[i] = arc_path(np.append(shift, 0.03), 0.75 * (along[i] - line), frames)
    return grasps | _pin(rng, np.flatnonzero(along < line - 4 * SPACING), frames), frames


def _pin(rng: np.random.Generator, vertices: np.ndarray, frames: int) -> Grasps:
    """Hold four of the vertices (N,), or all where they are fewer, in their places."""
    return {int(i): np.zeros((frames, 3)) for i in rng.choice(vertices, size=min(4, len(vertices)), replace=False)}


def _fold_grasped(rng: np.random.Generator, vertices: np.ndarray) -> tuple[Grasps, int]:
    """Carry one corner of a cloth (1369, 3) m or two neighbours towards the opposite, as one gripper or two do."""
    corners = np.array([0, SIDE - 1, SIDE**2 - 1, SIDE * (SIDE - 1)])  # around the cloth
    first, hands = int(rng.integers(4)), int(rng.integers(1, 3))
    grasped = np.roll(corners, -first)[:hands]
    opposite = np.roll(corners, -first - 2)[:hands][::-1]
    shifts = rng.uniform(0.4, 1.0) * (vertices[opposite, :2] - vertices[grasped, :2])
    shifts = shifts + rng.normal(scale=0.03, size=shifts.shape)
    length = np.linalg.norm(shifts, axis=1)
    frames = int(15 + 20 * length.max())
    grasps = {int(i): arc_path(np.append(shift, 0.03), 0.4 * far, frames)
              for i, shift, far in zip(grasped, shifts, length, strict=True)}  # fmt: skip
    along = (vertices[:, :2] - vertices[grasped[0], :2]) @ shifts.mean(axis=0) / max(length.max(), 1e-6)
    anchors = np.setdiff1d(np.flatnonzero(along > 0.55 * length.max()), grasped)
    return grasps | _pin(rng, anchors, frames), frames


def arc_path(shift: np.ndarray, height: float, frames: int) -> np.ndarray:
    """Displacements (F, 3) along a half ellipse to ``shift`` (3,), ``height`` m high, slow at both ends, then held."""
    hold = 3
    s = np.linspace(0, 1, frames - hold)
    theta = np.pi * (s + s * s * (3 - 2 * s)) / 2
    path = (1 - np.cos(theta))[:, None] / 2 * shift
    path[:, 2] += height * np.sin(theta)
    return np.concatenate([path, np.repeat(path[-1:], hold, axis=0)])


# Moves follow each other; each is made of plans and tried again from where it began if the cloth comes to no good.
MOVES: dict[str, tuple[tuple[Plan, ...], ...]] = {
    "flat": ((_settle,),),
    "wrinkled": ((_drop, _drag, _settle),),
    "folded": ((_fold, _settle),),
    "folded twice": ((_fold, _settle), (_fold, _settle)),
    "corner": ((_fold_corner, _settle),),
    "crumpled": ((_gather, _settle),),
    "grasped": ((_fold_grasped, _settle),),
    "grasped twice": ((_fold_grasped, _settle), (_fold_grasped, _settle)),
}


# Physics. -----------------------------------------------------------------------------------------------------------


def simulate(
    planar: PlanarObject, vertices: np.ndarray, grasps: Grasps, frames: int, *, friction: float = FRICTION
) -> np.ndarray:
    """Vertices (frames, V, 3) m under cloth physics, from ``vertices`` (V, 3) m at rest on; some may not be finite.

    The cloth remembers its flat shape. Grasped vertices follow their paths, which must be ``frames`` long; ``friction``
    (0 to 80) is that of the floor.
    """
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, frames
    scene.frame_set(1)
    cloth = add_mesh("cloth physics", planar.rest, planar.faces)
    floor = _add_physics_floor(friction)
    cloth.shape_key_add(name="rest")
    start = cloth.shape_key_add(name="start")
    start.data.foreach_set("co", vertices.astype(np.float32).ravel())
    start.value = 1.0
    hooks = [_add_hook(cloth, vertex, path) for vertex, path in grasps.items()]
    _add_physics(cloth, list(grasps), frames)
    passed = []
    for frame in range(1, frames + 1):
        scene.frame_set(frame)
        passed.append(read_vertices(cloth.evaluated_get(bpy.context.evaluated_depsgraph_get()).data))
    for thing in (cloth, floor, *hooks):
        bpy.data.objects.remove(thing)
    return np.stack(passed)


def _add_hook(cloth: bpy.types.Object, vertex: int, path: np.ndarray) -> bpy.types.Object:
    """What moves a vertex along a path (F, 3) m."""
    hook = blender.add_object("hook", None)
    for frame, shift in enumerate(path, start=1):
        hook.location = shift
        hook.keyframe_insert("location", frame=frame)
    modifier = cloth.modifiers.new("hook", "HOOK")
    modifier.object = hook
    modifier.falloff_type = "NONE"
    modifier.vertex_indices_set([vertex])
    return hook


def _add_physics(cloth: bpy.types.Object, pinned: list[int], frames: int) -> None:
    group = cloth.vertex_groups.new(name="pinned")
    group.add(pinned, 1.0, "REPLACE")
    modifier = cloth.modifiers.new("cloth", "CLOTH")
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 1, frames
    settings, collision = modifier.settings, modifier.collision_settings
    settings.rest_shape_key = cloth.data.shape_keys.key_blocks["rest"]
    settings.vertex_group_mass = "pinned"
    settings.quality = 3  # with 2, most crumpled cloths cut through themselves
    settings.bending_stiffness = 0.2
    collision.use_self_collision = True
    collision.self_distance_min = 0.006  # under a third of an edge: neighbours must not push each other
    collision.distance_min = 0.005
    collision.collision_quality = 2  # with 1, layers pass through each other at ten times as many places


def _add_physics_floor(friction: float) -> bpy.types.Object:
    floor = blender.add_floor("physics floor", 3.0)
    floor.modifiers.new("collision", "COLLISION")
    floor.collision.cloth_friction = friction
    floor.collision.thickness_outer = 0.005
    return floor


# The rendered surface. ----------------------------------------------------------------------------------------------


def _add_rendered(vertices: np.ndarray, planar: PlanarObject) -> bpy.types.Object:
    """A smooth static mesh lying on z = 0: of the square cloth's, 73 × 73 vertices."""
    coarse = add_mesh("cloth coarse", vertices, planar.faces)
    if planar.name == "cloth":  # textures in its own coordinates; they have a square's symmetry
        blender.add_attribute(coarse.data, "rest", flat_vertices() / EXTENT)
    low, size = planar.rest.min(axis=0), np.ptp(planar.rest, axis=0)
    over = (planar.rest - low) / np.maximum(size, 1e-9)
    blender.add_attribute(coarse.data, "face", over)  # for images: 0 to 1 over it
    subdivision = coarse.modifiers.new("subdivision", "SUBSURF")
    subdivision.levels = 1
    mesh = bpy.data.meshes.new_from_object(coarse.evaluated_get(bpy.context.evaluated_depsgraph_get()))
    bpy.data.objects.remove(coarse)
    dense = read_vertices(mesh)
    dense[:, 2] += 0.001 - dense[:, 2].min()
    mesh.vertices.foreach_set("co", dense.astype(np.float32).ravel())
    mesh.shade_smooth()
    mesh.materials.append(None)
    return blender.add_object("cloth", mesh)


def _order_row_major(mesh: bpy.types.Mesh) -> np.ndarray:
    """Indices (73, 73) of a subdivided cloth's vertices by their place at rest; Blender appends the new ones."""
    rest = blender.read_attribute(mesh, "rest")[:, :2]
    column, row = np.rint((rest * (1, -1) + 0.5) * (RENDERED_SIDE - 1)).astype(int).T
    order = np.empty((RENDERED_SIDE, RENDERED_SIDE), dtype=int)
    order[row, column] = np.arange(len(rest))
    return order
