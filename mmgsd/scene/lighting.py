"""A scene's light: one colour from all around, and one lamp."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Vector

from mmgsd.scene.textures.colours import Colour


def set_world(scene: bpy.types.Scene, colour: Colour, strength: float) -> None:
    """Light of one colour from all around, as bright as ``strength`` on a white sheet."""
    if scene.world is None:
        scene.world = bpy.data.worlds.new("world")
        scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = colour, strength


def remove_lamp() -> None:
    """Put out the scene's lamp, if there is one."""
    if "lamp" in bpy.data.objects:
        bpy.data.lights.remove(bpy.data.objects["lamp"].data)  # takes the object with it


def add_lamp(scene: bpy.types.Scene, kind: str, size: float) -> bpy.types.Object:
    """Replace the scene's only lamp by a ``SUN`` of an angle (rad) or an ``AREA`` of a side (m)."""
    remove_lamp()
    data = bpy.data.lights.new("lamp", kind)
    data.cycles.use_multiple_importance_sampling = False  # sampled directly alone: less noise on matt surfaces
    setattr(data, "angle" if kind == "SUN" else "size", size)
    lamp = bpy.data.objects.new("lamp", data)
    scene.collection.objects.link(lamp)
    return lamp


def aim_lamp(
    lamp: bpy.types.Object, target: np.ndarray, direction: np.ndarray, distance: float,
    *, colour: np.ndarray, exposure: float,
) -> None:  # fmt: skip
    """Let a lamp shine on ``target`` (3,) m from a ``distance`` (m) in a ``direction`` (3,).

    A level white sheet at the target is then as bright as ``exposure``.
    """
    energy = exposure / direction[2] * np.pi
    lamp.data.color, lamp.data.energy = colour, energy * (np.pi * distance**2 if lamp.data.type == "AREA" else 1.0)
    lamp.location = target + distance * direction
    lamp.rotation_euler = Vector(direction).to_track_quat("Z", "Y").to_euler()
