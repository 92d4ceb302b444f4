"""Sheets of one's own: meshes, symmetries found and given, and files that say something wrong."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mmgsd.paths import find_root
from mmgsd.scene.objects.meshes import SPACING
from mmgsd.scene.objects.planar_object import PlanarObject, load_planar_object, turn, turn_over

OBJECTS = find_root(Path(__file__).parent) / "data" / "objects"
SQUARE = [[0, 0], [60, 0], [60, 60], [0, 60]]
TOWEL = [[0, 0], [90, 0], [90, 50], [0, 50]]
DENSE = [[90 * k / 40, 0] for k in range(40)]  # one edge of the towel
GIVEN = [{"turn_deg": 180}]


def save(folder: Path, **values: Any) -> Path:
    path = folder / "thing.json"
    path.write_text(json.dumps(values))
    return path


def grid_obj(rows: int, columns: int) -> str:
    """A flat mesh of quads as an OBJ file's text, spaced by 1/36 of the longest side."""
    lines = [f"v {c} {-r} 0" for r in range(rows) for c in range(columns)]
    index = 1 + np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([index[1:, :-1], index[1:, 1:], index[:-1, 1:], index[:-1, :-1]], -1).reshape(-1, 4)
    return "\n".join(["# a grid", *lines, *(f"f {' '.join(f'{i}//1' for i in quad)}" for quad in quads)])


def ring(count: int, *, height: float = 1.0, turned: float = 0.1, seed: int | None = None) -> list:
    """Corners of an ellipse 2 wide, evenly spread or, with a seed, at random."""
    angles = turned + 2 * np.pi * np.arange(count) / count
    if seed is not None:
        angles = np.sort(np.random.default_rng(seed).uniform(0, 2 * np.pi, count))
    return np.column_stack([np.cos(angles), height * np.sin(angles)]).tolist()


def turn_corners(outline: list, degrees: float, *, digits: int = 2) -> list:
    return (np.array(outline) @ turn(degrees)[:2, :2].T).round(digits).tolist()


def measure_ring(outline: list) -> float:
    """The area that an outline encloses, its longest side 1."""
    x, y = (np.array(outline) / np.ptp(outline, axis=0).max()).T
    return 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)


def measure_area(planar: PlanarObject) -> float:
    a, b, c = (planar.rest[planar.faces[:, k], :2] for k in range(3))
    return float(0.5 * np.sum((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]))


@pytest.mark.parametrize(
    ("outline", "symmetry", "order"),
    [
        (SQUARE, "turns", 4), (SQUARE, "turns and faces", 8), (TOWEL, "turns", 2), (TOWEL, "turns and faces", 4),
        (TOWEL, [{"turn_deg": 180}], 2), (TOWEL, [{"over_deg": 0}, {"over_deg": 90}], 4), (TOWEL, [], 1),
        ([[0, 0], [90, 0], [45, 50]], "turns", 1), ([[0, 0], [2, 0], [1, 3**0.5]], "turns and faces", 6),
        (TOWEL, [np.diag([-1.0, -1, 1, 1]).ravel().tolist()], 2),
    ],
)  # fmt: skip
def test_groups_found_and_given(tmp_path: Path, outline: list, symmetry: Any, order: int) -> None:
    planar = load_planar_object(save(tmp_path, outline=outline, symmetry=symmetry))
    assert planar.group.order == order
    assert planar.group.n_points == len(planar.rest)
    has_faces = symmetry == "turns and faces" or "over_deg" in str(symmetry)
    assert planar.either_face == has_faces


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize(("symmetry", "order"), [("turns", 2), ("turns and faces", 4), (GIVEN, 2)])
@pytest.mark.parametrize(
    "outline",
    [
        [*TOWEL, TOWEL[0]], [TOWEL[0], *TOWEL, TOWEL[3], TOWEL[0]], [*DENSE, *TOWEL[1:]],
        [*([x, 0.004 * (-1) ** k] for k, (x, _) in enumerate(DENSE)), *TOWEL[1:]], [[45, 0], *TOWEL[1:], TOWEL[0]],
        [*TOWEL[:2], [90, 49.97], [89.97, 50], TOWEL[3]], turn_corners([*DENSE, *TOWEL[1:]], 17.0),
        ring(200, height=0.6, seed=0),
    ],
    ids=["closed", "repeated", "dense edge", "dense, not quite straight edge", "starts on an edge", "tiny edge",
         "turned and rounded", "uneven ellipse"],
)  # fmt: skip
def test_spare_corners_do_not_change_the_group(
    tmp_path: Path, outline: list, symmetry: Any, order: int, clockwise: bool
) -> None:
    planar = load_planar_object(save(tmp_path, outline=outline[:: -1 if clockwise else 1], symmetry=symmetry))
    assert planar.group.order == order
    assert np.ptp(planar.rest[planar.group.permutations].mean(axis=0), axis=0)[:2] == pytest.approx([0, 0], abs=0.01)


