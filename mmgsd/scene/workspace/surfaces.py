"""What a workspace's object lies on: floors, tables, boards, mats, paper, trays, seams, or one colour alone."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from mmgsd.scene.blender import add_floor, add_mesh
from mmgsd.scene.geometry import choose, find_middle, spin
from mmgsd.scene.textures.colours import RGB, draw_other_rgb, draw_rgb, draw_table_rgb, vary_rgb
from mmgsd.scene.workspace.materials import PREFIX, paint_plain, paint_surface
from mmgsd.scene.workspace.primitives import Solid, make_box, make_walls, merge, move

KINDS = {"floor": 0.2, "table": 0.3, "board": 0.3, "tray": 0.06, "masked": 0.14}
MASKS = ((0, 0, 0), (255, 255, 255))  # what is not the object, in pictures that somebody has masked
STEP = 4e-4  # m between the tops of flat things that lie on each other


@dataclass(frozen=True)
class Site:
    """Where the object lies, for those who put things around it; lengths in metres."""

    points: np.ndarray  # (P, 3) material points
    side: float  # of the cloth at rest, or what the rope spans
    turn: float  # rad, of the picture's axes about z
    ground_points: np.ndarray  # (K, 2) places on the ground that the picture shows
    colour: RGB  # mean of the object
    thickness: float  # of a rope above its points: what looks like it must not lie about; 0 of a sheet

    @property
    def middle(self) -> np.ndarray:
        """(2,) centre of the object's bounding box."""
        return find_middle(self.points[:, :2])

    def span(self, turn: float) -> tuple[np.ndarray, np.ndarray]:
        """Centre (2,) and size (2,) of the object's bounding box along axes turned by ``turn``."""
        axes = spin(-turn)[:2, :2]
        along = self.points[:, :2] @ axes.T
        low, high = along.min(0), along.max(0)
        return (low + high) / 2 @ axes, high - low

    def draw_turn(self, rng: np.random.Generator) -> float:
        """An angle (rad): the object's own, the picture's, or any."""
        turn = rng.choice([0.0, self.turn, rng.uniform(0, 2 * np.pi)], p=[0.25, 0.4, 0.35])
        return float(turn + rng.normal() * 0.03)


def add_solid(solid: Solid, material: bpy.types.Material, name: str = "thing") -> bpy.types.Object:
    """Link a solid into the scene."""
    added = add_mesh(PREFIX + name, solid.vertices, solid.faces)
    added.data.materials.append(material)
    if solid.smooth:
        added.data.shade_smooth()
    return added


def add_plate(centre: np.ndarray, size: np.ndarray, turn: float, top: float, thickness: float,
              material: bpy.types.Material) -> None:  # fmt: skip
    """A board or a sheet; its picture lies along its own edges, whatever its turn."""
    plate = add_solid(make_box((*size, thickness), (0, 0, -thickness / 2)), material, "plate")
    plate.location, plate.rotation_euler = (*centre, top), (0, 0, turn)


def add_surfaces(rng: np.random.Generator, site: Site) -> tuple[str, list[Solid], RGB | None]:
    """Add what lies under the object; its kind, solids that may hide the object, and the mask's colour if masked."""
    kind = choose(rng, KINDS)
    if kind == "masked":
        colour = _draw_mask(rng, site.colour)
        _add_floor(paint_plain(rng, colour), -STEP)
        return kind, [], colour
    thick = float(rng.choice([0.0, 0.003, 0.02], p=[0.35, 0.35, 0.3]))
    walls = []
    main, name = paint_surface(rng, draw_similar_rgb(rng, site.colour, 0.18), fitted=kind in ("board", "tray"))
    if kind == "floor":
        _add_floor(main, -thick - 12 * STEP)
    else:
        deep = 0.75 if kind == "table" else thick + 12 * STEP
        _add_floor(paint_surface(rng, draw_table_rgb(rng), fitted=False)[0], -deep)
        outline = _add_top(rng, site, kind, thick, main)
        if kind == "tray":
            walls = [make_walls(outline, -0.002, rng.uniform(0.01, 0.07))]
            add_solid(walls[0], paint_plain(rng, draw_rgb(rng)), "walls")
    for level in range(int(rng.choice([0, 1, 2, 3], p=[0.35, 0.3, 0.2, 0.15]))):
        _add_mat(rng, site, -(1 + level) * STEP)
    if rng.random() < 0.15:
        _add_seams(rng, site)
    return f"{kind}, {name}", walls, None


