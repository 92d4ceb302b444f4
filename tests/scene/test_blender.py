"""Labels of rendered cloths against their pixels."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion, distance_transform_edt

bpy = pytest.importorskip("bpy")

from mmgsd.config import RenderConfig  # noqa: E402
from mmgsd.paths import find_root  # noqa: E402
from mmgsd.scene import SceneError, blender, episode, randomize  # noqa: E402
from mmgsd.scene.objects import cloth  # noqa: E402
from mmgsd.scene.objects.planar_object import load_planar_object  # noqa: E402
from mmgsd.scene.textures import procedural  # noqa: E402

SIZE = (485, 485)


@pytest.fixture(scope="module")
def folded():
    """A folded cloth seen by one camera at 16 samples: (deformed, camera, image, mask)."""
    rng = np.random.default_rng(1)
    scene = blender.reset_scene()
    vertices, _ = cloth.deform(rng, "corner")
    deformed = cloth.add_cloth(vertices, {})
    floor = blender.add_floor("floor", episode.FLOOR)
    blender.setup_cycles(scene, SIZE, 16)
    camera, _ = randomize.draw_camera(rng, deformed.points, SIZE, 180.0)
    blender.place_camera(scene, camera)
    randomize.draw_light(rng, scene)
    colour, _ = randomize.draw_background(rng, floor)
    randomize.draw_object_material(rng, deformed.mesh, colour)
    image, mask = blender.render_image(scene, seed=0)
    return deformed, camera, image, mask


def fill_triangles(mesh, camera):
    """The projected mesh filled at three times the resolution, taken at pixel centres: (H, W) bool."""
    mesh.data.calc_loop_triangles()
    xy = camera.project(blender.read_vertices(mesh.data))
    canvas = Image.new("1", (3 * SIZE[0], 3 * SIZE[1]))
    pen = ImageDraw.Draw(canvas)
    for triangle in mesh.data.loop_triangles:
        pen.polygon([tuple(3 * xy[i] + 1) for i in triangle.vertices], fill=1)
    return np.asarray(canvas)[1::3, 1::3]


def outline(mask):
    return mask & ~binary_erosion(mask, border_value=1)


def outline_distances(a, b):
    """Distances (px) from each outline pixel of mask a to the outline of mask b."""
    return distance_transform_edt(~outline(b))[outline(a)]


def test_projected_outline_is_the_masks_outline(folded):
    deformed, camera, _, mask = folded
    filled = fill_triangles(deformed.mesh, camera)
    distances = np.concatenate([outline_distances(filled, mask), outline_distances(mask, filled)])
    assert np.quantile(distances, 0.99) <= 1.5


def test_visible_points_lie_in_the_mask(folded):
    deformed, camera, _, mask = folded
    visible = blender.find_visible(deformed, blender.build_bvh(deformed.mesh), camera)
    x, y = np.rint(camera.project(deformed.points[visible])).astype(int).T
    assert np.mean(distance_transform_edt(~mask)[y, x] <= 1.5) > 0.99
    assert 0.5 < visible.mean() < 1.0  # the corner hides a part of the cloth


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A folder for temporary files whose name means something to Blender."""
    folder = tmp_path / "a{x}b#{{c"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_a_view_is_rendered_below_any_folder(temporary, monkeypatch):
    monkeypatch.setattr(blender, "MEMORY", temporary / "nowhere")
    scene = blender.reset_scene()
    blender.setup_cycles(scene, (16, 12), 1)
    blender.place_camera(scene, blender.Camera(np.diag([16.0, 16.0, 1.0]), np.eye(4), (16, 12)))
    assert blender.render_image(scene, seed=0)[0].shape == (12, 16, 3)
    assert os.listdir(temporary) == [] and os.listdir(temporary.parent) == [temporary.name]


@pytest.mark.parametrize(
    ("writable", "memory_mb", "disk_mb", "expected"),
    [(True, 64, 10, "memory"), (True, 1, 10, "disk"), (False, 64, 10, "disk"), (True, 1, 1, ""), (False, 64, 1, "")],
)
def test_a_view_goes_where_there_is_room(temporary, tmp_path, monkeypatch, writable, memory_mb, disk_mb, expected):
    memory = tmp_path / "memory"
    memory.mkdir()
    free = {memory: memory_mb, temporary: disk_mb}
    monkeypatch.setattr(blender, "MEMORY", memory)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(os, "access", lambda *_: writable)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1e6 * free[folder]))
    if expected:
        assert blender._find_room(3_000_000) == {"memory": memory, "disk": temporary}[expected]
        return
    with pytest.raises(OSError, match="TMPDIR") as caught:
        blender._find_room(3_000_000)
    assert str(temporary) in str(caught.value) and str(memory) in str(caught.value)


