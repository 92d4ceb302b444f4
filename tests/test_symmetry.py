import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mmgsd.symmetry import GRID_GROUPS, LINE_GROUPS, SymmetryGroup, grid_group, line_group, load_group, load_mirror

ORDERS = {"identity": 1, "c2": 2, "v4": 4, "c4": 4, "d4": 8}
LOADED = [("cloth", name) for name in GRID_GROUPS] + [("rope", name) for name in LINE_GROUPS]
groups = st.one_of(
    st.builds(lambda name, side: grid_group(name, side=side), st.sampled_from(GRID_GROUPS), st.integers(2, 9)),
    st.builds(lambda name, n: line_group(name, n=n), st.sampled_from(LINE_GROUPS), st.integers(2, 40)),
)


def is_row(group, permutation):
    return (group.permutations == permutation).all(axis=1).any()


@pytest.mark.parametrize(("object", "name"), LOADED)
def test_axioms_hold_on_the_projects_objects(object, name):
    group = load_group(object, name)
    assert group.permutations.shape == (ORDERS[name], 625)
    assert is_row(group, np.arange(625))
    for a in group.permutations:
        assert is_row(group, np.argsort(a))  # the inverse
        for b in group.permutations:
            assert is_row(group, a[b])


@given(groups)
def test_orbits_are_equivalence_classes(group):
    orbits = group.orbit(np.arange(group.n_points))  # (P, G)
    classes = [frozenset(orbit) for orbit in orbits.tolist()]
    for point, members in enumerate(classes):
        assert point in members
        assert all(classes[member] == members for member in members)
        assert group.order % len(members) == 0


@given(groups)
def test_modes_are_the_distinct_orbit_members(group):
    counts = group.count_modes(np.arange(group.n_points))
    expected = [len(set(orbit)) for orbit in group.orbit(np.arange(group.n_points)).tolist()]
    assert counts.tolist() == expected
    assert group.distinct_modes(0).tolist() == sorted(set(group.orbit(0).tolist()))


@pytest.mark.parametrize("name", ["v4", "c4", "d4"])
def test_a_corner_goes_to_the_four_corners(name):
    assert grid_group(name).distinct_modes(0).tolist() == [0, 24, 600, 624]


def test_groups_differ_inside():
    side, (row, column) = 5, (0, 1)
    point = row * side + column
    assert grid_group("c2", side=side).distinct_modes(point).tolist() == [1, 23]
    assert grid_group("v4", side=side).distinct_modes(point).tolist() == [1, 3, 21, 23]
    assert grid_group("c4", side=side).distinct_modes(point).tolist() == [1, 9, 15, 23]
    assert grid_group("d4", side=side).distinct_modes(point).tolist() == [1, 3, 5, 9, 15, 19, 21, 23]


@pytest.mark.parametrize(("object", "name"), LOADED)
def test_the_centre_is_a_single_mode(object, name):
    assert load_group(object, name).count_modes(312) == 1


def test_a_rope_is_read_from_either_end():
    rope = load_group("rope", "c2")
    assert rope.orbit([0, 10]).tolist() == [[0, 624], [10, 614]]
    assert rope.count_modes([0, 312]).tolist() == [2, 1]


def test_orbit_keeps_the_shape_of_points():
    group = grid_group("c4", side=3)
    assert group.orbit(4).shape == (4,)
    assert group.orbit(np.zeros((2, 3), int)).shape == (2, 3, 4)
    assert group.orbit(np.zeros(0, int)).shape == (0, 4)


def test_round_trip_through_json():
    group = grid_group("d4", side=3)
    again = SymmetryGroup(**json.loads(json.dumps(group.to_dict())))
    assert again.name == "d4"
    assert np.array_equal(again.permutations, group.permutations)


def test_permutations_are_read_only_and_copied():
    array = np.array([[0, 1], [1, 0]])
    group = SymmetryGroup("swap", array)
    array[0] = 1
    assert group.permutations.tolist() == [[0, 1], [1, 0]]
    with pytest.raises(ValueError, match="read-only"):
        group.permutations[0, 0] = 1


@pytest.mark.parametrize(
    ("permutations", "message"),
    [
        ([[1, 0]], "identity"),
        ([[0, 1, 2], [1, 2, 0]], "row 1 after row 1 is not a row"),
        ([[0, 1], [0, 1]], "2 different rows, got 1"),
        ([[0, 0]], "row 0 does not"),
        ([[0, 1], [1, 2]], "row 1 does not"),
        ([0, 1], r"\(G, P\) array"),
        (np.zeros((0, 3), int), r"\(G, P\) array"),
        ([[0.0, 1.0]], "integers, got an array of float64"),
    ],
)
def test_what_is_no_group_is_refused(permutations, message):
    with pytest.raises(ValueError, match=message):
        SymmetryGroup("broken", np.asarray(permutations))


@pytest.mark.parametrize("points", [-1, 625, [0, 625], 1.5])
def test_points_outside_are_refused(points):
    with pytest.raises(ValueError, match="points must be"):
        load_group("cloth", "c4").orbit(points)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: load_group("towel", "c2"), "object must be one of 'cloth', 'rope', got 'towel'"),
        (lambda: load_group("rope", "c4"), "group of a rope must be one of 'identity', 'c2', got 'c4'"),
        (lambda: load_group("cloth", "d8"), "'v4', 'c4', 'd4', got 'd8'"),
    ],
)
def test_errors_name_what_is_accepted(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_mirror_counts_a_cloths_columns_backwards_and_leaves_a_rope() -> None:
    cloth = load_mirror("cloth")
    assert cloth[[0, 1, 25, 624]].tolist() == [24, 23, 49, 600]
    assert load_mirror("rope").tolist() == list(range(625))
    for name in ("c2", "v4", "c4", "d4"):  # a mirrored orbit is the mirror image's orbit
        group = load_group("cloth", name)
        for point in (0, 7, 130, 312):
            assert set(cloth[group.orbit(point)]) == set(group.orbit(cloth[point]))
    with pytest.raises(ValueError, match="object must .*got 'towel'"):
        load_mirror("towel")
