"""Domain randomisation: camera, light, background and materials of one view, drawn from an explicit ``rng``."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Euler

from mmgsd.scene import SceneError
from mmgsd.scene.geometry import Camera, compute_direction, log_uniform
from mmgsd.scene.lighting import add_lamp, aim_lamp, set_world
from mmgsd.scene.textures.colours import Colour, draw_colour, draw_contrasting
from mmgsd.scene.textures.procedural import BACKGROUNDS, CLOTH_TEXTURES, OBJECT_TEXTURES, Shader, draw_gloss

MIN_SPAN = 0.8  # m seen across the image at least: a small heap stays small
MAX_OUTSIDE = 0.05  # share of the material points that may fall out of the image
POSES = 1000  # drawn for one view at most


def draw_camera(
    rng: np.random.Generator, points: np.ndarray, size: tuple[int, int], rotation_deg: float
) -> tuple[Camera, float]:
    """A camera above points (N, 3) m, and the degrees in ± rotation_deg by which it turns the image; or SceneError."""
    turn = rng.uniform(-rotation_deg, rotation_deg)
    for _ in range(POSES):
        camera = _draw_pose(rng, points, size, np.radians(turn))
        outside = 1 - camera.contains(camera.project(points)).mean()
        if outside <= MAX_OUTSIDE:
            return camera, float(turn)
    raise SceneError(f"none of {POSES} cameras saw {1 - MAX_OUTSIDE:.0%} of the points, which reach from "
                     f"{points.min(axis=0).round(2).tolist()} to {points.max(axis=0).round(2).tolist()} m")  # fmt: skip


def _draw_pose(rng: np.random.Generator, points: np.ndarray, size: tuple[int, int], turn: float) -> Camera:
    """A few degrees of tilt; distance, zoom and shift such that the object's bounding box is about in the image."""
    tilt = rng.normal(scale=np.radians(4.0), size=2).clip(-0.2, 0.2)
    down = np.array(Euler((np.pi + tilt[0], tilt[1], 0.0)).to_matrix())
    rotation = np.array(Euler((0.0, 0.0, turn)).to_matrix()) @ down
    distance = rng.uniform(1.6, 3.0)
    plane = points @ rotation[:, :2]  # (N, 2) m along the image's axes
    low, high = plane.min(axis=0), plane.max(axis=0)
    width = np.array(size) * max(np.max((high - low) / size), MIN_SPAN / max(size)) * rng.uniform(1.06, 1.5)
    slack = (width - (high - low)) / 2
    aim = (low + high) / 2 + rng.uniform(-0.85, 0.85, size=2) * slack
    height = points[:, 2].mean()
    centre = rotation[:, :2] @ aim
    centre = centre + rotation[:, 2] * (height - centre[2]) / rotation[2, 2]
    focal = size[0] * distance / width[0]
    return Camera.build(rotation, centre - distance * rotation[:, 2], focal, size)


def draw_light(rng: np.random.Generator, scene: bpy.types.Scene) -> None:
    """Ambient light and one lamp, a sun or an area, exposed about right for a white sheet on the floor."""
    exposure, ambient = np.exp(rng.normal(scale=0.22)), rng.uniform(0.25, 0.75)
    tint = rng.normal(scale=0.06)  # warm to cold
    colour = np.clip([1 + tint, 1.0, 1 - tint], 0, 2)
    set_world(scene, (*np.clip([1 - tint, 1, 1 + tint], 0, 2), 1.0), exposure * ambient)
    direction = compute_direction(rng.uniform(np.radians(30), np.radians(85)), rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.5:
        lamp = add_lamp("SUN", np.radians(log_uniform(rng, 0.5, 40.0)))
    else:
        lamp = add_lamp("AREA", rng.uniform(0.2, 2.0))
    distance = float(rng.uniform(1.8, 4.0))  # m from the origin
    aim_lamp(lamp, np.zeros(3), direction, distance, colour=colour, exposure=exposure * (1 - ambient))


def draw_object_material(rng: np.random.Generator, mesh: bpy.types.Object, background: Colour) -> str:
    """Fill every material slot of the object anew; the name of the main slot's texture."""
    main = draw_contrasting(rng, background)
    names = []
    for i, slot in enumerate(mesh.material_slots):
        colour = main if i == 0 else draw_contrasting(rng, main, distance=0.35, exempt=0.0)
        slot.material = slot.material or bpy.data.materials.new(f"object {i}")
        shader = Shader(slot.material)
        textures = CLOTH_TEXTURES if "rest" in mesh.data.attributes else OBJECT_TEXTURES
        names.append(str(rng.choice(list(textures))))
        surface, back = textures[names[-1]](rng, shader, colour), draw_colour(rng)
        if rng.random() >= 0.7:  # the under-side has another colour
            surface = shader.mix(shader.node("NewGeometry").outputs["Backfacing"], surface, back)
        shader.finish(surface, rng.uniform(0.4, 1.0), draw_gloss(rng, 0.25, 0.06), True)
    return names[0]


def draw_background(rng: np.random.Generator, floor: bpy.types.Object) -> tuple[Colour, str]:
    """Give the floor a new material: its main colour, and the name of its texture."""
    colour = draw_colour(rng)
    name = str(rng.choice(list(BACKGROUNDS)))
    if not floor.material_slots:
        floor.data.materials.append(bpy.data.materials.new("floor"))
    shader = Shader(floor.material_slots[0].material)
    place = shader.node("TexCoord").outputs["Object"]
    mapping = {"Vector": place, "Location": rng.uniform(-9, 9, 3), "Rotation": (0, 0, rng.uniform(0, 2 * np.pi))}
    place = shader.node("Mapping", mapping).outputs[0]
    surface = BACKGROUNDS[name](rng, shader, colour, place)
    shader.finish(surface, rng.uniform(0.4, 1.0), draw_gloss(rng, 0.3, 0.06), False)
    return colour, name