def test_a_folder_that_became_full_is_named(temporary, monkeypatch):
    monkeypatch.setattr(blender, "MEMORY", temporary / "nowhere")
    scene = SimpleNamespace(cycles=SimpleNamespace(), render=SimpleNamespace(resolution_x=16, resolution_y=12))

    def write_part(**_):
        Path(scene.render.filepath.replace("{{", "{").replace("}}", "}")).write_bytes(bytes(100))

    operators = SimpleNamespace(render=SimpleNamespace(render=write_part))
    monkeypatch.setattr(blender, "bpy", SimpleNamespace(ops=operators))
    with pytest.raises(OSError, match="became full.*TMPDIR") as caught:
        blender.render_image(scene, seed=0)
    assert str(temporary) in str(caught.value)


def test_flat_cloth_is_all_visible_and_its_corners_are_the_masks_corners():
    rng = np.random.default_rng(0)
    scene = blender.reset_scene()
    deformed = cloth.add_cloth(cloth.flat_vertices(), {})
    blender.setup_cycles(scene, SIZE, 4)
    camera, _ = randomize.draw_camera(rng, deformed.points, SIZE, 180.0)
    blender.place_camera(scene, camera)
    randomize.draw_object_material(rng, deformed.mesh, (0.0, 0.0, 0.0, 1.0))
    _, mask = blender.render_image(scene, seed=0)
    xy = camera.project(deformed.points).reshape(25, 25, 2)
    y, x = np.nonzero(mask)
    for corner in (xy[0, 0], xy[0, -1], xy[-1, 0], xy[-1, -1]):
        outwards = (corner - xy[12, 12]) / np.linalg.norm(corner - xy[12, 12])
        reach = (np.stack([x, y], axis=1) - corner) @ outwards
        assert abs(reach.max()) <= 2.5  # 1.5 px, and Catmull-Clark rounds the very corner
    assert blender.find_visible(deformed, blender.build_bvh(deformed.mesh), camera).all()


@pytest.mark.parametrize("limit", [45.0, 180.0])
def test_turn_stays_within_the_limit(limit):
    rng = np.random.default_rng(0)
    points = cloth.flat_vertices()[::7]
    for _ in range(40):
        camera, turn = randomize.draw_camera(rng, points, SIZE, limit)
        right = camera.project(np.array([[0.0, 0, 0], [0.1, 0, 0]]))
        dx, dy = right[1] - right[0]
        seen = np.degrees(np.arctan2(dy, dx))  # clockwise in the image
        assert abs(turn) <= limit
        assert abs((seen - turn + 180) % 360 - 180) < 3.0  # tilt shears a little
        assert camera.contains(camera.project(points)).mean() >= 0.95


def test_a_ray_that_meets_nothing_leaves_its_point_visible():
    deformed = blender.DeformedObject(None, np.array([[0.0, 0, 0]]), {}, lambda hits, _: np.zeros(len(hits), bool))
    bvh = blender.BVHTree.FromPolygons([], [])
    camera, _ = randomize.draw_camera(np.random.default_rng(0), deformed.points, SIZE, 45.0)
    assert blender.find_visible(deformed, bvh, camera).tolist() == [True]


def test_crossings_count_a_flap_pushed_through_the_cloth():
    vertices = cloth.flat_vertices()
    faces = cloth.square_cloth().faces
    assert cloth.count_crossings(vertices, faces) == 0
    grid = vertices.reshape(cloth.SIDE, cloth.SIDE, 3)
    grid[0, 0] = grid[10, 10] + (0.3 * cloth.SPACING, 0.3 * cloth.SPACING, -0.05)  # its neighbours stay above
    grid[0, 1, 2] = grid[1, 0, 2] = grid[1, 1, 2] = 0.05
    assert cloth.count_crossings(vertices, faces) > 0


def test_a_cloth_that_never_comes_to_lie_is_given_up_with_the_reasons(monkeypatch):
    results = iter([cloth.flat_vertices()[None] * factor for factor in ((1, 1, np.nan), (2, 2, 1))] * 99)
    monkeypatch.setattr(cloth, "simulate", lambda *_: next(results))
    monkeypatch.setattr(cloth, "STARTS", 2)
    with pytest.raises(SceneError, match="cloth did not .*'flat' in 2 starts with 3 .*nowhere 3 times, stretched.* 3"):
        cloth.deform(np.random.default_rng(0), "flat")


@pytest.mark.parametrize("place", [np.nan, np.inf])
def test_points_that_no_camera_sees_are_given_up(place):
    points = np.full((4, 3), place)
    with pytest.raises(SceneError, match="none of 1000 cameras saw 95%"), np.errstate(invalid="ignore"):
        randomize.draw_camera(np.random.default_rng(0), points, SIZE, 45.0)


