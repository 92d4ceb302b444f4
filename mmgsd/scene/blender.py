"""Renders a deformed object with Cycles and labels its material points by projection and ray cast.

The scene's conventions, for the modules that build objects (``cloth.py``, ``rope.py``):

- lengths are metres, z points up, the floor is the plane z = 0 (made here) and the object lies on it, about 1 m wide
  and anywhere near the origin: the camera frames the object's points whatever their extent;
- the object's own turn about z is its canonical one: the camera's roll turns what is seen by ± ``rotation_deg``;
- ``randomize.py`` fills every material slot of the mesh anew for each view (slot 0 the main material, any further slot
  an accent such as a marker strand or the ball), so a builder only assigns slots to faces (``material_index``).
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector
from mathutils.bvhtree import BVHTree

from mmgsd.files import scratch_folder
from mmgsd.scene.geometry import Camera

MASK_PASS = "object"  # the shader output that is 1 on the object and 0 elsewhere
MEMORY = Path("/dev/shm")  # files in memory, where the system has it
VIEW_BYTES = 10  # of a pixel in a rendered file, at least: red, green, blue, opacity and mask, 16 bits each
GPU_BACKENDS = ("OPTIX", "CUDA", "HIP", "METAL")


@dataclass(frozen=True)
class DeformedObject:
    """What a builder hands to the renderer.

    A material point is visible if the first hit of the ray camera → point is its own: ``is_own_hit`` maps first hits
    (K, 3) and the indices (K,) of the points asked for to (K,) bool.
    """

    mesh: bpy.types.Object  # linked into the scene, lying on the plane z = 0
    points: np.ndarray  # (625, 3) float64 m, world; cloth: (r, c) row-major on the surface; rope: centre line
    info: dict[str, str | float | int]  # scalars, become label columns
    is_own_hit: Callable[[np.ndarray, np.ndarray], np.ndarray]
    thickness: float = 0.0  # m, of a rope


@dataclass(frozen=True)
class View:
    """One labelled image; the centre of the top-left pixel is (0, 0), x = column."""

    image: np.ndarray  # (H, W, 3) uint8
    mask: np.ndarray  # (H, W) bool, object pixels
    xy: np.ndarray  # (625, 2) float32 px
    visible: np.ndarray  # (625,) bool, False outside the image
    intrinsics: np.ndarray  # (3, 3) float64
    camera_pose: np.ndarray  # (4, 4) float64, as `Camera` has it
    info: dict[str, str | float | int]


# Create and populate. -----------------------------------------------------------------------------------------------


def reset_scene() -> bpy.types.Scene:
    """Forget everything of the last episode: nothing may leak from one into the next."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def add_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> bpy.types.Object:
    """Link a new mesh of vertices (V, 3) m and faces (F, 3 or 4) into the scene."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    return add_object(name, mesh)


def add_object(name: str, data: bpy.types.ID | None) -> bpy.types.Object:
    """Link a new object of some data, or an empty one, into the scene."""
    added = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(added)
    return added


def add_floor(name: str, half: float, height: float = 0.0) -> bpy.types.Object:
    """Link a level square, ``half`` m from its centre to each side, into the scene."""
    corners = np.array([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
    return add_mesh(name, corners, np.array([[0, 1, 2, 3]]))


def add_attribute(mesh: bpy.types.Mesh, name: str, vectors: np.ndarray) -> None:
    """Give a mesh's V vertices an attribute of that name, vectors (V, 3), which shaders can read."""
    attribute = mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", vectors.astype(np.float32).ravel())


def setup_cycles(scene: bpy.types.Scene, size: tuple[int, int], samples: int) -> None:
    """Few samples of direct light, denoised, saved as linear colours beside the object's mask."""
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.use_persistent_data = True  # the views of an episode share the object and its BVH
    scene.render.use_compositing = scene.render.use_sequencer = False
    if "MMGSD_THREADS" in os.environ:
        scene.render.threads_mode, scene.render.threads = "FIXED", int(os.environ["MMGSD_THREADS"])
    cycles = scene.cycles
    cycles.samples, cycles.use_adaptive_sampling = samples, False
    cycles.use_denoising, cycles.denoiser, cycles.denoising_quality = True, "OPENIMAGEDENOISE", "FAST"
    cycles.denoising_input_passes, cycles.denoising_prefilter = "RGB_ALBEDO", "NONE"  # normals are too noisy
    cycles.use_light_tree, cycles.sampling_pattern = False, "TABULATED_SOBOL"  # the defaults cost a third more
    cycles.pixel_filter_type = "BOX"  # the mask is then the share of the pixel's own square
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = 0  # sky and lamp reach every fold directly
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.device = "GPU" if _enable_gpu() else "CPU"
    scene.view_layers[0].aovs.add().name = MASK_PASS
    scene.view_layers[0].aovs[0].type = "VALUE"
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth, settings.exr_codec = "OPEN_EXR_MULTILAYER", "16", "NONE"


def _enable_gpu() -> bool:
    """Select the first kind of GPU that Blender finds; False where there is none."""
    preferences = bpy.context.preferences.addons["cycles"].preferences
    for backend in GPU_BACKENDS:
        try:
            preferences.compute_device_type = backend
        except TypeError:  # this build of Blender does not know the backend
            continue
        preferences.refresh_devices()
        devices = [device for device in preferences.devices if device.type == backend]
        for device in preferences.devices:
            device.use = device in devices
        if devices:
            return True
    return False


