"""Cloths and ropes under grippers: a first state, then grasps by the camera's rays, physics, and another look.

A gripper comes down at a pixel. Inside the silhouette it pinches the layer that the ray hits first. Near the rim one
finger slides under the object, and it closes on all layers there. It lays them down where the other pixel's ray meets
the table. Appearance (camera, ground, light, materials) is drawn from a rollout's seed and its first state, so that all
its looks share it.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from scipy.ndimage import binary_dilation

from mmgsd.config import IMAGE_SIZE
from mmgsd.fold.state import State, read_state, write_state
from mmgsd.fold.tasks import Task, find_task
from mmgsd.scene import blender, randomize
from mmgsd.scene.blender import DeformedObject
from mmgsd.scene.episode import FLOOR
from mmgsd.scene.geometry import Camera, find_middle, measure_arc, spin
from mmgsd.scene.objects import cloth, rope
from mmgsd.scene.objects.meshes import SPACING
from mmgsd.scene.objects.rope_physics import LENGTH, pull_rope
from mmgsd.scene.objects.rope_shape import RopeShape, own_parts, sample_rope
from mmgsd.scene.workspace.distractors import add_distractors, add_occluder
from mmgsd.scene.workspace.materials import paint_object
from mmgsd.scene.workspace.surfaces import Site, add_surfaces
from mmgsd.scene.workspace.view import draw_light, frame_points, sample_ground_points

SAMPLES = 1  # of Cycles, a pixel, as the rendered sets have
MAX_OFFSET = 0.1  # m from the origin, along x and y, of a first state
MAX_TILT_DEG = 30.0
FLIP = (0.3, 0.45)  # m along x and y that the start "corner" flips its corner over; a demonstration the mean
FINGER = 0.1  # m: so far a gripper reaches under the object from its rim
GRIP = 0.02  # m around a pick, in which layers are taken; below the distance of two vertices
LEAST_FRAMES, FRAMES_A_METRE = 12, 30  # of a move: a faster one swings the cloth beyond its aim
SETTLE_FRAMES = 12
LIFT = 0.35  # height of a cloth's arc over its length: with a half circle's 0.5 the cloth is pulled along
FRICTION = 80.0  # of the table: what lies on it must not be dragged along by what is lifted
LAID_AT = 0.03  # m above the table, where grippers let go of a cloth
MAX_STRETCH = 1.35  # of a rope, and of the 99th percentile of a cloth's edges: four layers in grippers reach 1.2
ASIDE_FILL, ASIDE_NEARNESS = 0.9, 2.0  # of a look from aside, as `frame_points` has them
LEAST_SEEN = 0.8  # share of the material points in the picture
LEAN, CLEAR = 1.1, 0.02  # rad from upright that a gripper or a hand leans in a film; m between its tip and the object

Moves = Sequence[tuple[Sequence[float], Sequence[float]]]  # pick (x, y) and place (x, y), px


def run_job(job: dict[str, Any]) -> None:
    """Make ``states``, each a job of `mmgsd.fold.jobs` with ``out``, the file to write, one after the other."""
    for one in job["states"]:
        if "state" in one:
            go_on = {"act": act, "film": film, "look": look_again}[one["kind"]]
            state = go_on(read_state(one["state"]), one)
        else:
            state = begin(one)
        write_state(Path(one["out"]), state)


# First states. ------------------------------------------------------------------------------------------------------


def begin(job: dict[str, Any]) -> State:
    """The first look of a rollout, or of the demonstration: the latter unturned about the origin, seen from above."""
    task = find_task(job["task"])
    about = {key: job[key] for key in ("object", "task", "start", "ground", "seed", "mark")}
    about |= {"demonstration": job["kind"] == "demonstration", "look": 0, "fault": "", "thickness": 0.0}
    about |= {"turn_deg": job["turn_deg"]} if "turn_deg" in job else {}
    rng = _stream(about, "shape")
    if task.object == "cloth":
        vertices = _begin_cloth(rng, about)
    else:
        vertices, about["thickness"] = _begin_rope(rng, about)
    if not about["demonstration"]:
        turn = rng.uniform(0, 2 * np.pi)
        vertices = vertices if "turn_deg" in about else vertices @ spin(turn).T
        vertices[:, :2] += rng.uniform(-MAX_OFFSET, MAX_OFFSET, size=2)
    return _look(vertices.astype(np.float32), None, about)


def _stream(about: dict[str, Any], purpose: str) -> np.random.Generator:
    """Random numbers for one purpose; how the object lies does not depend on the ground, a pair's other half."""
    words = [about["task"], about["start"], purpose]
    if purpose in ("camera", "look"):
        words += [about["ground"]]
    if purpose == "camera" and about.get("again"):
        words += [str(about["again"])]
    return np.random.default_rng([about["seed"], int(about["demonstration"]), zlib.crc32(" ".join(words).encode())])


