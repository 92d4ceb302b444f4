"""A scene's light: one colour or one of Blender's own environment maps (CC0) from all around, and one lamp."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector
from PIL import Image

from mmgsd.scene import SceneError
from mmgsd.scene.blender import add_object, encode_srgb
from mmgsd.scene.textures.colours import Colour

NODE = "environment"  # of the world's shader, while a map lights it


def set_world(scene: bpy.types.Scene, colour: Colour, strength: float) -> None:
    """Light of one colour from all around, as bright as ``strength`` on a white sheet; no map lights it any more."""
    if scene.world is None:
        scene.world = bpy.data.worlds.new("world")
        scene.world.use_nodes = True
    nodes = scene.world.node_tree.nodes
    if NODE in nodes:
        nodes.remove(nodes[NODE])
    background = nodes["Background"]
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = colour, strength


def remove_lamp() -> None:
    """Put out the scene's lamp, if there is one."""
    if "lamp" in bpy.data.objects:
        bpy.data.lights.remove(bpy.data.objects["lamp"].data)  # takes the object with it


def add_lamp(kind: str, size: float) -> bpy.types.Object:
    """Replace the scene's only lamp by a ``SUN`` of an angle (rad) or an ``AREA`` of a side (m)."""
    remove_lamp()
    data = bpy.data.lights.new("lamp", kind)
    data.cycles.use_multiple_importance_sampling = False  # sampled directly alone: less noise on matt surfaces
    setattr(data, "angle" if kind == "SUN" else "size", size)
    return add_object("lamp", data)


def aim_lamp(
    lamp: bpy.types.Object, target: np.ndarray, direction: np.ndarray, distance: float,
    *, colour: np.ndarray, exposure: float,
) -> None:  # fmt: skip
    """Let a lamp shine on ``target`` (3,) m from afar; a level white sheet there is as bright as ``exposure``."""
    energy = exposure / direction[2] * np.pi
    lamp.data.color, lamp.data.energy = colour, energy * (np.pi * distance**2 if lamp.data.type == "AREA" else 1.0)
    lamp.location = target + distance * direction
    lamp.rotation_euler = Vector(direction).to_track_quat("Z", "Y").to_euler()


def list_maps() -> list[Path]:
    """The environment maps that Blender's module brings, by name; SceneError where it brings none."""
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    maps = sorted(folder.glob("*.exr"))
    if not maps:
        raise SceneError(f"Blender {bpy.app.version_string} brings no environment maps in {folder}")
    return maps


@functools.cache
def load_map(path: Path) -> np.ndarray:
    """Radiance (H, W, 3) of a map over the whole sphere, row 0 at the zenith, scaled so that a white sheet has 1."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    radiance = pixels.reshape(height, width, 4)[::-1, :, :3]
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    weight = np.where(elevation > 0, np.sin(elevation) * np.cos(elevation), 0)  # of a level sheet, by solid angle
    return radiance / (radiance.mean(axis=(1, 2)) @ weight / weight.sum())


def draw_map(rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """Name and radiance of any of the maps."""
    paths = list_maps()
    path = paths[rng.integers(len(paths))]
    return path.stem, load_map(path)


def light_world(rng: np.random.Generator, scene: bpy.types.Scene, strength: float, tint: np.ndarray) -> str:
    """Light the scene by a map turned at random, tinted (3,), as bright as ``strength`` on a white sheet; its name."""
    name, radiance = draw_map(rng)
    set_world(scene, (1.0, 1.0, 1.0, 1.0), 1.0)
    height, width = radiance.shape[:2]
    image = bpy.data.images.new(f"{name} of a view", width, height, float_buffer=True)  # never one's address again
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = strength * radiance[::-1] * np.clip(tint, 0.2, 2)
    image.pixels.foreach_set(np.roll(rgba, rng.integers(width), axis=1).ravel())
    tree = scene.world.node_tree
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.name, node.image = NODE, image
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    return f"map {name}"


def draw_part(rng: np.random.Generator, side: int) -> np.ndarray:
    """A square part (side, side, 3) uint8 of a map as a camera would expose it: a picture of a place."""
    _, radiance = draw_map(rng)
    radiance = np.roll(radiance, rng.integers(radiance.shape[1]), axis=1)
    size = int(radiance.shape[0] * rng.uniform(0.4, 1.0))
    top = int(rng.integers(radiance.shape[0] - size + 1))
    part = radiance[top : top + size, :size]
    exposed = encode_srgb(part * (0.4 / max(1e-4, float(np.median(part)))))
    return np.asarray(Image.fromarray(exposed).resize((side, side), Image.Resampling.BICUBIC))
