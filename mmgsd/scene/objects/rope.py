"""A rope of real strands, laid or braided around a settled centre line.

Its look is the same from both ends: a helix turned end for end is a helix of the same hand, both ends are cut and bound
alike, and a coloured strand runs the whole length. Only the optional ball breaks that symmetry.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import bpy
import numpy as np

from mmgsd.config import N_POINTS, RenderConfig
from mmgsd.scene.blender import DeformedObject, add_attribute, add_mesh
from mmgsd.scene.geometry import grid_faces, measure_arc
from mmgsd.scene.objects.rope_physics import LENGTH, resample
from mmgsd.scene.objects.rope_shape import RopeShape, own_parts, sample_rope

RINGS = {"laid": 480, "braided": 400, "cable": 480}  # cross-sections of a strand
SIDES = {"laid": 8, "braided": 6, "cable": 12}  # corners of a cross-section
OVERHANG = 0.25  # how far the strands reach beyond the first and last material point, in diameters
SLENDER = 150 / 32  # times the usual rope's least length in diameters, at most, in a workspace
OWN_ARC = 2.0  # a hit this near along the rope, in diameters, is the material point's own surface
MAIN, ACCENT, BALL = 0, 1, 2  # what a face belongs to; slots are numbered by what is there


@dataclass(frozen=True)
class Lay:
    """How the strands run around the centre line; lengths in diameters of the rope."""

    kind: str  # laid: twisted one way; braided: as many each way, over and under in turn; cable: one round strand
    strands: int
    pitch: float  # length of one turn
    strand_radius: float
    phase: float  # rad
    accents: int  # the first strands have the accent colour
    binding: float  # length of the band around each end, 0 for none
    plugs: tuple[float, float] = (0.0, 0.0)  # lengths of the connectors over the two ends, 0 for none
    plug: tuple[float, int] = (1.0, 4)  # their radius, and the corners of their cross-section
    frayed: float = 0.0  # how far loose yarns reach beyond the ends, 0 for none


Part = tuple[np.ndarray, int]  # vertices (rings, sides, 3) m of a surface that is closed around; its faces' kind


def build_rope(rng: np.random.Generator, config: RenderConfig) -> DeformedObject:
    """Add a random rope to the current scene: its 625 material points run along the centre line, end to end."""
    workspace = config.scene == "workspace"
    slenderness = (float(32 * SLENDER ** rng.random()),) * 2 if workspace else (32, 50)
    shape = sample_rope(rng, ball=config.ball, slenderness=slenderness)
    lay = draw_workspace_lay(rng, LENGTH / shape.thickness) if workspace else draw_lay(rng)
    points = resample(shape.centre, N_POINTS)
    info = {"state": shape.state, "n_crossings": len(shape.crossings), "thickness": shape.thickness, "lay": lay.kind,
            "strands": lay.strands, "pitch": lay.pitch * shape.thickness, "length": LENGTH}  # fmt: skip
    mesh = add_parts(build_parts(shape, lay))
    return DeformedObject(mesh, points, info, own_parts(points, OWN_ARC * shape.thickness), shape.thickness)


def draw_lay(rng: np.random.Generator) -> Lay:
    """A rope of three or four twisted strands, or a braid of eight."""
    phase, binding = rng.uniform(0, 2 * np.pi), rng.choice([0.0, rng.uniform(0.4, 1.4)])
    if rng.random() < 0.4:
        accents = int(rng.choice([0, 2, 4], p=[0.5, 0.25, 0.25]))
        return Lay("braided", 8, rng.uniform(3.2, 5.0), rng.uniform(0.125, 0.145), phase, accents, binding)
    strands = int(rng.choice([3, 4], p=[0.7, 0.3]))
    radius = rng.uniform(0.235, 0.27) if strands == 3 else rng.uniform(0.205, 0.235)
    return Lay("laid", strands, rng.uniform(2.4, 4.5), radius, phase, int(rng.random() < 0.35), binding)


def draw_workspace_lay(rng: np.random.Generator, slenderness: float) -> Lay:
    """A rope as above, or a plain cable, the longer (in diameters) the likelier; plugs at its ends, or loose yarns."""
    if rng.random() > np.clip((slenderness - 25) / 70, 0.25, 0.9):
        lay = draw_lay(rng)
        return dataclasses.replace(lay, frayed=rng.uniform(0.6, 2.0)) if rng.random() < 0.25 else lay
    ends = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])[rng.choice(4, p=[0.5, 0.1, 0.1, 0.3])]
    plugs = tuple((ends * rng.uniform(2.0, 5.0)).tolist())
    plug = (float(rng.uniform(0.8, 1.6)), int(rng.choice([4, 12])))
    return Lay("cable", 0, 1.0, 0.5, 0.0, 0, 0.0, plugs, plug)


def build_parts(shape: RopeShape, lay: Lay) -> list[Part]:
    """All surfaces of the rope, in metres: strands, a braid's core, bound ends, ball."""
    path = _extend(resample(shape.centre, RINGS[lay.kind]), OVERHANG * shape.thickness)
    side, up = _frame(path)
    arc = measure_arc(path) / shape.thickness
    cap = _cap(arc)
    flatness = 1.45 if lay.kind == "braided" else 1.0  # width over height of a strand: a braid's are flat yarns
    parts = []
    for strand in range(lay.strands):
        offset = _strand_offset(lay, strand, arc)  # (R, 2) diameters
        out = (offset[:, :1] * side + offset[:, 1:] * up) * shape.thickness
        tube = _sweep(path + out, out, lay.strand_radius * shape.thickness * cap, flatness, SIDES[lay.kind])
        parts.append((tube, ACCENT if strand < lay.accents else MAIN))
    if lay.kind == "cable":
        parts.append((_sweep(path, up, 0.5 * shape.thickness * cap, 1.0, SIDES["cable"]), MAIN))
    parts += _plugs(path, side, up, arc, lay, shape.thickness) + _yarns(path, side, up, lay, shape.thickness)
    if lay.kind == "braided":
        parts.append((_sweep(path, up, 0.30 * shape.thickness * cap, 1.0, 8), MAIN))
    parts += _bindings(path, up, arc, lay.binding, shape.thickness)
    if shape.ball_radius:
        parts.append((_sphere(shape.centre[0], shape.ball_radius), BALL))
    return parts