def _begin_cloth(rng: np.random.Generator, about: dict[str, Any]) -> np.ndarray:
    if about["start"] != "corner":
        return cloth.deform(rng, about["start"])[0]
    vertices, _ = cloth.deform(rng, "flat")
    shift = np.full(2, np.mean(FLIP)) if about["demonstration"] else rng.uniform(*FLIP, size=2)
    corner = int(cloth.SIDE + 1)  # one vertex inside the rim, at the first row's beginning
    return move_cloth(vertices, [([corner], shift * (1, -1))])[-1]


def _begin_rope(rng: np.random.Generator, about: dict[str, Any]) -> tuple[np.ndarray, float]:
    """The centre line (625, 3) m about the origin, its ends apart along x, and the rope's diameter (m)."""
    shape = sample_rope(rng, state=about["start"])
    along = shape.centre[-1, :2] - shape.centre[0, :2]
    along /= np.linalg.norm(along)
    centre = shape.centre.copy()
    centre[:, :2] = centre[:, :2] @ np.array([[along[0], -along[1]], [along[1], along[0]]])
    centre[:, :2] -= find_middle(centre[:, :2])
    return centre, shape.thickness


# Acts. --------------------------------------------------------------------------------------------------------------


def act(state: State, job: dict[str, Any]) -> State:
    """The next look, after all of the job's ``moves`` (px) were made at once.

    A ray that misses the object grasps nothing. What physics spoils is said in the new state's ``fault``; a state that
    has one already stays as it is.
    """
    about = state.about | {"look": state.about["look"] + 1, "mark": job["mark"]}
    if about["fault"]:
        return dataclasses.replace(state, about=about)
    _, after, _ = _carry(state, job["moves"])
    fault = find_fault(after, about["object"])
    if not np.isfinite(after).all():
        after = state.vertices
    elif not fault and state.camera.contains(state.camera.project(after)).mean() < LEAST_SEEN:
        fault = f"less than {LEAST_SEEN:.0%} of it in the picture"
    return _look(after.astype(np.float32), state.first, about | {"fault": fault})


def _carry(state: State, moves: Moves) -> tuple[Sequence[np.ndarray], np.ndarray, list[int]]:
    """Vertices (V, 3) m while all ``moves`` (px) are made at once, those afterwards, and which of them are grasped."""
    before, thickness = state.vertices.astype(float), state.about["thickness"]
    if state.about["object"] == "cloth":
        grasps = _grasp_cloth(before, state.camera, moves)
        passed = move_cloth(before, grasps)
        return passed, passed[-1], [group[0] for group, _ in grasps]
    grasps = _grasp_rope(before, thickness, state.camera, moves)
    return *pull_rope(before, thickness, grasps), [index for index, _ in grasps]


def find_fault(vertices: np.ndarray, object: str) -> str:
    """What physics did to a cloth's or a rope's vertices (V, 3) m that none would bear; empty where nothing."""
    if not np.isfinite(vertices).all():
        return "nowhere"
    if object == "cloth":
        stretch = cloth.measure_stretch(cloth.square_cloth(), vertices)
    else:
        stretch = measure_arc(vertices)[-1] / LENGTH
    return f"stretched to more than {MAX_STRETCH:g} of its length" if stretch > MAX_STRETCH else ""


