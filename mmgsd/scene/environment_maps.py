"""Blender's own environment maps (CC0): light from all around as rooms, streets and forests have it, and pictures."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy
import numpy as np
from PIL import Image

from mmgsd.scene import SceneError
from mmgsd.scene.blender import encode_srgb
from mmgsd.scene.lighting import set_world

NODE = "environment"  # of the world's shader, while a map lights it


def list_maps() -> list[Path]:
    """The environment maps that Blender's module brings, by name; SceneError where it brings none."""
    folder = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"
    found = sorted(folder.glob("*.exr"))
    if not found:
        raise SceneError(f"Blender {bpy.app.version_string} brings no environment maps in {folder}")
    return found


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


def light_world(rng: np.random.Generator, scene: bpy.types.Scene, strength: float, tint: np.ndarray) -> str:
    """Light the scene by a map turned at random, tinted (3,), as bright as ``strength`` on a white sheet; its name."""
    paths = list_maps()
    path = paths[rng.integers(len(paths))]
    set_world(scene, (1.0, 1.0, 1.0, 1.0), 1.0)
    remove_map(scene)
    tree, radiance = scene.world.node_tree, load_map(path)
    height, width = radiance.shape[:2]
    image = bpy.data.images.new(f"{path.stem} of a view", width, height, float_buffer=True)  # never one's address again
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = strength * radiance[::-1] * np.clip(tint, 0.2, 2)
    image.pixels.foreach_set(np.roll(rgba, rng.integers(width), axis=1).ravel())
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.name, node.image = NODE, image
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    return f"map {path.stem}"


def remove_map(scene: bpy.types.Scene) -> None:
    """Leave the world's one colour alone."""
    nodes = scene.world.node_tree.nodes if scene.world else {}
    if NODE in nodes:
        nodes.remove(nodes[NODE])


def draw_part(rng: np.random.Generator, side: int) -> np.ndarray:
    """A square part (side, side, 3) uint8 of a map as a camera would expose it: a picture of a place."""
    paths = list_maps()
    radiance = load_map(paths[rng.integers(len(paths))])
    radiance = np.roll(radiance, rng.integers(radiance.shape[1]), axis=1)
    size = int(radiance.shape[0] * rng.uniform(0.4, 1.0))
    top = int(rng.integers(radiance.shape[0] - size + 1))
    part = radiance[top : top + size, :size]
    exposed = encode_srgb(part * (0.4 / max(1e-4, float(np.median(part)))))
    return np.asarray(Image.fromarray(exposed).resize((side, side), Image.Resampling.BICUBIC))