def _extend(path: np.ndarray, length: float) -> np.ndarray:
    """The path (R, 3) with straight ends of the given length, in a few rings for the round tips."""
    steps = np.linspace(0, length, 5)[1:, None]
    head, tail = (v / np.linalg.norm(v) for v in (path[0] - path[1], path[-1] - path[-2]))
    return np.concatenate([(path[0] + steps * head)[::-1], path, path[-1] + steps * tail])


def _frame(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the side and up (R, 3) each: a rope on a table is never vertical, so z fixes them."""
    tangent = np.gradient(path, axis=0)
    side = np.cross([0.0, 0.0, 1.0], tangent)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(tangent, side)
    return side, up / np.linalg.norm(up, axis=1, keepdims=True)


def _cap(arc: np.ndarray) -> np.ndarray:
    """Share (R,) of a strand's radius that is left along arc length (diameters): round, melted tips."""
    to_end = np.minimum(arc, arc[-1] - arc)
    return np.sqrt(1 - (1 - np.clip(to_end / 0.3, 0, 1)) ** 2 * 0.998)


def _strand_offset(lay: Lay, strand: int, arc: np.ndarray) -> np.ndarray:
    """Place of a strand's middle across the rope (R, 2), in diameters, over arc length (R,)."""
    turn = 2 * np.pi * arc / lay.pitch
    if lay.kind == "laid":
        angle = turn + lay.phase + 2 * np.pi * strand / lay.strands
        radius = 0.5 - lay.strand_radius
    else:  # two strands that run opposite ways meet each half step of 4 ωs: one is outside there, the other inside
        hand = 1 - 2 * (strand % 2)
        angle = hand * turn + lay.phase + 2 * np.pi * (strand // 2) / (lay.strands // 2)
        radius = 0.45 - lay.strand_radius + hand * 0.05 * np.cos(lay.strands / 2 * turn)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _sweep(path: np.ndarray, towards: np.ndarray, radius: np.ndarray, flatness: float, sides: int) -> np.ndarray:
    """A tube (R, sides, 3) along path (R, 3) of radius (R,), ``flatness`` times wider across ``towards`` (R, 3)."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = towards - (towards * tangent).sum(1, keepdims=True) * tangent
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = flatness * np.cross(tangent, first)
    angle = 2 * np.pi * np.arange(sides)[None, :, None] / sides
    ring = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]  # (R, sides, 3)
    return path[:, None] + radius[:, None, None] * ring


def _bindings(path: np.ndarray, up: np.ndarray, arc: np.ndarray, length: float, thickness: float) -> list[Part]:
    """A band around each end, ``length`` diameters long, none for 0."""
    parts = []
    for to_end in (arc, arc[-1] - arc) if length else ():
        band = np.flatnonzero((to_end > 0.2) & (to_end < 0.2 + length))
        shoulder = np.full(len(band), 0.515 * thickness)
        shoulder[[0, -1]] = 0.42 * thickness
        parts.append((_sweep(path[band], up[band], shoulder, 1.0, 16), ACCENT))
    return parts


def _plugs(
    path: np.ndarray, side: np.ndarray, up: np.ndarray, arc: np.ndarray, lay: Lay, thickness: float
) -> list[Part]:
    """A connector over each end that has one, from the tip inwards; its lower half may sink into the table."""
    parts = []
    for to_end, length in zip((arc, arc[-1] - arc), lay.plugs, strict=True):
        covered = np.flatnonzero(to_end < length) if length else []
        if len(covered) > 3:
            radius = np.full(len(covered), lay.plug[0] * thickness)
            radius[[0, -1]] = 1e-4  # closed at both ends
            towards = up[covered] + (side[covered] if lay.plug[1] == 4 else 0)  # a box lies on a face, not on an edge
            parts.append((_sweep(path[covered], towards, radius, 1.0, lay.plug[1]), ACCENT))
    return parts


def _yarns(path: np.ndarray, side: np.ndarray, up: np.ndarray, lay: Lay, thickness: float) -> list[Part]:
    """Loose yarns that fan out beyond both ends, where the rope is frayed: the ends look blurred."""
    parts = []
    for end, inner in ((0, 1), (-1, -2)) if lay.frayed else ():
        out = (path[end] - path[inner]) / np.linalg.norm(path[end] - path[inner])
        steps = np.linspace(-0.3, lay.frayed, 6)[:, None] * thickness
        for k in range(11):
            aside = 0.9 * np.sin(2.4 * k + lay.phase) * side[end] + 0.35 * np.cos(1.7 * k) * up[end]
            spread = 0.3 * thickness + np.maximum(steps, 0) ** 2 / (lay.frayed * thickness)
            yarn = path[end] + steps * out + spread * aside
            yarn[:, 2] = np.maximum(yarn[:, 2], 0.07 * thickness)
            towards = np.broadcast_to(up[end], yarn.shape)
            parts.append((_sweep(yarn, towards, np.full(6, 0.07 * thickness), 1.0, 4), MAIN))
    return parts


def _sphere(centre: np.ndarray, radius: float) -> np.ndarray:
    """A sphere (24, 32, 3) around centre (3,) as rings from the bottom to the top."""
    height = np.sin(np.linspace(-np.pi / 2 + 1e-3, np.pi / 2 - 1e-3, 24))
    path = centre + radius * height[:, None] * np.array([0.0, 0.0, 1.0])
    across = np.broadcast_to([1.0, 0.0, 0.0], path.shape)
    return _sweep(path, across, radius * np.sqrt(1 - height**2), 1.0, 32)


def add_parts(parts: list[Part]) -> bpy.types.Object:
    """One smooth object of all parts, a material slot for each kind of face that occurs."""
    faces, kinds, places, start = [], [], [], 0
    for vertices, kind in parts:
        rings, sides = vertices.shape[:2]
        faces.append(start + grid_faces(rings, sides, closed=True))
        kinds.append(np.full(len(faces[-1]), kind))
        along, around = np.mgrid[0 : 1 : rings * 1j, 0 : 1 : (sides + 1) * 1j][:, :, :-1]
        places.append(np.stack([along, around, 0 * along], axis=-1).reshape(-1, 3))
        start += rings * sides
    everything = np.concatenate([vertices.reshape(-1, 3) for vertices, _ in parts])
    rope = add_mesh("rope", everything, np.concatenate(faces))
    add_attribute(rope.data, "along", np.concatenate(places))  # for images: along each part, and around it
    used, slots = np.unique(np.concatenate([[MAIN], *kinds]), return_inverse=True)
    for kind in used:
        rope.data.materials.append(bpy.data.materials.new(f"rope {kind}"))
    rope.data.polygons.foreach_set("material_index", slots[1:].astype(np.int32))
    rope.data.polygons.foreach_set("use_smooth", np.ones(len(slots) - 1, dtype=bool))
    rope.data.update()
    return rope
