"""Rollouts' states: the same in any process, acted upon by pixels, made again where they are damaged."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from mmgsd.files import DamagedFileError
from mmgsd.fold.jobs import act_job, demonstration_job, film_job, look_job, run_jobs, start_job, true_moves
from mmgsd.fold.state import read_state, write_state
from mmgsd.fold.tasks import TASKS

bpy = pytest.importorskip("bpy")

from mmgsd.fold import manipulation  # noqa: E402
from mmgsd.scene.objects import cloth  # noqa: E402

NOWHERE = [((-40.0, -40.0), (200.0, 200.0))]
STARTS = {
    "edge": start_job(TASKS["edge"], "flat", "plain", 3),
    "straighten": start_job(TASKS["straighten"], "bent", "workspace", 3),
    "within": start_job(TASKS["edge"], "flat", "plain", 3, turn_deg=10.0),
    "demonstrated-edge": demonstration_job(TASKS["edge"], 0),
    "demonstrated-straighten": demonstration_job(TASKS["straighten"], 0),
}


def run(jobs, folder):
    return run_jobs(jobs, folder, workers=1, progress=False)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """Files of first states by name."""
    return run(STARTS, tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def acted(first, tmp_path_factory):
    """States by name after the true moves, and after a pick beside the object."""
    jobs = {"missed": act_job(first["edge"], NOWHERE), "missed-rope": act_job(first["straighten"], NOWHERE)}
    for name in ("edge", "straighten"):
        demonstrated = read_state(first[f"demonstrated-{name}"]).points
        moves = true_moves(TASKS[name].looks[0], demonstrated, read_state(first[name]))
        jobs[name] = act_job(first[name], moves)
    jobs["looked"] = look_job(first["edge"], 1)
    files = run(jobs, tmp_path_factory.mktemp("acted"))
    return {name: read_state(path) for name, path in files.items()}


def test_a_state_within_a_limit_is_seen_about_as_the_demonstration_is(first):
    sides = [np.subtract(*read_state(first[name]).xy[[24, 0]]) for name in ("within", "demonstrated-edge")]
    angles = np.degrees([np.arctan2(y, x) for x, y in sides])
    assert abs(angles[0] - angles[1]) < 15  # the limit, and what the camera's tilt adds
    assert start_job(TASKS["edge"], "flat", "plain", 3)["mark"] == STARTS["edge"]["mark"] != STARTS["within"]["mark"]


@pytest.mark.parametrize(("ground", "turn_deg"), [("workspace", 10.0), ("plain", 181.0), ("plain", -1.0)])
def test_a_limit_is_of_plain_ground_and_half_a_turn_at_most(ground, turn_deg):
    with pytest.raises(ValueError, match="ground must|turn_deg must"):
        start_job(TASKS["edge"], "flat", ground, 3, turn_deg=turn_deg)


def test_a_job_gives_the_same_bytes_in_another_process_and_another_company(first, tmp_path):
    again = run({name: STARTS[name] for name in ("straighten", "edge")}, tmp_path)
    assert all(again[name].read_bytes() == first[name].read_bytes() for name in again)


def test_the_true_moves_halve_the_cloths_silhouette(first, acted):
    before, after = read_state(first["edge"]), acted["edge"]
    assert after.about["fault"] == "" and after.about["look"] == 1
    assert after.mask.sum() == pytest.approx(0.5 * before.mask.sum(), rel=0.2)
    assert (after.intrinsics == before.intrinsics).all() and (after.camera_pose == before.camera_pose).all()


def test_the_true_moves_make_a_rope_longer_from_end_to_end(first, acted):
    spans = [np.linalg.norm(state.points[-1] - state.points[0])
             for state in (read_state(first["straighten"]), acted["straighten"])]  # fmt: skip
    assert spans[1] > spans[0] + 0.05 and spans[1] > 1.5


@pytest.mark.parametrize(("name", "after"), [("edge", "missed"), ("straighten", "missed-rope")])
def test_a_pick_beside_the_object_grasps_nothing(first, acted, name, after):
    before, after = read_state(first[name]), acted[after]
    assert after.about["fault"] == ""
    assert np.linalg.norm(after.points - before.points, axis=1).max() < 0.03
    different = (np.abs(after.image.astype(int) - before.image).max(-1) > 40).mean()
    assert different < 0.02  # the same ground, light and materials


def test_another_look_shows_the_same_state_from_elsewhere(first, acted):
    before, after = read_state(first["edge"]), acted["looked"]
    np.testing.assert_array_equal(after.points, before.points)
    assert np.abs(after.camera_pose - before.camera_pose).max() > 0.01 and (after.image != before.image).any()
    inside = after.visible & (after.xy > 1).all(1)
    column, row = np.rint(after.xy[inside]).astype(int).T
    assert after.mask[row, column].mean() > 0.85


def test_points_are_where_the_picture_shows_them(first):
    state = read_state(first["edge"])
    x, y = np.rint(state.xy[state.visible]).astype(int).T
    aside = distance_transform_edt(~state.mask)[y, x]  # px; points of the rim lie on the outline
    assert state.visible.mean() > 0.95 and aside.max() <= 1.5
    assert np.abs(state.project(state.points) - state.xy).max() < 0.01


def test_a_damaged_state_is_set_aside_and_made_again(first, tmp_path):
    job, path = {"edge": STARTS["edge"]}, tmp_path / "edge.npz"
    path.write_bytes(first["edge"].read_bytes()[:5000])
    with pytest.raises(DamagedFileError, match="edge.npz is damaged"):
        read_state(path)
    with pytest.warns(UserWarning, match="edge.npz is damaged"):
        run(job, tmp_path)
    assert path.read_bytes() == first["edge"].read_bytes() and (tmp_path / "edge.npz.damaged").is_file()
    kept = path.stat().st_mtime_ns
    run(job, tmp_path)
    assert path.stat().st_mtime_ns == kept


def test_a_state_with_a_fault_stays_as_it_is(first, tmp_path):
    state = read_state(first["edge"])
    spoilt = dataclasses.replace(state, about=state.about | {"fault": "nowhere"})
    path = write_state(tmp_path / "spoilt.npz", spoilt)
    after = manipulation.act(read_state(path), {"moves": [((240, 240), (300, 300))], "mark": "mark"})
    assert after.about["fault"] == "nowhere" and after.about["look"] == 1
    assert (after.vertices == state.vertices).all()


def test_what_physics_spoils_is_said():
    line = np.linspace((-0.8, 0, 0), (0.8, 0, 0), 625)
    for name, rest in (("cloth", cloth.flat_vertices()), ("rope", line)):
        assert manipulation.find_fault(rest, name) == ""
        assert "stretched" in manipulation.find_fault(1.5 * rest, name)
        assert manipulation.find_fault(rest * np.nan, name) == "nowhere"


def test_a_gripper_takes_all_layers_near_the_rim_and_one_inside():
    side = cloth.SIDE
    rows = np.arange(side * side) // side
    folded = cloth.flat_vertices()
    over = rows < side // 2
    folded[over] = folded[over] * (1, -1, 1) + (0, 0, 0.02)  # the upper half lies on the lower
    corner, inside = 0, 9 * side + side // 2
    assert set(manipulation.take_layers(folded, corner)) == {0, (side - 1) * side}
    assert manipulation.take_layers(folded, inside) == [inside]


REFUSED = {
    "start .*got 'straight'": lambda state: start_job(TASKS["edge"], "straight", "plain", 0),
    "ground .*got 'sea'": lambda state: start_job(TASKS["edge"], "flat", "sea", 0),
    "task .*got 'iron'": lambda state: start_job(dataclasses.replace(TASKS["edge"], name="iron"), "flat", "plain", 0),
    "moves": lambda state: act_job(state, [((0.0, np.nan), (1.0, 1.0))]),
    "again": lambda state: look_job(state, 0),
    "tilt_deg": lambda state: look_job(state, 1, tilt_deg=90.0),
    "motion": lambda state: film_job(state, NOWHERE, "dance", frames=2),
}


@pytest.mark.parametrize("message", REFUSED)
def test_jobs_refuse_what_no_task_has(first, message):
    with pytest.raises(ValueError, match=message):
        REFUSED[message](first["edge"])


def test_only_a_plain_ground_is_looked_at_from_aside(first):
    with pytest.raises(ValueError, match="ground"):
        look_job(first["straighten"], 1, tilt_deg=60.0)
    assert look_job(first["edge"], 1)["mark"] != look_job(first["edge"], 1, tilt_deg=60.0)["mark"]


def test_an_act_is_marked_by_the_state_that_it_goes_on_from(first):
    marks = {act_job(first[name], NOWHERE)["mark"] for name in ("edge", "straighten")}
    assert len(marks) == 2
    assert act_job(first["edge"], NOWHERE)["mark"] in marks
