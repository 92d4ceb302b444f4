"""Distractors beside the object, occluders on it: boxes, mugs, books, cords, textiles, grippers, hands.

A maker gives the parts of one of about a hand's size (m) that stands on z = 0 at the origin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from mmgsd.scene.geometry import Camera, log_uniform
from mmgsd.scene.textures.colours import RGB, draw_rgb, vary_rgb
from mmgsd.scene.workspace.materials import paint_plain, paint_surface
from mmgsd.scene.workspace.primitives import (
    Solid,
    make_box,
    make_capsule,
    make_lathe,
    make_textile,
    make_tube,
    merge,
    move,
)
from mmgsd.scene.workspace.surfaces import Site, add_solid

TRIES = 12  # to find a place
OCCLUDER_COUNTS = (0.6, 0.3, 0.1)  # probabilities of 0, 1 and 2 things on the object
MAX_OCCLUDED = 0.5  # share of the points seen that may be covered
SKINS = ((236, 188, 160), (198, 134, 100), (141, 85, 54), (82, 50, 34), (60, 120, 200), (20, 20, 22))  # and gloves

Part = tuple[Solid, RGB, bool]  # a solid, its colour, and whether it may be printed upon
Maker = Callable[[np.random.Generator], list[Part]]
Place = Callable[[np.random.Generator, Site, list[Part]], list[Part] | None]


# Makers. --------------------------------------------------------------------------------------------------------------


def _make_box(rng: np.random.Generator) -> list[Part]:
    size = rng.uniform(0.04, 0.22, size=3) * (1, 1, 0.7)
    return [(make_box(size, (0, 0, size[2] / 2)), draw_rgb(rng), True)]


def _make_disc(rng: np.random.Generator) -> list[Part]:
    """A plate, a lid, a roll of tape."""
    radius, height, hole = rng.uniform(0.02, 0.13), rng.uniform(0.003, 0.05), rng.choice([0.0, 0.7])
    profile = [(0, 0), (radius, 0), (radius, height), (hole * radius + 1e-4, height), (hole * radius + 1e-4, 0)]
    return [(make_lathe(profile), draw_rgb(rng), not hole)]


def _make_mug(rng: np.random.Generator) -> list[Part]:
    radius, height = rng.uniform(0.03, 0.055), rng.uniform(0.06, 0.16)
    inner = 0.9 * radius
    profile = [(0, 0), (radius, 0), (radius, height), (inner, height), (0.8 * inner, 0.3 * height), (0, 0.3 * height)]
    angle = np.linspace(-1.4, 1.4, 12)
    bow = np.stack([radius + 0.4 * height * np.cos(angle), 0 * angle, height * (0.5 + 0.3 * np.sin(angle))], axis=1)
    colour = draw_rgb(rng)
    handle = [(make_tube(bow, 0.12 * radius), colour, False)] if rng.random() < 0.6 else []
    return [(make_lathe(profile), colour, True), *handle]


def _make_book(rng: np.random.Generator) -> list[Part]:
    width, length, height = rng.uniform(0.12, 0.2), rng.uniform(0.18, 0.28), rng.uniform(0.008, 0.04)
    pages = make_box((width - 0.006, length - 0.008, height - 0.004), (0.002, 0, height / 2))
    cover = [make_box((width, length, 0.002), (0, 0, z)) for z in (0.001, height - 0.001)]
    return [(pages, (235, 230, 215), False), *((lid, draw_rgb(rng), True) for lid in cover)]


def _make_pen(rng: np.random.Generator) -> list[Part]:
    length, radius = rng.uniform(0.1, 0.22), rng.uniform(0.003, 0.009)
    half, cap = length / 2, rng.uniform(0, 1) * length - length / 2
    body = make_capsule((-half, 0, radius), (cap, 0, radius), radius)
    return [(body, draw_rgb(rng), False), (make_capsule((cap, 0, radius), (half, 0, radius), radius, radius / 2),
                                             draw_rgb(rng), False)]  # fmt: skip


def _make_cord(rng: np.random.Generator) -> list[Part]:
    """A cable that winds for a metre or two; it has no ends of note, other ropes than the object must not look so."""
    radius, drift = rng.uniform(0.002, 0.007), rng.normal(scale=0.1, size=2)
    knots = np.cumsum(rng.normal(scale=0.22, size=(7, 2)) + drift, axis=0)
    path = CubicSpline(np.arange(7), knots - knots[3])(np.linspace(0, 6, 90))
    return [(make_tube(np.column_stack([path, np.full(90, radius)]), radius, sides=7), draw_rgb(rng), False)]


def _make_textile(rng: np.random.Generator) -> list[Part]:
    """Another cloth, rippled."""
    width, length = rng.uniform(0.3, 1.2, size=2)
    ripple = 0.002 + rng.uniform(0.004, 0.03) * rng.random((9, 9))
    return [(make_textile(width, length, ripple), draw_rgb(rng), True)]


def _make_weight(rng: np.random.Generator) -> list[Part]:
    """Something small: a coin, a die, a clip."""
    return _scale(_make_disc(rng) if rng.random() < 0.5 else _make_box(rng), 0.35)


def _make_gripper(rng: np.random.Generator) -> list[Part]:
    """Two fingers, a palm and an arm, from the tips at the origin upwards."""
    gap, length = rng.uniform(0.005, 0.05), rng.uniform(0.05, 0.11)
    thick, wide, dark = rng.uniform(0.008, 0.02), rng.uniform(0.015, 0.03), draw_rgb(rng)
    fingers = [make_box((thick, wide, length), (s * (gap + thick) / 2, 0, length / 2)) for s in (-1, 1)]
    palm = make_box((0.09 + gap, wide * 2.2, 0.06), (0, 0, length + 0.03))
    heights = [(0, 0, length + z) for z in (0.05, 0.2, 0.25, 0.6, 1.2)]
    arm, body = make_tube(heights, [0.035, 0.035, 0.05, 0.05, 0.05], sides=18), draw_rgb(rng)
    parts = [(finger, dark, False) for finger in fingers]
    return [*parts, (palm, body, False), (arm, vary_rgb(rng, body, 0.2), False)]


def _make_tool(rng: np.random.Generator) -> list[Part]:
    """A stick, a rod, a spatula: a handle that comes from outside, and its head at the origin."""
    radius, head = rng.uniform(0.004, 0.018), rng.choice(["none", "blade", "ring"])
    parts = [(make_capsule((0, 0, radius), (0, 0, 1.3), radius), draw_rgb(rng), False)]
    if head == "blade":
        parts.append((make_box((rng.uniform(0.01, 0.08), 0.006, 0.1), (0, 0, 0.05)), draw_rgb(rng), False))
    elif head == "ring":
        angle = np.linspace(0, 2 * np.pi, 20)
        ring = np.stack([0.03 * np.cos(angle), 0 * angle, 0.03 + 0.03 * np.sin(angle)], axis=1)
        parts.append((make_tube(ring, 0.005), draw_rgb(rng), False))
    return parts


def _make_hand(rng: np.random.Generator) -> list[Part]:
    """Fingers from their tips at the origin, a back and a forearm with a sleeve, upwards along z, flat across x."""
    skin = vary_rgb(rng, SKINS[rng.integers(len(SKINS))], 0.1)
    fingers = []
    for k, length in enumerate((0.062, 0.078, 0.084, 0.075)):
        root, spread = (0.0, (k - 1.5) * 0.021, 0.09), rng.normal(scale=0.006)
        bent = (0.02 + rng.uniform(0, 0.03), root[1] + spread, 0.09 - 0.5 * length)
        tip = (0.0, bent[1] + spread, 0.09 - length)
        fingers += [make_capsule(root, bent, 0.0095), make_capsule(bent, tip, 0.009, 0.007)]
    fingers.append(make_capsule((0.0, 0.035, 0.14), (-0.005, 0.075, 0.08), 0.013, 0.009))  # thumb
    back = make_tube([(0.008, 0, z) for z in (0.08, 0.1, 0.14, 0.17, 0.2)], [0.03, 0.042, 0.044, 0.036, 0.03], sides=16)
    back = Solid(back.vertices * (0.45, 1, 1), back.faces, True)
    arm = make_tube([(0.0, 0, z) for z in (0.19, 0.3, 0.6, 1.1)], [0.028, 0.036, 0.045, 0.055], sides=16)
    sleeve = skin if rng.random() < 0.4 else draw_rgb(rng)
    return [*((solid, skin, False) for solid in (*fingers, back)), (arm, sleeve, False)]


def _scale(parts: list[Part], factor: float) -> list[Part]:
    return [(Solid(solid.vertices * factor, solid.faces, solid.smooth), *rest) for solid, *rest in parts]


def _move(parts: list[Part], turn: float, place: tuple[float, float, float], *, lean: float = 0.0) -> list[Part]:
    return [(move(solid, turn, place, lean=lean), *rest) for solid, *rest in parts]


def _stack(parts: list[Part]) -> np.ndarray:
    """The vertices (V, 3) m of all parts."""
    return np.concatenate([solid.vertices for solid, *_ in parts])


DISTRACTORS: dict[str, Maker] = {
    "box": _make_box, "disc": _make_disc, "mug": _make_mug, "book": _make_book, "pen": _make_pen,
    "weight": _make_weight, "textile": _make_textile, "cord": _make_cord,
}  # fmt: skip
OCCLUDERS: dict[str, Maker] = {"gripper": _make_gripper, "tool": _make_tool, "hand": _make_hand}
ON_OBJECT = ("pen", "weight", "disc", "box", "cord")


# Places. --------------------------------------------------------------------------------------------------------------


def add_distractors(
    rng: np.random.Generator, site: Site, camera: Camera, visible: np.ndarray, *, beside: bool, walls: list[Solid],
    over: bool = True,
) -> tuple[np.ndarray, list[str]]:  # fmt: skip
    """Put distractors around the object and occluders on it: which points (P,) stay ``visible``, and their names.

    ``walls`` are solids that are there already; without ``over`` nothing lies on the object or reaches for it. What
    would hide too much, or stand before the lens, is left out.
    """
    scale, names = log_uniform(rng, 0.5, 1.6) * site.side, []
    remaining = visible & ~find_occluded(walls, site.points, camera)
    for name, maker, place in _choose(rng, site, beside, over):
        for _ in range(TRIES):
            parts = place(rng, site, _scale(maker(rng), scale))
            if parts is None or not _is_clear(parts, camera):
                continue
            after = remaining & ~find_occluded([solid for solid, *_ in parts], site.points, camera)
            if after.sum() >= max(8, (1 - MAX_OCCLUDED) * visible.sum()) or not visible.any():
                remaining = after
                names.append(name)
                _add(rng, parts)
                break
    return remaining, names


def add_occluder(rng: np.random.Generator, name: str, place: np.ndarray, *, lean: float, turn: float) -> None:
    """Put one of `OCCLUDERS` with its lowest point over a place (3,) m, leaning (rad) from z, turned (rad) about it."""
    parts = _move(OCCLUDERS[name](rng), turn, (0, 0, 0), lean=lean)
    _add(rng, _move(parts, 0.0, (*place[:2], place[2] - _stack(parts)[:, 2].min())))


def find_occluded(solids: list[Solid], points: np.ndarray, camera: Camera) -> np.ndarray:
    """Which points (P, 3) lie behind one of the solids, seen from the camera: (P,) bool."""
    covered, eye = np.zeros(len(points), dtype=bool), camera.pose[:3, 3]
    if not solids:
        return covered
    solid = merge(solids)
    tree = BVHTree.FromPolygons(solid.vertices.tolist(), solid.faces.tolist())
    for i, point in enumerate(points):
        distance = np.linalg.norm(point - eye)
        covered[i] = tree.ray_cast(Vector(eye), Vector(point - eye), distance)[0] is not None
    return covered


def _choose(rng: np.random.Generator, site: Site, beside: bool, over: bool) -> Iterator[tuple[str, Maker, Place]]:
    """Names, makers and placers of what is put around and on the object; no cord beside a rope, they are too alike."""
    around, upon = ([name for name in names if name != "cord" or not site.thickness]
                    for names in (DISTRACTORS, ON_OBJECT))  # fmt: skip
    for _ in range(min(6, rng.poisson(1.6)) if beside else 0):
        name = str(rng.choice(around))
        yield name, DISTRACTORS[name], _place_beside
    for _ in range(int(rng.choice(len(OCCLUDER_COUNTS), p=OCCLUDER_COUNTS)) if over else 0):
        names, place = (list(OCCLUDERS), _place_over) if rng.random() < 0.65 else (upon, _place_upon)
        name = str(rng.choice(names))
        yield name, (DISTRACTORS | OCCLUDERS)[name], place


def _place_beside(rng: np.random.Generator, site: Site, parts: list[Part]) -> list[Part] | None:
    """Standing somewhere in the picture, clear of the object; None where it is not."""
    place, turn = site.ground_points[rng.integers(len(site.ground_points))], site.draw_turn(rng)
    moved = _move(parts, turn, (*place, -0.002))
    gap = cKDTree(_stack(moved)[:, :2]).query(site.points[::5, :2])[0].min()
    inner = np.linalg.norm(site.points[:, :2] - place, axis=1).min()  # of a large thing with few vertices
    return moved if gap > 0.02 and inner > 0.4 * np.ptp(_stack(parts)[:, :2], axis=0).min() else None


def _place_over(rng: np.random.Generator, site: Site, parts: list[Part]) -> list[Part]:
    """Reaching for a point of the object from outside the picture."""
    place = site.points[rng.integers(len(site.points))]
    lean, turn = np.radians(rng.uniform(35, 84)), rng.uniform(0, 2 * np.pi)
    rolled = _move(parts, rng.choice([0, np.pi]), (0, 0, 0))
    moved = _move(rolled, 0.0, (0, 0, 0), lean=lean)
    return _move(moved, turn, (*place[:2], _find_top(site, place, 0.05) - _stack(moved)[:, 2].min()))


def _place_upon(rng: np.random.Generator, site: Site, parts: list[Part]) -> list[Part]:
    """Lying on the object."""
    place, turn = site.points[rng.integers(len(site.points))], rng.uniform(0, 2 * np.pi)
    return _move(parts, turn, (*place[:2], _find_top(site, place, np.abs(_stack(parts)[:, :2]).max())))


def _find_top(site: Site, place: np.ndarray, reach: float) -> float:
    """Height (m) that clears the object near a place."""
    near = np.linalg.norm(site.points[:, :2] - place[:2], axis=1) <= reach
    return float(site.points[near, 2].max()) + site.thickness + 0.003


def _is_clear(parts: list[Part], camera: Camera) -> bool:
    """Whether nothing stands near the lens."""
    vertices, eye = _stack(parts), camera.pose[:3, 3]
    depth, aside = (vertices - eye) @ camera.pose[:3, 2], np.linalg.norm(vertices - eye, axis=1)
    return bool(aside.min() > 0.35 * eye[2] and depth[vertices[:, 2] < eye[2]].min(initial=1.0) > 0.1)


def _add(rng: np.random.Generator, parts: list[Part]) -> None:
    for solid, colour, printed in parts:
        picture = printed and rng.random() < 0.5
        add_solid(solid, paint_surface(rng, colour, fitted=True)[0] if picture else paint_plain(rng, colour))
