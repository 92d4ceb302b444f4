"""Workspaces: labels know what covers the object, cameras keep it in the picture, nothing of a view stays."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

bpy = pytest.importorskip("bpy")

from mmgsd.config import RenderConfig  # noqa: E402
from mmgsd.paths import find_root  # noqa: E402
from mmgsd.scene import blender, lighting  # noqa: E402
from mmgsd.scene.blender import DeformedObject  # noqa: E402
from mmgsd.scene.episode import render_episode  # noqa: E402
from mmgsd.scene.objects import cloth  # noqa: E402
from mmgsd.scene.objects.planar_object import load_planar_object  # noqa: E402
from mmgsd.scene.textures import printed  # noqa: E402
from mmgsd.scene.workspace import distractors, materials, primitives, surfaces, view  # noqa: E402

SIZE = (485, 485)
FLAT = DeformedObject(None, cloth.flat_vertices()[::7], {}, None)


def render_views(name: str, views: int, episode: int = 0) -> list[blender.View]:
    own = name not in ("cloth", "rope")
    planar = load_planar_object(find_root() / "data" / "objects" / f"{name}.json") if own else None
    config = RenderConfig(object=name, train_images=1, test_images=1, views=1, scene="workspace")
    return render_episode(config, "train", episode, views, planar)


@pytest.mark.parametrize("name", ["cloth", "rope", "tshirt"])
def test_visible_points_lie_in_the_mask_whatever_covers_the_object(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distractors, "OCCLUDER_COUNTS", (0.0, 0.0, 1.0))
    for shot in render_views(name, 2):
        assert shot.info["present"] == shot.mask.any() == shot.visible.any()
        x, y = np.rint(shot.xy[shot.visible]).astype(int).T
        assert np.mean(distance_transform_edt(~shot.mask)[y, x] <= 2) > 0.98


def test_without_the_object_nothing_is_visible_and_the_mask_is_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "ABSENT", 1.0)
    monkeypatch.setattr(surfaces, "KINDS", {"floor": 1.0})
    (absent,) = render_views("rope", 1)
    assert not absent.mask.any() and not absent.visible.any() and absent.info["present"] is False
    assert np.isfinite(absent.xy).all() and absent.image.std() > 1


def test_an_object_that_something_hides_wholly_counts_as_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    image, nothing = np.full((480, 640, 3), 99, np.uint8), np.zeros((480, 640), bool)
    monkeypatch.setattr(blender, "render_image", lambda *_, **__: (image.copy(), nothing))
    (hidden,) = render_views("rope", 1)
    assert not hidden.visible.any() and hidden.info["present"] is False


@pytest.mark.parametrize("limit", [45.0, 180.0])
def test_the_object_is_in_the_picture_however_the_camera_tilts(limit: float) -> None:
    rng, tilts, fills = np.random.default_rng(0), [], []
    for _ in range(80):
        camera, turn, tilt = view.draw_camera(rng, FLAT, SIZE, limit)
        xy = camera.project(FLAT.points)
        assert camera.contains(xy).mean() >= 1 - view.MAX_OUTSIDE and abs(np.degrees(turn)) <= limit
        down = np.degrees(np.arccos(-camera.pose[2, 2]))
        assert down == pytest.approx(tilt, abs=1e-3) and tilt <= view.MAX_TILT_DEG
        tilts.append(tilt)
        fills.append(np.ptp(xy, axis=0).max() / SIZE[0])
    assert max(tilts) > 35 and min(fills) < 0.4 and max(fills) > 0.9


def test_points_behind_a_thing_are_covered_and_the_others_are_not() -> None:
    camera = view.frame_points(np.random.default_rng(0), FLAT.points, SIZE, 0.0, 0.0, 0.8, 3.0)
    box = primitives.make_box((0.3, 0.3, 0.02), (0.2, 0.2, 0.1))
    covered = distractors.find_occluded([box], FLAT.points, camera)
    apart = np.abs(FLAT.points[:, :2] - 0.2).max(axis=1)
    assert covered[apart < 0.1].all() and not covered[apart > 0.25].any()
    assert not distractors.find_occluded([], FLAT.points, camera).any()


def test_things_leave_at_least_half_of_the_object_to_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distractors, "OCCLUDER_COUNTS", (0.0, 0.0, 1.0))
    camera = view.frame_points(np.random.default_rng(0), FLAT.points, SIZE, 0.0, 20.0, 0.8, 3.0)
    seen = np.ones(len(FLAT.points), dtype=bool)
    site = surfaces.Site(FLAT.points, 1.0, 0.0, np.random.default_rng(1).uniform(-2, 2, (60, 2)), (9, 9, 9), 0.0)
    hidden = []
    for seed in range(12):
        blender.reset_scene()
        left, _ = distractors.add_distractors(np.random.default_rng(seed), site, camera, seen, beside=True, walls=[])
        hidden.append(1 - left.mean())
    assert max(hidden) <= distractors.MAX_OCCLUDED and np.mean(np.array(hidden) > 0.01) > 0.5


def test_a_rope_has_no_cords_beside_it() -> None:
    site = surfaces.Site(FLAT.points, 1.0, 0.0, np.zeros((1, 2)), (9, 9, 9), 0.01)
    names = {
        name for seed in range(200) for name, *_ in distractors._choose(np.random.default_rng(seed), site, True, True)
    }
    assert "cord" not in names and {"mug", "textile", "gripper", "hand"} <= names


def test_things_cast_shadows() -> None:
    """A sun from the side: the floor is dark on one side of a box, and light on the other."""
    scene = blender.reset_scene()
    blender.setup_cycles(scene, SIZE, 4)
    surfaces._add_floor(materials.paint_plain(np.random.default_rng(0), (250, 250, 250)), 0.0)
    box = primitives.make_box((0.2, 0.2, 0.3), (0, 0, 0.15))
    surfaces.add_solid(box, materials.paint_plain(np.random.default_rng(0), (250, 250, 250)))
    blender.place_camera(scene, view.frame_points(np.random.default_rng(0), FLAT.points, SIZE, 0.0, 0.0, 1.0, 3.0))
    lighting.set_world(scene, (1.0, 1.0, 1.0, 1.0), 0.1)
    lamp = lighting.add_lamp("SUN", 0.1)
    lamp.data.energy, lamp.rotation_euler = 3.0, (0.0, np.radians(50), 0.0)  # from +x
    image, _ = blender.render_image(scene, seed=0)
    row = image[SIZE[1] // 2].mean(axis=1)
    assert row[360] > 2 * row[130]


def photograph_sheet(scene: bpy.types.Scene) -> np.ndarray:
    """A small picture (64, 64, 3) of a large white sheet from above."""
    camera = view.frame_points(np.random.default_rng(0), FLAT.points, (64, 64), 0.0, 0.0, 1.0, 3.0)
    blender.place_camera(scene, camera)
    return blender.render_image(scene, seed=0)[0]


@pytest.mark.parametrize("path", lighting.list_maps(), ids=lambda path: path.stem)
def test_a_map_lights_a_level_sheet_as_brightly_as_asked(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lighting, "list_maps", lambda: [path])
    scene, rng = blender.reset_scene(), np.random.default_rng(0)
    blender.setup_cycles(scene, (64, 64), 16)
    surfaces._add_floor(materials.paint_plain(np.random.default_rng(1), (255, 255, 255)), 0.0)
    assert lighting.light_world(rng, scene, 0.5, np.ones(3)) == f"map {path.stem}"
    assert photograph_sheet(scene).mean() == pytest.approx(blender.encode_srgb(np.array(0.5)), rel=0.12)


def test_nothing_of_a_map_is_left_under_another_light() -> None:
    scene = blender.reset_scene()
    blender.setup_cycles(scene, (64, 64), 16)
    surfaces._add_floor(materials.paint_plain(np.random.default_rng(1), (255, 255, 255)), 0.0)
    lighting.light_world(np.random.default_rng(0), scene, 0.5, np.ones(3))
    lighting.set_world(scene, (1.0, 0.0, 0.0, 1.0), 1.0)
    assert photograph_sheet(scene)[..., 1:].mean() < 40


def test_a_third_of_the_views_are_lit_by_maps_and_half_of_these_by_a_lamp_too() -> None:
    scene, rng = blender.reset_scene(), np.random.default_rng(0)
    names = [view.draw_light(rng, scene, 1.0, np.zeros(3)) for _ in range(150)]
    mapped, alone = (np.mean([name.startswith("map") or (both and "map" in name) for name in names])
                     for both in (True, False))  # fmt: skip
    assert 0.25 < mapped < 0.45 and 0.1 < alone < 0.26


@pytest.mark.parametrize("hands", [1, 2])
def test_grippers_carry_corners_over_the_cloth(hands: int) -> None:
    corners = {0, cloth.SIDE - 1, cloth.SIDE * (cloth.SIDE - 1), cloth.SIDE**2 - 1}
    rng, seen = np.random.default_rng(0), 0
    for _ in range(40):
        grasps, frames = cloth._fold_grasped(rng, cloth.flat_vertices())
        carried = {vertex: np.linalg.norm(path[-1, :2]) for vertex, path in grasps.items() if path[-1, :2].any()}
        seen += len(carried) == hands
        assert carried.keys() <= corners and all(len(path) == frames for path in grasps.values())
        assert all(0.3 < far < 1.6 for far in carried.values())
    assert seen > 8


def test_cloths_of_a_workspace_are_squares_and_rectangles_up_to_three_by_two() -> None:
    rng = np.random.default_rng(0)
    sides = [np.ptp(cloth.draw_rectangle(rng).rest[:, :2], axis=0) for _ in range(300)]
    ratio = np.array([side.max() / side.min() for side in sides])
    assert ratio.max() <= 1.5 + 1e-6 and 0.4 < np.mean(ratio == 1) < 0.6 and np.mean(ratio > 1.08) > 0.25


@pytest.mark.parametrize("name", [*printed.PICTURES, *printed.FABRICS])
def test_every_picture_is_a_picture(name: str, rng: np.random.Generator) -> None:
    paint = (printed.PICTURES | printed.FABRICS)[name]
    image = np.asarray(paint(rng, (120, 40, 200)))
    assert image.shape == (printed.SIDE, printed.SIDE, 3) and image.dtype == np.uint8


@pytest.mark.parametrize("name", [*distractors.DISTRACTORS, *distractors.OCCLUDERS])
def test_every_thing_stands_on_the_table_and_is_closed_to_rays(name: str, rng: np.random.Generator) -> None:
    for _ in range(5):
        for solid, _, _ in (distractors.DISTRACTORS | distractors.OCCLUDERS)[name](rng):
            assert np.isfinite(solid.vertices).all() and solid.faces.max() < len(solid.vertices)
            assert solid.vertices[:, 2].min() > -0.05


def test_nothing_of_a_view_stays_but_its_pictures_until_the_episode_ends() -> None:
    render_views("rope", 2)
    materials.remove_view()
    kinds = (bpy.data.objects, bpy.data.meshes, bpy.data.materials)
    assert not [block.name for kind in kinds for block in kind if block.name.startswith(materials.PREFIX)]
    blender.reset_scene()
    assert not len(bpy.data.images)