def move_cloth(vertices: np.ndarray, grasps: Sequence[tuple[Sequence[int], np.ndarray]]) -> np.ndarray:
    """Vertices (T, 1369, 3) m while groups, as (indices, shift (2,) m), are carried at once, let go and settle."""
    if not grasps:
        return vertices[None]
    planar = cloth.square_cloth()
    furthest = max(np.linalg.norm(shift) for _, shift in grasps)
    frames, grasped = LEAST_FRAMES + int(FRAMES_A_METRE * furthest), {}
    for group, shift in grasps:
        lift, low = max(0.05, LIFT * np.linalg.norm(shift)), vertices[group, 2].min()
        path = cloth.arc_path(np.append(shift, LAID_AT - low), lift, frames)
        grasped |= {vertex: path for vertex in group if vertex not in grasped}
    carried = cloth.simulate(planar, vertices, grasped, frames, friction=FRICTION)
    if not np.isfinite(carried[-1]).all():
        return carried
    settled = cloth.simulate(planar, carried[-1], {}, SETTLE_FRAMES, friction=FRICTION)
    return np.concatenate([carried, settled])


def _grasp_cloth(vertices: np.ndarray, camera: Camera, moves: Moves) -> list[tuple[list[int], np.ndarray]]:
    """Vertices that each gripper takes, and by what shift (2,) m it carries them; none where its ray misses."""
    lying = vertices + (0, 0, 0.001 - vertices[:, 2].min())  # as it is rendered
    faces, grasps = cloth.square_cloth().faces, []
    tree = BVHTree.FromPolygons(lying.tolist(), faces.tolist())
    for pick, place in moves:
        hit, _, face, _ = tree.ray_cast(Vector(camera.pose[:3, 3]), Vector(cast_ray(camera, pick)))
        target = meet_table(camera, place)
        if hit is None or target is None:
            continue
        corners = faces[face]
        vertex = int(corners[np.argmin(np.linalg.norm(lying[corners] - np.array(hit), axis=1))])
        grasps.append((take_layers(lying, vertex), target - np.array(hit)[:2]))
    return grasps


def take_layers(vertices: np.ndarray, vertex: int) -> list[int]:
    """Vertices that a gripper at ``vertex`` of a cloth (V, 3) m closes on: all layers near the rim, else that one."""
    place = vertices[vertex, :2]
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = place + FINGER * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (16, 2)
    gaps = np.linalg.norm(vertices[None, :, :2] - around[:, None], axis=-1).min(axis=1)
    if gaps.max() < 0.9 * SPACING:  # cloth all around
        return [vertex]
    return [vertex, *(int(i) for i in np.flatnonzero(np.linalg.norm(vertices[:, :2] - place, axis=1) < GRIP)
                      if i != vertex)]  # fmt: skip


def _grasp_rope(centre: np.ndarray, thickness: float, camera: Camera, moves: Moves) -> list[tuple[int, np.ndarray]]:
    """Points of the centre line that grippers take, and by what shift (2,) m; none where a ray misses the rope."""
    grasps = []
    for pick, place in moves:
        offset, ray, target = centre - camera.pose[:3, 3], cast_ray(camera, pick), meet_table(camera, place)
        depth = offset @ ray
        aside = np.linalg.norm(offset - depth[:, None] * ray, axis=1)
        hit = np.flatnonzero(aside < thickness / 2)
        if not len(hit) or target is None:
            continue
        top = hit[depth[hit] < depth[hit].min() + thickness / 2]
        index = int(top[np.argmin(aside[top])])
        if index not in [taken for taken, _ in grasps]:
            grasps.append((index, target - centre[index, :2]))
    return grasps


def cast_ray(camera: Camera, xy: Sequence[float]) -> np.ndarray:
    """Unit vector (3,), world, from the camera through a pixel (x, y)."""
    ray = camera.pose[:3, :3] @ np.linalg.solve(camera.intrinsics, [*xy, 1.0])
    return ray / np.linalg.norm(ray)


def meet_table(camera: Camera, xy: Sequence[float]) -> np.ndarray | None:
    """Where (2,) m a pixel's ray meets the table; None for a ray that does not."""
    eye, ray = camera.pose[:3, 3], cast_ray(camera, xy)
    return None if ray[2] > -1e-3 else eye[:2] - ray[:2] * (eye[2] / ray[2])


# Films. -------------------------------------------------------------------------------------------------------------


