"""Views of an object in a robotics lab's workspace: what `mmgsd.scene.episode` renders where the scene is "workspace".

Tables, boards, mats, trays and paper under the object and beside it, things around it and on it, an oblique near
camera, hard or coloured light, prints and stickers on the object; in a few views the object is not there. Sensor
effects (blur, noise, compression) are none of the scene's: training adds them.

The labels gain ``present``, ``things``, ``light`` and ``tilt_deg``; a point that a thing covers is not visible.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Euler

from mmgsd.config import RenderConfig
from mmgsd.scene import blender, lighting
from mmgsd.scene.blender import DeformedObject, View
from mmgsd.scene.geometry import Camera, choose, compute_direction, find_middle, log_uniform
from mmgsd.scene.objects.cloth import EXTENT
from mmgsd.scene.workspace.distractors import add_distractors
from mmgsd.scene.workspace.materials import paint_object, remove_view
from mmgsd.scene.workspace.surfaces import Site, add_surfaces

ABSENT = 0.035  # share of the views without the object, of those that nobody has masked
MAX_TILT_DEG = 50.0
MAX_OUTSIDE = 0.05  # share of the material points that may fall out of the picture
LEAST_PX = 2.0  # of a rope's diameter
TRIES = 60  # to frame the object, before the camera looks straight down


def render_view(
    rng: np.random.Generator, config: RenderConfig, size: tuple[int, int], scene: bpy.types.Scene,
    deformed: DeformedObject, bvh: blender.BVHTree,
) -> View:  # fmt: skip
    """Furnish, light, render and label one view; nothing of it stays in the scene."""
    remove_view()
    camera, turn, tilt = draw_camera(rng, deformed, size, config.rotation_deg)
    blender.place_camera(scene, camera)
    colour, texture = paint_object(rng, deformed.mesh)
    side = EXTENT if config.object == "cloth" else float(np.ptp(deformed.points[:, :2], axis=0).max())
    site = Site(deformed.points, side, turn, sample_ground_points(rng, camera), colour, deformed.thickness / 2)
    ground, walls, masked = add_surfaces(rng, site)
    present = rng.random() >= ABSENT or masked is not None
    visible = blender.find_visible(deformed, bvh, camera)
    visible, distractors = add_distractors(rng, site, camera, visible, beside=masked is None, walls=walls)
    light = draw_light(rng, scene, site.side, np.append(site.middle, 0.0))
    deformed.mesh.hide_render = not present
    image, mask = blender.render_image(scene, seed=int(rng.integers(2**31)))
    present = present and bool(mask.any())  # a near thing may hide all of it
    if masked is not None:
        image[~mask] = masked
    labels = {"turn_deg": np.degrees(turn), "tilt_deg": tilt, "texture": texture, "background": ground, "light": light}
    info = {**deformed.info, **labels, "things": ", ".join(distractors), "present": present}
    xy = camera.project(deformed.points).astype(np.float32)
    return View(image, mask, xy, visible & present, camera.intrinsics, camera.pose, info)


def sample_ground_points(rng: np.random.Generator, camera: Camera) -> np.ndarray:
    """Places (K, 2) m on z = 0 that the picture shows, evenly spread over the picture and a little beyond."""
    xy = (rng.uniform(-0.08, 1.08, size=(60, 2))) * camera.size
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.intrinsics).T @ camera.pose[:3, :3].T
    eye = camera.pose[:3, 3]
    down = rays[:, 2] < -0.1 * np.linalg.norm(rays, axis=1)
    return eye[:2] - rays[down, :2] * (eye[2] / rays[down, 2:])


def draw_camera(
    rng: np.random.Generator, deformed: DeformedObject, size: tuple[int, int], rotation_deg: float
) -> tuple[Camera, float, float]:
    """A camera from near that has the object in a fifth to all of the picture, its turn (rad) and tilt (degrees)."""
    points, turn = deformed.points, np.radians(rng.uniform(-rotation_deg, rotation_deg))
    thin = deformed.thickness or np.inf
    for _ in range(TRIES):
        tilt = abs(rng.normal(scale=5.0)) if rng.random() < 0.35 else rng.uniform(0, MAX_TILT_DEG)
        tilt = min(tilt, MAX_TILT_DEG)
        fill = rng.uniform(0.2, 1.05) if rng.random() < 0.4 else rng.uniform(0.45, 0.95)
        nearness = log_uniform(rng, 0.8, 3.5)
        camera = frame_points(rng, points, size, turn, tilt, fill, nearness)
        depth = (points - camera.pose[:3, 3]) @ camera.pose[:3, 2]
        wide = thin * camera.intrinsics[0, 0] / depth.max()
        outside = 1 - camera.contains(camera.project(points)).mean()
        if depth.min() > 0.25 and wide >= LEAST_PX and outside <= MAX_OUTSIDE:
            return camera, turn, float(tilt)
    return frame_points(rng, points, size, turn, 0.0, 0.8, 3.0), turn, 0.0


def frame_points(
    rng: np.random.Generator, points: np.ndarray, size: tuple[int, int], turn: float, tilt: float, fill: float,
    nearness: float, *, shift: float = 0.9,
) -> Camera:  # fmt: skip
    """Points (N, 3) m seen from ``nearness`` times their extent, tilted (degrees), filling a share of the picture.

    They are moved aside by at most ``shift`` of the room that they leave.
    """
    down = np.array(Euler((np.pi + np.radians(tilt), 0.0, 0.0)).to_matrix())
    rotation = np.array(Euler((0.0, 0.0, turn)).to_matrix()) @ down
    middle = find_middle(points)
    distance = max(0.5, nearness * np.ptp(points[:, :2], axis=0).max())
    local = (points - middle) @ rotation + (0, 0, distance)
    plane = local[:, :2] / local[:, 2:]
    low, high = plane.min(axis=0), plane.max(axis=0)
    focal = fill * np.min(np.array(size) / (high - low))  # px
    slack = np.maximum(np.array(size) / focal - (high - low), 0) / 2
    aside = ((low + high) / 2 - rng.uniform(-shift, shift, size=2) * slack) * distance
    return Camera.build(rotation, middle + rotation @ np.array([*aside, -distance]), focal, size)


MAPPED = 0.35  # share of the views under an environment map, half of them beside a lamp of `LIGHTS`
LIGHTS = {  # share of the views; how bright (of a white sheet), which share from all around, how wide (m, or degrees)
    "even": (0.3, (0.7, 1.2), (0.6, 1.0), (10.0, 60.0)),
    "sun": (0.25, (0.7, 1.5), (0.12, 0.4), (0.4, 3.0)),
    "lamp": (0.27, (0.6, 1.5), (0.1, 0.5), (0.03, 0.5)),
    "glare": (0.08, (1.6, 3.0), (0.2, 0.6), (0.4, 10.0)),
    "dim": (0.1, (0.2, 0.5), (0.3, 0.9), (0.1, 0.6)),
}


def draw_light(rng: np.random.Generator, scene: bpy.types.Scene, side: float, target: np.ndarray) -> str:
    """Light the object at ``target`` (3,) m with a sun or a lamp near by, or all around it; the light's name."""
    mapped = rng.random() < MAPPED
    if mapped and rng.random() < 0.5:
        lighting.remove_lamp()
        return lighting.light_world(rng, scene, log_uniform(rng, 0.5, 1.4), _draw_tint(rng))
    name = choose(rng, {name: share for name, (share, *_) in LIGHTS.items()})
    _, bright, around, wide = LIGHTS[name]
    exposure, ambient = log_uniform(rng, *bright), rng.uniform(*around)
    colour = _draw_tint(rng)
    sky = np.sqrt(colour) if rng.random() < 0.5 else colour
    if mapped:
        name = f"{name}, {lighting.light_world(rng, scene, exposure * ambient, sky)}"
    else:
        lighting.set_world(scene, (*np.clip(sky, 0, 2).tolist(), 1.0), exposure * ambient)
    direction = compute_direction(np.radians(rng.uniform(20, 85)), rng.uniform(0, 2 * np.pi))
    width, distance = rng.uniform(*wide), rng.uniform(0.8, 3.0) * max(side, 0.5)
    near = wide[1] < 1  # m, of a lamp; a sun's are degrees
    lamp = lighting.add_lamp(*(("AREA", width * max(side, 0.5)) if near else ("SUN", np.radians(width))))
    exposure *= 1 - ambient
    lighting.aim_lamp(lamp, target, direction, distance, colour=np.clip(colour, 0, 2), exposure=exposure)
    return name


def _draw_tint(rng: np.random.Generator) -> np.ndarray:
    """(3,) about 1: warm to cold, sometimes a colour."""
    tint = rng.normal(scale=0.1)
    colour = np.array([1 + tint, 1.0, 1 - tint])
    if rng.random() < 0.08:
        colour = colour * np.exp(rng.normal(scale=0.4, size=3))
    return np.clip(colour, 0.2, 2)
