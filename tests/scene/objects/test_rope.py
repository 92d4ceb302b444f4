"""The rope's shape and physics, in pure numpy; one test renders in a child process."""

import subprocess
import sys

import numpy as np
import pytest

from mmgsd.fold.tasks import TASKS
from mmgsd.scene import SceneError
from mmgsd.scene.objects import rope_shape
from mmgsd.scene.objects.rope_physics import LENGTH, bend, pull_rope, resample
from mmgsd.scene.objects.rope_shape import STATES, RopeShape, find_crossings, own_parts, sample_rope

SEEDS = 36


@pytest.fixture(scope="module")
def ropes() -> list[RopeShape]:
    """Every third with a ball."""
    return [sample_rope(np.random.default_rng(seed), ball=seed % 3 == 0) for seed in range(SEEDS)]


def hits_from_above(shape: RopeShape) -> np.ndarray:
    """Where vertical rays to the centre line (N, 3) first meet a round tube around it: (N, 3)."""
    apart = np.linalg.norm(shape.centre[:, None, :2] - shape.centre[None, :, :2], axis=2)
    height = np.sqrt(np.maximum((shape.thickness / 2) ** 2 - apart**2, 0)) + shape.centre[None, :, 2]
    top = np.where(apart < shape.thickness / 2, height, -np.inf).max(axis=1)
    return np.column_stack([shape.centre[:, :2], top])


def test_no_rope_cuts_through_itself(ropes: list[RopeShape]) -> None:
    assert min(rope_shape.min_separation(shape) for shape in ropes) >= 0.95
    assert min(rope_shape.ball_clearance(shape) for shape in ropes) >= 0.45


def test_separation_is_that_of_the_curve_not_of_its_samples(ropes: list[RopeShape]) -> None:
    for shape in ropes[:20]:
        fine = RopeShape(resample(shape.centre, 4000), shape.thickness, shape.state, shape.crossings, 0.0)
        assert rope_shape.min_separation(fine) >= 0.95


def test_rope_lies_on_the_table_and_rises_gently_at_crossings(ropes: list[RopeShape]) -> None:
    for shape in ropes:
        radius = shape.thickness / 2
        assert shape.centre[:, 2].min() >= 0.98 * radius
        assert rope_shape.max_slope(shape) <= 1.2
        assert rope_shape.min_bend_radius(shape) >= 1.1
        above, below = shape.crossings.T
        assert np.all(shape.centre[above, 2] - shape.centre[below, 2] >= 0.95 * shape.thickness)
        if not len(shape.crossings) and not shape.ball_radius:
            assert shape.centre[:, 2].max() <= 1.05 * radius


def test_states_have_their_crossings(ropes: list[RopeShape]) -> None:
    counts = {"loops": {1, 2, 3}, "overhand knot": {3}}
    assert {shape.state for shape in ropes} == set(STATES)
    for shape in ropes:
        assert len(shape.crossings) in counts.get(shape.state, {0})
    loops = {len(shape.crossings) for shape in ropes if shape.state == "loops"}
    assert len(loops) >= 2


def test_overhand_knot_is_a_trefoil(ropes: list[RopeShape]) -> None:
    for shape in (shape for shape in ropes if shape.state == "overhand knot"):
        passes = np.sort(shape.crossings.ravel())
        above = np.isin(passes, shape.crossings[:, 0])
        names = [int(np.flatnonzero((shape.crossings == index).any(axis=1))[0]) for index in passes]
        assert names[:3] == names[3:]  # the trefoil's Gauss code: 1 2 3 1 2 3,
        assert np.all(above[1:] != above[:-1])  # over and under in turn


def test_material_points_are_equally_spaced(ropes: list[RopeShape]) -> None:
    for shape in ropes:
        steps = np.linalg.norm(np.diff(shape.centre, axis=0), axis=1)
        assert shape.centre.shape == (625, 3)
        assert steps.sum() == pytest.approx(LENGTH, rel=1e-3)
        assert np.ptp(steps) < 0.01 * steps.mean()


def test_only_the_upper_part_of_a_crossing_is_visible(ropes: list[RopeShape]) -> None:
    for shape in (shape for shape in ropes if len(shape.crossings)):
        own = own_parts(shape.centre, 2 * shape.thickness)
        visible = own(hits_from_above(shape), np.arange(len(shape.centre)))
        above, below = shape.crossings.T
        assert visible[above].all() and not visible[below].any()
        spacing = LENGTH / (len(shape.centre) - 1) / shape.thickness
        far = np.abs(np.arange(625)[:, None] - shape.crossings.ravel()).min(axis=1) * spacing > 2.5
        assert visible[far].mean() > 0.97