@pytest.mark.parametrize(("outline", "symmetry", "order"), [
    (ring(9), "turns", 9), (ring(9), "turns and faces", 18), (ring(12), "turns and faces", 24),
    (ring(64), "turns", 24), (ring(1000), "turns", 24), (ring(150, seed=1), "turns", 24),
    (ring(100), "turns and faces", 24), (ring(333, height=0.6), "turns and faces", 4),
])  # fmt: skip
def test_round_outlines_have_the_largest_group_that_fits(
    tmp_path: Path, outline: list, symmetry: str, order: int
) -> None:
    planar = load_planar_object(save(tmp_path, outline=outline, symmetry=symmetry))
    assert planar.group.order == order
    assert measure_area(planar) == pytest.approx(measure_ring(outline), rel=0.02)


@pytest.mark.parametrize("degrees", [0.0, 21.7])
def test_an_axis_between_the_meshs_points_is_found(tmp_path: Path, degrees: float) -> None:
    kite = turn_corners([[0, 0], [50, 0], [71, 60], [-21, 60]], degrees, digits=9)  # a trapezium: 19 edges at its foot
    planar = load_planar_object(save(tmp_path, outline=kite, symmetry="turns and faces"))
    assert (planar.group.order, planar.either_face) == (2, True)
    for corner in np.array(kite) - np.array(kite).mean(0):
        apart = np.linalg.norm(planar.rest[:, :2] - planar.rest[:, :2].mean(0) - corner / 92, axis=1)
        assert apart.min() < 0.15  # no corner was lost


def test_a_meshs_faces_are_found_however_it_is_turned(tmp_path: Path) -> None:
    place = np.array([[c, -r, 0] for r in range(20) for c in range(37)]) @ turn(10.3).T
    faces = [line for line in grid_obj(20, 37).splitlines() if line[0] == "f"]
    (tmp_path / "grid.obj").write_text("\n".join([*(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in place), *faces]))
    planar = load_planar_object(save(tmp_path, mesh="grid.obj", symmetry="turns and faces"))
    assert (planar.group.order, planar.mirror is not None) == (4, True)


def test_a_mesh_less_symmetric_than_its_outline_says_so(tmp_path: Path) -> None:
    text = grid_obj(37, 37).replace("v 18 -18 0", "v 18.4 -18.4 0")
    (tmp_path / "grid.obj").write_text(text)
    with pytest.raises(ValueError, match=r"symmetry: .* vertices miss each other"):
        load_planar_object(save(tmp_path, mesh="grid.obj", symmetry="turns"))
    assert load_planar_object(save(tmp_path, mesh="grid.obj", symmetry=[])).group.order == 1


def test_symmetric_points_lie_where_the_turn_moves_them(tmp_path: Path) -> None:
    planar = load_planar_object(save(tmp_path, outline=TOWEL, symmetry="turns"))
    np.testing.assert_allclose(planar.rest[planar.group.permutations[1]], planar.rest * (-1, -1, 1), atol=1e-6)


@pytest.mark.parametrize("name", ["towel", "tshirt"])
def test_the_shipped_objects_are_well_meshed(name: str) -> None:
    planar = load_planar_object(OBJECTS / f"{name}.json")
    outline = json.loads((OBJECTS / f"{name}.json").read_text())["outline"]
    assert measure_area(planar) == pytest.approx(measure_ring(outline), rel=0.01)
    assert np.ptp(planar.rest, axis=0).max() == pytest.approx(1.0, abs=1e-6)
    edges = np.linalg.norm(planar.rest[planar.faces[:, 0]] - planar.rest[planar.faces[:, 1]], axis=1)
    assert edges.min() > 0.5 * SPACING
    assert edges.max() < 2.5 * SPACING
    assert planar.group.order == 2


def test_mirrored_points_of_a_tshirt_are_its_other_side() -> None:
    planar = load_planar_object(OBJECTS / "tshirt.json")
    np.testing.assert_allclose(planar.rest[planar.mirror], planar.rest * (-1, 1, 1), atol=1e-6)


