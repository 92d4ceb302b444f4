"""A rope under grippers: as long as before, on the table, laid where it was carried."""

import numpy as np
import pytest

from mmgsd.fold.tasks import TASKS
from mmgsd.scene.objects.rope_relax import bend
from mmgsd.scene.objects.rope_shape import LENGTH, sample_rope
from mmgsd.scene.rope_pull import pull_rope


def measure_length(centre):
    return np.linalg.norm(np.diff(centre, axis=0), axis=1).sum()


def carry(shape, task):
    """The look's grasps from wherever the points are to the task's places."""
    moves = TASKS[task].looks[0]
    return [(move.pick, np.array(move.place) - shape.centre[move.pick, :2]) for move in moves]


@pytest.mark.parametrize("seed", range(3))
def test_straightening_pulls_the_ends_apart_and_does_not_stretch(seed):
    shape = sample_rope(np.random.default_rng(seed), state="heavily bent")
    pulled = pull_rope(shape.centre, shape.thickness, carry(shape, "straighten"))
    before, after = (np.linalg.norm(centre[-1] - centre[0]) for centre in (shape.centre, pulled))
    assert after > 1.25 * before and after > 0.97 * LENGTH
    assert measure_length(pulled) == pytest.approx(LENGTH, rel=0.02)


def test_both_ends_come_to_lie_where_they_are_put_and_the_middle_stays():
    shape = sample_rope(np.random.default_rng(0), state="straight")
    folded = pull_rope(shape.centre, shape.thickness, carry(shape, "ends"))
    for move in TASKS["ends"].looks[0]:
        assert np.linalg.norm(folded[move.pick, :2] - move.place) < 0.05
    assert np.linalg.norm(folded[312] - shape.centre[312]) < 0.05
    assert folded[:, 2].min() >= 0.45 * shape.thickness and folded[:, 2].max() < 2.5 * shape.thickness
    assert measure_length(folded) == pytest.approx(LENGTH, rel=0.05)


def test_without_grasps_a_rope_stays_nearly_as_it_lies():
    shape = sample_rope(np.random.default_rng(1), state="bent")
    left = pull_rope(shape.centre, shape.thickness, [])
    assert np.linalg.norm(left - shape.centre, axis=1).max() < 0.05


def test_a_point_that_the_rope_has_not_is_refused():
    with pytest.raises(ValueError, match="grasps must have indices from 0 to 624, got 625"):
        pull_rope(np.zeros((625, 3)), 0.04, [(625, np.zeros(2))])


def test_a_particle_whose_neighbours_are_at_one_place_stays_finite():
    points = np.array([[0.0, 0, 0.5], [0.5, 0, 0.5], [0.0, 0, 0.5], [0.5, 0, 0.5], [1.0, 0, 0.5]])  # grippers met
    bend(points, 0.0, 1)
    assert np.isfinite(points).all()
