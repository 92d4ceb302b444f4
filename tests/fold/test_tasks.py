"""The table of folding tasks, and how places are carried from the demonstration to another table."""

import numpy as np
import pytest

from mmgsd.fold.tasks import STARTS, TASKS, find_task, fit_motion, place_truth

QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])  # a turn by 90°


def test_an_unknown_task_is_refused_with_the_names_that_there_are():
    with pytest.raises(ValueError, match="task must .*got 'egde'") as error:
        find_task("egde")
    assert "did you mean 'edge'" in str(error.value)


@pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
def test_a_task_grasps_points_that_the_object_has_and_starts_from_its_states(task):
    moves = [move for look in task.looks for move in look]
    assert all(0 <= move.pick < 625 and np.abs(move.place).max() < 0.8 for move in moves)
    assert {*task.starts, task.demonstrated_from} <= set(STARTS[task.object])
    assert all(len({move.pick for move in look}) == len(look) for look in task.looks)


def test_halving_lays_the_first_row_on_the_last():
    row, column = np.divmod(np.arange(625), 25)
    flat = np.stack([column / 24 - 0.5, 0.5 - row / 24], axis=1)  # as mmgsd.scene.objects.cloth lays it
    for move in TASKS["edge"].looks[0]:
        assert move.place == pytest.approx(flat[move.pick] * (1, -1))
    (unfold,) = TASKS["unfold"].looks[0]
    assert unfold.place == pytest.approx(flat[unfold.pick])


def test_places_turn_and_move_with_the_object_whatever_its_heights(rng):
    points = rng.normal(size=(625, 3))
    moved = np.column_stack([points[:, :2] @ QUARTER.T + (0.5, -0.2), rng.normal(size=625)])
    turn, shift = fit_motion(points, moved)
    assert turn == pytest.approx(QUARTER) and shift == pytest.approx((0.5, -0.2))
    places = place_truth(np.array([[1.0, 0.0], [0.0, 0.0]]), points, moved)
    assert places == pytest.approx(np.array([[0.5, 0.8], [0.5, -0.2]]))


def test_a_motion_is_never_a_reflection(rng):
    points = rng.normal(size=(50, 2))
    turn, _ = fit_motion(points, points * (1, -1))
    assert np.linalg.det(turn) == pytest.approx(1)


def test_points_of_different_objects_are_refused():
    with pytest.raises(ValueError, match=r"target must .*got \(3, 3\)"):
        fit_motion(np.zeros((625, 3)), np.zeros((3, 3)))