def test_a_shape_without_a_mirror_image_has_none(tmp_path: Path) -> None:
    outline = [[0, 0], [90, 0], [90, 30], [60, 30], [60, 60], [0, 60]]
    assert load_planar_object(save(tmp_path, outline=outline, symmetry="turns")).mirror is None


def test_mesh_file_with_permutations(tmp_path: Path) -> None:
    (tmp_path / "grid.obj").write_text(grid_obj(20, 37))
    points = np.arange(740).reshape(20, 37)
    rows = [points.ravel().tolist(), points[::-1, ::-1].ravel().tolist()]
    given = load_planar_object(save(tmp_path, mesh="grid.obj", symmetry={"permutations": rows}))
    found = load_planar_object(save(tmp_path, mesh="grid.obj", symmetry="turns"))
    assert len(given.rest) == 740
    assert given.faces.shape == (2 * 19 * 36, 3)
    np.testing.assert_array_equal(given.group.permutations, found.group.permutations)


def test_json_gives_the_same_sheet() -> None:
    planar = load_planar_object(OBJECTS / "tshirt.json")
    again = PlanarObject.from_dict(json.loads(json.dumps(planar.to_dict())))
    np.testing.assert_array_equal(again.rest, planar.rest)
    np.testing.assert_array_equal(again.group.permutations, planar.group.permutations)
    assert (again.name, again.size, again.either_face) == (planar.name, planar.size, planar.either_face)