def film(state: State, job: dict[str, Any]) -> State:
    """Looks of a motion from a state on, as one state whose arrays have an axis of frames; ``fault`` as in `act`."""
    about = state.about | {"mark": job["mark"], "size": job["size"]}
    if job["motion"] in ("turn", "hand"):
        paths, grasped = _turn_half(state.vertices.astype(float), job["frames"]), []
    else:
        passed, _, grasped = _carry(state, job["moves"])
        paths = np.stack([state.vertices, *passed])
        paths = paths[np.linspace(0, len(paths) - 1, job["frames"]).round().astype(int)]
    if not np.isfinite(paths).all():
        paths, about["fault"] = np.repeat(state.vertices[None], len(paths), 0), "nowhere"
    looks = []
    for share, vertices in zip(np.linspace(0, 1, len(paths)), paths, strict=True):
        tips = _find_tips(job["motion"], share, state.first, vertices[grasped])
        looks.append(_look(vertices.astype(np.float32), state.first, about, tips=tips))
    fixed = {"first", "intrinsics", "camera_pose", "about"}
    arrays = {field.name: np.stack([getattr(look, field.name) for look in looks])
              for field in dataclasses.fields(State) if field.name not in fixed}  # fmt: skip
    return dataclasses.replace(looks[0], **arrays)


def _turn_half(vertices: np.ndarray, frames: int) -> np.ndarray:
    """Vertices (frames, V, 3) m that turn by half a turn about their middle."""
    middle = np.append(find_middle(vertices[:, :2]), 0.0)
    return np.stack([(vertices - middle) @ spin(angle).T + middle for angle in np.pi * np.linspace(0, 1, frames)])