def draw_similar_rgb(rng: np.random.Generator, colour: RGB, share: float) -> RGB:
    """A colour like the object's in a ``share`` of the draws, else one unlike it."""
    if rng.random() < share:
        return vary_rgb(rng, colour, 0.06)
    return draw_other_rgb(rng, colour, distance=70, draw=draw_table_rgb)


def _draw_mask(rng: np.random.Generator, colour: RGB) -> RGB:
    """Black, white or any colour that the object has not."""
    for _ in range(8):
        picked = MASKS[int(rng.random() < 0.3)] if rng.random() < 0.8 else draw_rgb(rng)
        if np.linalg.norm(np.subtract(picked, colour)) > 70:
            return picked
    return MASKS[int(sum(colour) < 384)]


def _add_floor(material: bpy.types.Material, height: float) -> None:
    add_floor(f"{PREFIX}floor", 15.0, height).data.materials.append(material)


def _add_top(rng: np.random.Generator, site: Site, kind: str, thick: float, material: bpy.types.Material) -> np.ndarray:
    """A table's top, a board or a tray's bottom under the object: its outline (4, 2)."""
    turn = site.draw_turn(rng)
    centre, size = site.span(turn)
    if kind == "table":
        size = size + site.side * rng.uniform(0.05, 1.5, size=2)
    elif kind == "tray" or thick > 0.01:  # the object must not hover beyond a high edge
        size = size * rng.uniform(1.03, 1.7) + site.side * rng.uniform(0.02, 0.1, size=2)
    else:
        size = np.full(2, site.side * rng.choice([rng.uniform(0.8, 1.15), rng.uniform(0.5, 2.0)]))
    if kind != "table" and rng.random() < 0.55:
        size[:] = size.max()
    slack = 0.4 * np.maximum(size - site.span(turn)[1], 0.1 * site.side if thick < 0.01 and kind == "board" else 0.0)
    axes = spin(turn)[:2, :2]
    centre = centre + axes @ (slack * rng.uniform(-1, 1, size=2))
    add_plate(centre, size, turn, -4 * STEP, 0.035 if kind == "table" else max(thick, 2 * STEP), material)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    return centre + corners @ axes.T


def _add_mat(rng: np.random.Generator, site: Site, top: float) -> None:
    """A mat, a paper or a board: as large as the object and square, or not; under it, half under it or beside it."""
    size = np.full(2, site.side * (rng.uniform(0.75, 1.25) if rng.random() < 0.5 else rng.uniform(0.15, 1.0)))
    if rng.random() < 0.5:
        size[1] *= rng.choice([0.707, rng.uniform(0.3, 1.0)])
    place = site.ground_points[rng.integers(len(site.ground_points))]
    if rng.random() < 0.35:
        place = site.middle + rng.uniform(-0.6, 0.6, size=2) * site.side
    like = draw_similar_rgb(rng, site.colour, 0.3)
    material = paint_surface(rng, like, fitted=True)[0] if rng.random() < 0.7 else paint_plain(rng, like)
    add_plate(place, size, site.draw_turn(rng), top, 3 * STEP, material)


def _add_seams(rng: np.random.Generator, site: Site) -> None:
    """Gaps between boards or tape on the floor: long bars across the picture."""
    material, turn = paint_plain(rng, draw_rgb(rng)), site.draw_turn(rng)
    width = float(rng.choice([0.004, 0.012, 0.05]))
    places = site.ground_points[rng.integers(len(site.ground_points), size=rng.integers(1, 4))]
    bars = [move(make_box((12, width, STEP / 2)), turn + rng.integers(2) * np.pi / 2, (*place, -STEP / 2))
            for place in places]  # fmt: skip
    add_solid(merge(bars), material, "seams")
