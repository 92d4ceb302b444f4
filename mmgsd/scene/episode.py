"""One episode: an object is deformed once and seen in several views, each with its own camera, light and materials."""

from __future__ import annotations

import zlib

import bpy
import numpy as np

from mmgsd.config import OBJECTS, SCENES, RenderConfig
from mmgsd.scene import blender, randomize
from mmgsd.scene.blender import DeformedObject, View
from mmgsd.scene.objects.planar_object import PlanarObject

SPLITS = ("train", "test")
FLOOR = 6.0  # m from its centre to each side


def render_episode(
    config: RenderConfig, split: str, episode: int, n_views: int, planar: PlanarObject | None = None
) -> list[View]:
    """Create, populate, render and label ``n_views`` views of one deformation of the cloth, the rope or a ``planar``.

    The same arguments give the same pixels in any process. ValueError for an unknown split.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    kind = OBJECTS.index(config.object) if planar is None else zlib.crc32(planar.name.encode())
    around = [SCENES.index(config.scene)] if config.scene != "plain" else []  # the plain scene's stream is as it was
    rng = np.random.default_rng([config.seed, kind, SPLITS.index(split), episode, *around])
    scene = blender.reset_scene()
    deformed = build_object(rng, config, planar)
    size = config.size if planar is None else planar.size
    blender.setup_cycles(scene, size, config.samples)
    bvh = blender.build_bvh(deformed.mesh)
    if config.scene == "workspace":
        from mmgsd.scene.workspace.view import render_view

        return [render_view(rng, config, size, scene, deformed, bvh) for _ in range(n_views)]
    floor = blender.add_floor("floor", FLOOR)
    return [_render_view(rng, config, size, scene, deformed, bvh, floor) for _ in range(n_views)]


def build_object(rng: np.random.Generator, config: RenderConfig, planar: PlanarObject | None = None) -> DeformedObject:
    """Add a randomly deformed object of the configured kind to the current scene."""
    if config.object == "rope":
        from mmgsd.scene.objects.rope import build_rope

        return build_rope(rng, config)
    from mmgsd.scene.objects.cloth import build_cloth

    return build_cloth(rng, config, planar)


def _render_view(
    rng: np.random.Generator, config: RenderConfig, size: tuple[int, int], scene: bpy.types.Scene,
    deformed: DeformedObject, bvh: blender.BVHTree, floor: bpy.types.Object,
) -> View:  # fmt: skip
    """Furnish, light, render and label one view of the plain scene."""
    camera, turn = randomize.draw_camera(rng, deformed.points, size, config.rotation_deg)
    blender.place_camera(scene, camera)
    randomize.draw_light(rng, scene)
    colour, background = randomize.draw_background(rng, floor)
    texture = randomize.draw_object_material(rng, deformed.mesh, colour)
    image, mask = blender.render_image(scene, seed=int(rng.integers(2**31)))
    xy, visible = camera.project(deformed.points).astype(np.float32), blender.find_visible(deformed, bvh, camera)
    info = {**deformed.info, "turn_deg": turn, "texture": texture, "background": background}
    return View(image, mask, xy, visible, camera.intrinsics, camera.pose, info)