def test_a_colour_further_away_than_any_is_given_up():
    with pytest.raises(SceneError, match="none of 1000 colours"):
        procedural.draw_contrasting(np.random.default_rng(0), (0.5, 0.5, 0.5, 1.0), distance=2.0, exempt=0.0)


def test_unknown_split_and_state_are_named():
    with pytest.raises(ValueError, match="split must"):
        episode.render_episode(RenderConfig(), "tset", 0, 1)
    with pytest.raises(ValueError, match="state must be one of"):
        cloth.deform(np.random.default_rng(0), "ironed")


def run_job(tmp_path, name, threads, **changes):
    job = {"split": "test", "episodes": [[1, 2]], "out": str(tmp_path / name), "config": {"samples": 1, **changes}}
    environment = {**os.environ, "MMGSD_THREADS": str(threads)}
    command = [sys.executable, "-m", "mmgsd.scene"]
    return subprocess.run(command, input=json.dumps(job), text=True, capture_output=True, env=environment)


@pytest.mark.parametrize(("config", "size", "told"), [
    ({}, (485, 485), {"turn_deg", "background"}),
    ({"object": "rope", "scene": "workspace"}, (480, 640), {"present", "things", "light", "tilt_deg"}),
])  # fmt: skip
def test_jobs_archive_holds_every_view_and_does_not_depend_on_the_threads(tmp_path, config, size, told):
    for name, threads in (("a.zip", 1), ("b.zip", 2)):
        done = run_job(tmp_path, name, threads, **config)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "b.zip"]
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        labels = json.loads(archive.read("labels.json"))
        assert [(row["episode"], row["view"], row["split"]) for row in labels] == [(1, 0, "test"), (1, 1, "test")]
        assert np.shape(labels[0]["xy"]) == (625, 2) and told <= set(labels[0]["info"])
        with archive.open("000001_01.webp") as image, archive.open("000001_01_mask.png") as mask:
            assert np.asarray(Image.open(image)).shape == (*size, 3)
            assert np.asarray(Image.open(mask)).dtype == bool


def test_a_failed_job_says_why_and_leaves_nothing(tmp_path):
    done = run_job(tmp_path, "a.zip", 1, sampels=1)
    assert done.returncode == 1
    assert "did you mean 'samples'" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["towel", "tshirt"])
def test_a_sheets_points_are_its_vertices(name):
    planar = load_planar_object(find_root() / "data" / "objects" / f"{name}.json")
    blender.reset_scene()
    vertices, _ = cloth.deform(np.random.default_rng(4), "flat", planar)
    deformed = cloth.add_cloth(vertices, {}, planar)
    assert len(deformed.mesh.data.vertices) > 3 * len(vertices) == 3 * len(deformed.points)
    points = deformed.points
    inner = np.linalg.norm(points - vertices - [0, 0, np.mean(points[:, 2] - vertices[:, 2])], axis=1)
    assert np.median(inner) < 0.005  # subdivision smooths, it does not move points along the sheet
    assert inner.max() < 0.02


def test_a_tshirt_lies_on_either_face():
    planar = load_planar_object(find_root() / "data" / "objects" / "tshirt.json")
    fronts = set()
    for seed in range(6):
        blender.reset_scene()
        vertices, _ = cloth.deform(np.random.default_rng(seed), "flat", planar)
        a, b, c = vertices[planar.faces[0]]
        fronts.add(bool(np.cross(b - a, c - a)[2] > 0))
    assert fronts == {True, False}


def test_views_of_a_tshirt_are_labelled():
    planar = load_planar_object(find_root() / "data" / "objects" / "tshirt.json")
    config = RenderConfig(object="tshirt", train_images=1, test_images=1, views=1)
    (view,) = episode.render_episode(config, "train", 0, 1, planar)
    assert view.image.shape == (*planar.size[::-1], 3)
    assert view.xy.shape == (len(planar.rest), 2)
    x, y = np.rint(view.xy[view.visible]).astype(int).T
    assert np.mean(distance_transform_edt(~view.mask)[y, x] <= 1.5) > 0.98


def test_every_view_has_a_picture_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cycles takes a picture at the address of a removed one for that one, and shows what lay there before."""
    monkeypatch.setattr(randomize, "BACKGROUNDS", {"clutter": procedural.BACKGROUNDS["clutter"]})
    episode.render_episode(RenderConfig(object="rope"), "train", 0, 3)
    assert len([image for image in bpy.data.images if image.name.startswith("clutter")]) == 3