def test_shape_depends_on_the_seed_alone() -> None:
    first, second = (sample_rope(np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.centre, second.centre) and first.thickness == second.thickness
    assert not np.allclose(first.centre, sample_rope(np.random.default_rng(6)).centre)


def test_thickness_varies(ropes: list[RopeShape]) -> None:
    thickness = np.array([shape.thickness for shape in ropes])
    assert thickness.min() < 0.035 < 0.042 < thickness.max()


@pytest.mark.parametrize("state", STATES)
def test_a_thin_cable_is_as_possible_as_a_rope(state: str) -> None:
    shape = sample_rope(np.random.default_rng(2), state=state, slenderness=(150, 150))
    assert rope_shape.is_possible(shape) and shape.state == state
    assert 1 / 175 < shape.thickness / LENGTH < 1 / 120


def test_find_crossings_of_a_bow() -> None:
    pairs, angles = find_crossings(np.array([[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 2.0]]))
    assert pairs.tolist() == [[0, 2]]
    assert angles == pytest.approx([np.pi / 2])


def test_resample_keeps_ends_and_spacing() -> None:
    angle = np.linspace(0, np.pi, 30) ** 1.2 / np.pi**0.2
    points = resample(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]), 101)
    assert points[0] == pytest.approx([1, 0, 0]) and points[-1] == pytest.approx([-1, 0, 0], abs=1e-9)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1) == pytest.approx(np.pi / 100, rel=1e-3)


@pytest.mark.parametrize(("name", "nothing"), [("_sample_plan", lambda *_: None), ("is_possible", lambda _: False)])
def test_a_rope_that_never_lies_well_is_given_up(monkeypatch: pytest.MonkeyPatch, name: str, nothing: object) -> None:
    monkeypatch.setattr(rope_shape, name, nothing)
    monkeypatch.setattr(rope_shape, "relax", lambda points, *_: points)
    monkeypatch.setattr(rope_shape, "SETTLED", 3)
    with pytest.raises(SceneError, match="'bent'.* 50000 curves were drawn, or 3 suitable ones settled"):
        sample_rope(np.random.default_rng(0), state="bent")


def test_unknown_state_is_an_error() -> None:
    with pytest.raises(ValueError, match="'granny'"):
        sample_rope(np.random.default_rng(0), state="granny")


RENDER = """
import numpy as np
from mmgsd.config import RenderConfig
from mmgsd.scene.episode import render_episode
view, = render_episode(RenderConfig(object="rope", ball={ball}, samples=1, seed=3), "train", {episode}, 1)
x, y = np.rint(view.xy[view.visible]).astype(int).T
print("share in mask", view.mask[y, x].mean(), view.visible.mean())
"""


@pytest.mark.parametrize(("episode", "ball"), [(0, False), (1, True)])
def test_centre_line_lies_in_the_rendered_mask(episode: int, ball: bool) -> None:
    code = RENDER.format(episode=episode, ball=ball)
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300)
    in_mask, visible = child.stdout.split("share in mask")[1].split()[:2]
    assert float(in_mask) >= 0.99
    assert float(visible) >= 0.8


# Under grippers. ------------------------------------------------------------------------------------------------------


def measure_length(centre):
    return np.linalg.norm(np.diff(centre, axis=0), axis=1).sum()


def carry(shape, task):
    """The look's grasps from wherever the points are to the task's places."""
    moves = TASKS[task].looks[0]
    return [(move.pick, np.array(move.place) - shape.centre[move.pick, :2]) for move in moves]


@pytest.mark.parametrize("seed", range(3))
def test_straightening_pulls_the_ends_apart_and_does_not_stretch(seed):
    shape = sample_rope(np.random.default_rng(seed), state="heavily bent")
    _, pulled = pull_rope(shape.centre, shape.thickness, carry(shape, "straighten"))
    before, after = (np.linalg.norm(centre[-1] - centre[0]) for centre in (shape.centre, pulled))
    assert after > 1.25 * before and after > 0.97 * LENGTH
    assert measure_length(pulled) == pytest.approx(LENGTH, rel=0.02)


def test_both_ends_come_to_lie_where_they_are_put_and_the_middle_stays():
    shape = sample_rope(np.random.default_rng(0), state="straight")
    _, folded = pull_rope(shape.centre, shape.thickness, carry(shape, "ends"))
    for move in TASKS["ends"].looks[0]:
        assert np.linalg.norm(folded[move.pick, :2] - move.place) < 0.05
    assert np.linalg.norm(folded[312] - shape.centre[312]) < 0.05
    assert folded[:, 2].min() >= 0.45 * shape.thickness and folded[:, 2].max() < 2.5 * shape.thickness
    assert measure_length(folded) == pytest.approx(LENGTH, rel=0.05)


def test_without_grasps_a_rope_stays_nearly_as_it_lies():
    shape = sample_rope(np.random.default_rng(1), state="bent")
    _, left = pull_rope(shape.centre, shape.thickness, [])
    assert np.linalg.norm(left - shape.centre, axis=1).max() < 0.05


def test_a_particle_whose_neighbours_are_at_one_place_stays_finite():
    points = np.array([[0.0, 0, 0.5], [0.5, 0, 0.5], [0.0, 0, 0.5], [0.5, 0, 0.5], [1.0, 0, 0.5]])  # grippers met
    bend(points, 0.0, 1)
    assert np.isfinite(points).all()