def _find_tips(motion: str, share: float, first: np.ndarray, places: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Where (3,) m the tips of grippers or of a hand are when a ``share`` of a film is over, each after its kind."""
    if motion == "gripper":
        return [("gripper", place) for place in places]
    if motion != "hand":
        return []
    low, high = first[:, :2].min(0), first[:, :2].max(0)
    return [("hand", np.array([*(low + (high - low) * (0.5, 1.4 - 1.8 * share)), 0.1]))]


# Looks. -------------------------------------------------------------------------------------------------------------


def look_again(state: State, job: dict[str, Any]) -> State:
    """The same state, seen by the camera of another number than the rollout's own, which is 0; at rest meanwhile."""
    about = state.about | {key: job[key] for key in ("again", "mark", "tilt_deg") if key in job}
    if about["fault"]:
        return dataclasses.replace(state, about=about)
    return _look(state.vertices, state.first, about)


def _look(
    vertices: np.ndarray, first: np.ndarray | None, about: dict[str, Any], *,
    tips: Sequence[tuple[str, np.ndarray]] = (),
) -> State:  # fmt: skip
    """Render and label the object; ``first`` are the first look's points, ``tips`` kinds and places of occluders."""
    scene = blender.reset_scene()
    deformed = _add_object(vertices.astype(float), about)
    points = deformed.points.astype(np.float32)
    first = points if first is None else first
    room = find_room(first.astype(float), find_task(about["task"]))
    camera, turn = _draw_camera(room, about)
    blender.setup_cycles(scene, camera.size, SAMPLES)
    blender.place_camera(scene, camera)
    visible = blender.find_visible(deformed, blender.build_bvh(deformed.mesh), camera)
    for k, (kind, place) in enumerate(tips):
        angle = np.pi / 2 + k * (np.pi / 3)  # so that they come from the picture's border, side by side
        add_occluder(_stream(about, kind), kind, place + (0, 0, CLEAR), lean=LEAN, turn=angle)
    image, mask = _render(scene, deformed, room, camera, turn, about)
    xy = camera.project(deformed.points).astype(np.float32)
    visible &= _is_near(mask, xy)  # a thing may stand before it
    return State(vertices, points, image, mask, xy, visible, camera.intrinsics, camera.pose, first, about)


def _add_object(vertices: np.ndarray, about: dict[str, Any]) -> DeformedObject:
    if about["object"] == "cloth":
        return cloth.add_cloth(vertices, {})
    thickness = about["thickness"]
    shape = RopeShape(vertices, thickness, about["start"], np.empty((0, 2), dtype=int), 0.0)
    mesh = rope.add_parts(rope.build_parts(shape, rope.draw_lay(_stream(about, "lay"))))
    return DeformedObject(mesh, vertices, {}, own_parts(vertices, rope.OWN_ARC * thickness), thickness)


def find_room(points: np.ndarray, task: Task) -> np.ndarray:
    """Places (K, 3) m that a task may need, around its object's first points (625, 3) m: seen, and nothing on them."""
    middle = np.append(find_middle(points[:, :2]), 0.0)
    if task.name == "straighten":  # the rope may come to lie in any direction
        angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        rings = [np.stack([r * np.cos(angle), r * np.sin(angle), 0 * angle], axis=1) for r in (0.85, 0.6, 0.3)]
        return np.concatenate([points, *(middle + ring for ring in rings)])
    mirrored = points * (-1, -1, 1) + 2 * middle
    if task.object == "cloth":
        return np.concatenate([points, mirrored])
    beside = [points + np.array([x, y, 0]) for x, y in ((0.2, 0), (-0.2, 0), (0, 0.2), (0, -0.2))]
    return np.concatenate([points, mirrored, *beside])


def _draw_camera(room: np.ndarray, about: dict[str, Any]) -> tuple[Camera, float]:
    """A camera that sees the whole room, and its turn (rad) about z."""
    rng, size = _stream(about, "camera"), tuple(about.get("size", IMAGE_SIZE[about["object"]]))
    if about["demonstration"]:
        return frame_points(rng, room, size, 0.0, 0.0, 0.85, 3.0, shift=0.0), 0.0
    if "tilt_deg" in about:
        turn = rng.uniform(-np.pi, np.pi)
        return frame_points(rng, room, size, turn, about["tilt_deg"], ASIDE_FILL, ASIDE_NEARNESS, shift=0.0), turn
    if about["ground"] == "plain":
        camera, turn = randomize.draw_camera(rng, room, size, about.get("turn_deg", 180.0))
        return camera, float(np.radians(turn))
    turn, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(0, MAX_TILT_DEG)
    return frame_points(rng, room, size, turn, tilt, rng.uniform(0.7, 0.95), rng.uniform(1.2, 3.0)), turn


def _render(
    scene: bpy.types.Scene, deformed: DeformedObject, room: np.ndarray, camera: Camera, turn: float,
    about: dict[str, Any],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Ground, light and materials of the rollout: image (H, W, 3) uint8, mask (H, W) bool."""
    rng, masked = _stream(about, "look"), None
    if about["ground"] == "plain":
        randomize.draw_light(rng, scene)
        colour, _ = randomize.draw_background(rng, blender.add_floor("floor", FLOOR))
        randomize.draw_object_material(rng, deformed.mesh, colour)
    else:
        masked = _furnish(rng, scene, deformed, room, camera, turn, about)
    image, mask = blender.render_image(scene, seed=int(rng.integers(2**31)))
    if masked is not None:
        image[~mask] = masked
    return image, mask


def _furnish(
    rng: np.random.Generator, scene: bpy.types.Scene, deformed: DeformedObject, room: np.ndarray, camera: Camera,
    turn: float, about: dict[str, Any],
) -> tuple[int, int, int] | None:  # fmt: skip
    """A workspace around the room, nothing on it; where somebody has masked the picture, the mask's colour."""
    colour, _ = paint_object(rng, deformed.mesh)
    side = cloth.EXTENT if about["object"] == "cloth" else float(np.ptp(room[:, :2], axis=0).max())
    site = Site(room, side, turn, sample_ground_points(rng, camera), colour, about["thickness"] / 2)
    _, walls, masked = add_surfaces(rng, site)
    free = np.ones(len(room), dtype=bool)
    add_distractors(rng, site, camera, free, beside=masked is None, walls=walls, over=False)
    draw_light(rng, scene, side, np.append(site.middle, 0.0))
    return masked


def _is_near(mask: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Which pixels (N, 2) lie in the mask (H, W) or beside it: (N,) bool."""
    height, width = mask.shape
    x, y = np.clip(np.rint(xy), 0, (width - 1, height - 1)).astype(int).T
    return binary_dilation(mask, iterations=2)[y, x]