def test_turning_over_about_an_axis_leaves_the_axis() -> None:
    axis = np.array([np.cos(0.3), np.sin(0.3), 0])
    np.testing.assert_allclose(turn_over(np.degrees(0.3)) @ axis, axis)
    np.testing.assert_allclose(turn(90) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"outline": TOWEL}, "symmetry"),
        ({"symmetry": "turns"}, "outline or mesh"),
        ({"outline": TOWEL, "symmetry": "turns", "colour": 1}, "colour"),
        ({"outline": TOWEL, "symmetry": "turn"}, "'turns and faces'"),
        ({"outline": TOWEL, "symmetry": [{"turn_deg": 90}]}, "misses itself"),
        ({"outline": TOWEL, "symmetry": [{"turn": 90}]}, "turn_deg"),
        ({"outline": TOWEL, "symmetry": [{"turn_deg": 1}]}, "at most 24"),
        ({"outline": [[0, 0], [1, 1]], "symmetry": "turns"}, "3 or more corners"),
        ({"outline": [[0, 0], [1, 1], [2, 2]], "symmetry": "turns"}, "enclose an area"),
        ({"outline": TOWEL, "symmetry": "turns", "image_size": [485]}, "image_size"),
        ({"mesh": "none.obj", "symmetry": "turns"}, "mesh: .*does not exist"),
        ({"outline": "x", "symmetry": "turns"}, "outline must be a list"),
        ({"outline": [["0", "0"], [1, 0], [1, 1]], "symmetry": "turns"}, "outline: each corner must be .*corner 1"),
        ({"outline": [[0, 0], [1, 0], [1, True]], "symmetry": "turns"}, "finite numbers, got .1, True. as corner 3"),
        ({"outline": [*TOWEL, [float("nan"), 1]], "symmetry": "turns"}, "finite numbers, got .nan, 1. as corner 5"),
        ({"outline": [*TOWEL, [10**400, 1]], "symmetry": "turns"}, "finite numbers"),
        ({"outline": [TOWEL] * 3, "symmetry": "turns"}, "holes are not accepted"),
        ({"outline": [TOWEL], "symmetry": "turns"}, "3 or more corners .*got 1 of them"),
        ({"outline": {"type": "Polygon", "coordinates": [TOWEL]}, "symmetry": "turns"}, "outline must be a list"),
        ({"outline": [[5, 5]] * 4, "symmetry": "turns"}, "one point again and again"),
        ({"outline": [[0, 0], [90, 0], [90, 1], [0, 1]], "symmetry": "turns"}, "area of 5% .*got 1.1%"),
        ({"outline": [[k, 0] for k in range(10_001)], "symmetry": "turns"}, "10000 at most, got 10001 of them"),
        ({"outline": [[0, 0], [90, 50], [90, 0], [0, 50]], "symmetry": "turns"},
         r"cross .*from \[0, 0\] to \[90, 50\] meets the one from \[90, 0\] to \[0, 50\]"),
        ({"outline": [*TOWEL[:2], [45, 25], *TOWEL[2:], [45, 25]], "symmetry": "turns"}, "cross or touch itself"),
        ({"outline": [*TOWEL[:2], [150, 0], *TOWEL[1:]], "symmetry": "turns"}, "cross or touch itself"),
        ({"outline": TOWEL, "symmetry": 7}, "symmetry must be .*got 7"),
        ({"outline": TOWEL, "symmetry": [{"turn_deg": "90"}]}, "symmetry: an entry must be"),
        ({"outline": TOWEL, "symmetry": [{"turn_deg": float("inf")}]}, "symmetry: an entry must be"),
        ({"outline": TOWEL, "symmetry": [["a"] * 16]}, "symmetry: an entry must be"),
        ({"outline": TOWEL, "symmetry": {"permutations": [[0]]}}, "permutations of a mesh's vertices"),
        ({"mesh": "grid.obj", "symmetry": {"permutations": 5}}, "permutations must be 1 to 24 lists"),
        ({"mesh": "grid.obj", "symmetry": {"permutations": []}}, "permutations must be 1 to 24 lists"),
        ({"mesh": "grid.obj", "symmetry": {"permutations": [[0, 1], [1]]}}, "all of one length"),
        ({"mesh": "grid.obj", "symmetry": {"permutations": [[0, "a"]]}}, "permutations must be integers"),
        ({"mesh": "grid.obj", "symmetry": {"permutations": [[1, 0], [0, 1]]}}, "rows of 740"),
        ({"mesh": "grid.obj", "symmetry": {"permutations": [[0]] * 25}}, "1 to 24 lists"),
        ({"outline": TOWEL, "symmetry": "turns", "image_size": "a"}, "image_size must be two integers .*got 'a'"),
        ({"outline": TOWEL, "symmetry": "turns", "image_size": [485.0, 485]}, "image_size"),
        ({"outline": TOWEL, "symmetry": "turns", "up": "y"}, "up must be one of z, y, beside mesh"),
        ({"mesh": "grid.obj", "symmetry": "turns", "up": "x"}, "up must be one of z, y.*got 'x'"),
        ({"mesh": 5, "symmetry": "turns"}, "mesh must be the name of an OBJ file beside this one.*got 5"),
        ({"mesh": "../grid.obj", "symmetry": "turns"}, "mesh must be the name .*no absolute path"),
        ({"mesh": "a/../../grid.obj", "symmetry": "turns"}, "mesh must be the name"),
        ({"mesh": "/etc/passwd", "symmetry": "turns"}, "mesh must be the name"),
        ({"mesh": "C:\\grid.obj", "symmetry": "turns"}, "mesh must be the name"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_named_with_what_is_accepted(tmp_path: Path, values: dict, message: str) -> None:
    (tmp_path / "grid.obj").write_text(grid_obj(20, 37))
    with pytest.raises(ValueError, match=message) as error:
        load_planar_object(save(tmp_path, **values))
    assert "thing.json" in str(error.value)


@pytest.mark.parametrize("text", ["[[0, 0], [1, 0], [1, 1]]", "5", "null", '"turns"', "{", "", "\x00"])
def test_a_file_that_is_no_json_object_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "thing.json").write_text(text)
    with pytest.raises(ValueError, match=r"thing\.json"):
        load_planar_object(tmp_path / "thing.json")


def test_a_byte_order_mark_and_a_mesh_in_a_folder_are_read(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "grid.obj").write_text(grid_obj(20, 37))
    path = save(tmp_path, mesh="meshes/grid.obj", symmetry="turns")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_planar_object(path).group.order == 2


@pytest.mark.parametrize(("name", "meant"), [("colth", "cloth"), ("ropes", "rope"), ("dishclth", "dishcloth")])
def test_the_nearest_name_is_given_where_an_objects_file_is_missing(tmp_path: Path, name: str, meant: str) -> None:
    (tmp_path / "dishcloth.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=rf"{name}\.json .*did you mean '{meant}'.*cloth, dishcloth, rope"):
        load_planar_object(tmp_path / f"{name}.json")


def test_shipped_objects_are_what_stored_data_sets_were_rendered_from() -> None:
    for name, digest in {"towel": "128b41a3", "tshirt": "42f8b5e5"}.items():
        described = json.dumps(load_planar_object(OBJECTS / f"{name}.json").to_dict())
        assert hashlib.sha256(described.encode()).hexdigest().startswith(digest)