def place_camera(scene: bpy.types.Scene, camera: Camera) -> None:
    """Make the scene's camera the given one."""
    scene.camera = scene.camera or add_object("camera", bpy.data.cameras.new("camera"))
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # Blender's camera looks along -z with y up
    scene.camera.matrix_world = Matrix((camera.pose @ flip).tolist())
    scene.camera.data.sensor_fit, scene.camera.data.sensor_width = "HORIZONTAL", 36.0
    scene.camera.data.lens = 36.0 * camera.intrinsics[0, 0] / camera.size[0]


# Render. ------------------------------------------------------------------------------------------------------------


def render_image(scene: bpy.types.Scene, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Image (H, W, 3) uint8 sRGB, and mask (H, W) bool of pixels at least half object; OSError names a full disk."""
    scene.cycles.seed = seed
    width, height = scene.render.resolution_x, scene.render.resolution_y
    size = VIEW_BYTES * width * height
    with scratch_folder(_find_room(size), "mmgsd-view") as folder:
        path = folder / "view.exr"
        scene.render.filepath = str(path).replace("{", "{{").replace("}", "}}")  # Blender fills in single braces
        bpy.ops.render.render(write_still=True)
        if path.stat().st_size < size:  # Blender says nothing of a full disk
            raise OSError(errno.ENOSPC, f"{folder.parent} became full: set TMPDIR to a folder with room")
        lines = read_exr(path, width, height)
    layer = scene.view_layers[0].name
    linear = np.stack([lines[f"{layer}.Combined.{c}"] for c in "RGB"], axis=-1)
    mask = lines[f"{layer}.{MASK_PASS}.X"] >= 0.5
    return encode_srgb(linear), mask


def _find_room(size: int) -> Path:
    """A folder for a file of a ``size`` in bytes that lives for milliseconds: in memory where it has room for many."""
    disk = Path(tempfile.gettempdir())
    others = 2 * (os.cpu_count() or 1)  # a child a core renders, and the file is larger than its pixels
    if os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > others * size:
        return MEMORY
    if shutil.disk_usage(disk).free < 2 * size:
        raise OSError(errno.ENOSPC, f"{disk} and {MEMORY} have no room for a view's {2 * size / 1e6:.1f} MB: "
                      "set TMPDIR to a folder with room")  # fmt: skip
    return disk


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear colour to 8-bit sRGB (IEC 61966-2-1), what Blender calls the view transform "Standard"."""
    clipped = np.clip(linear.astype(np.float32), 0, 1)
    curve = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** np.float32(1 / 2.4) - 0.055)
    return (255 * curve + 0.5).astype(np.uint8)


def read_exr(path: Path, width: int, height: int) -> np.ndarray:
    """Lines (H,) of an uncompressed scan-line OpenEXR file, which end it; their channels (W,) are fields by name.

    A reader of its own because the packages at hand read no named layers. ValueError for a truncated file.
    """
    data = path.read_bytes()
    start = data.index(b"chlist\0") + 11
    (size,) = struct.unpack_from("<i", data, start - 4)
    channels = re.findall(rb"([^\0]+)\0([\1\2]).{15}", data[start : start + size], re.DOTALL)  # of 16 or 32 bits
    fields = [(name.decode(), "<f2" if kind == b"\1" else "<f4", (width,)) for name, kind in channels]
    line = np.dtype([("y", "<i4"), ("bytes", "<i4"), *fields])
    lines = np.frombuffer(data[-height * line.itemsize :], line)
    if not np.array_equal(lines["y"], np.arange(height)):
        raise ValueError(f"{path} must end with {height} uncompressed lines of pixels")
    return lines


# Label. -------------------------------------------------------------------------------------------------------------


def build_bvh(mesh: bpy.types.Object) -> BVHTree:
    """The evaluated mesh in world coordinates, for ray casts."""
    graph = bpy.context.evaluated_depsgraph_get()
    data = mesh.evaluated_get(graph).data
    vertices = read_vertices(data) @ np.array(mesh.matrix_world)[:3, :3].T + np.array(mesh.matrix_world.translation)
    data.calc_loop_triangles()
    triangles = np.empty(3 * len(data.loop_triangles), dtype=np.int32)
    data.loop_triangles.foreach_get("vertices", triangles)
    return BVHTree.FromPolygons(vertices.tolist(), triangles.reshape(-1, 3).tolist(), all_triangles=True)


def read_vertices(mesh: bpy.types.Mesh) -> np.ndarray:
    """Coordinates (V, 3) float64 in the mesh's own frame."""
    return read_attribute(mesh, "position").astype(np.float64)


def read_attribute(mesh: bpy.types.Mesh, name: str) -> np.ndarray:
    """A mesh's attribute of that name, vectors (V, 3) float32."""
    flat = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.attributes[name].data.foreach_get("vector", flat)
    return flat.reshape(-1, 3)


def find_visible(deformed: DeformedObject, bvh: BVHTree, camera: Camera) -> np.ndarray:
    """Which material points the camera sees: (625,) bool."""
    eye = camera.pose[:3, 3]
    inside = np.flatnonzero(camera.contains(camera.project(deformed.points)))
    rays = deformed.points[inside] - eye
    hits = [bvh.ray_cast(Vector(eye), Vector(ray))[0] for ray in rays.tolist()]
    visible = np.zeros(len(deformed.points), dtype=bool)
    visible[inside] = True  # a ray that slips past an edge met nothing: the point is not covered
    hit = np.array([place is not None for place in hits], dtype=bool)
    indices = inside[hit]
    places = np.array([place for place in hits if place is not None], dtype=float).reshape(-1, 3)
    behind = np.linalg.norm(places - eye, axis=1) >= np.linalg.norm(rays[hit], axis=1)
    visible[indices] = behind | deformed.is_own_hit(places, indices)
    return visible
