"""Sheets of one's own: meshes, symmetries found and given, and files that say something wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mmgsd.config import find_root
from mmgsd.sheet import SPACING, Sheet, load_sheet, turn, turn_over

OBJECTS = find_root(Path(__file__).parent) / "data" / "objects"
SQUARE = [[0, 0], [60, 0], [60, 60], [0, 60]]
TOWEL = [[0, 0], [90, 0], [90, 50], [0, 50]]


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


def measure_area(sheet: Sheet) -> float:
    a, b, c = (sheet.rest[sheet.faces[:, k], :2] for k in range(3))
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
    sheet = load_sheet(save(tmp_path, outline=outline, symmetry=symmetry))
    assert sheet.group.order == order
    assert sheet.group.n_points == len(sheet.rest)
    has_faces = symmetry == "turns and faces" or "over_deg" in str(symmetry)
    assert sheet.either_face == has_faces


def test_symmetric_points_lie_where_the_turn_moves_them(tmp_path: Path) -> None:
    sheet = load_sheet(save(tmp_path, outline=TOWEL, symmetry="turns"))
    np.testing.assert_allclose(sheet.rest[sheet.group.permutations[1]], sheet.rest * (-1, -1, 1), atol=1e-6)


@pytest.mark.parametrize("name", ["towel", "tshirt"])
def test_the_shipped_objects_are_well_meshed(name: str) -> None:
    sheet = load_sheet(OBJECTS / f"{name}.json")
    outline = np.array(json.loads((OBJECTS / f"{name}.json").read_text())["outline"]) / 1.0
    x, y = (outline / np.ptp(outline, axis=0).max()).T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert measure_area(sheet) == pytest.approx(area, rel=0.01)
    assert np.ptp(sheet.rest, axis=0).max() == pytest.approx(1.0, abs=1e-6)
    edges = np.linalg.norm(sheet.rest[sheet.faces[:, 0]] - sheet.rest[sheet.faces[:, 1]], axis=1)
    assert edges.min() > 0.5 * SPACING
    assert edges.max() < 2.5 * SPACING
    assert sheet.group.order == 2


def test_mirrored_points_of_a_tshirt_are_its_other_side() -> None:
    sheet = load_sheet(OBJECTS / "tshirt.json")
    np.testing.assert_allclose(sheet.rest[sheet.mirror], sheet.rest * (-1, 1, 1), atol=1e-6)


def test_a_shape_without_a_mirror_image_has_none(tmp_path: Path) -> None:
    outline = [[0, 0], [90, 0], [90, 30], [60, 30], [60, 60], [0, 60]]
    assert load_sheet(save(tmp_path, outline=outline, symmetry="turns")).mirror is None


def test_mesh_file_with_permutations(tmp_path: Path) -> None:
    (tmp_path / "grid.obj").write_text(grid_obj(20, 37))
    points = np.arange(740).reshape(20, 37)
    rows = [points.ravel().tolist(), points[::-1, ::-1].ravel().tolist()]
    given = load_sheet(save(tmp_path, mesh="grid.obj", symmetry={"permutations": rows}))
    found = load_sheet(save(tmp_path, mesh="grid.obj", symmetry="turns"))
    assert len(given.rest) == 740
    assert given.faces.shape == (2 * 19 * 36, 3)
    np.testing.assert_array_equal(given.group.permutations, found.group.permutations)


def test_json_gives_the_same_sheet() -> None:
    sheet = load_sheet(OBJECTS / "tshirt.json")
    again = Sheet.from_dict(json.loads(json.dumps(sheet.to_dict())))
    np.testing.assert_array_equal(again.rest, sheet.rest)
    np.testing.assert_array_equal(again.group.permutations, sheet.group.permutations)
    assert (again.name, again.size, again.either_face) == (sheet.name, sheet.size, sheet.either_face)


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
        ({"mesh": "none.obj", "symmetry": "turns"}, "does not exist"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_accepted(tmp_path: Path, values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        load_sheet(save(tmp_path, **values))
    assert "thing.json" in str(error.value)


def test_a_coarse_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "grid.obj").write_text(grid_obj(5, 9))
    with pytest.raises(ValueError, match="remesh"):
        load_sheet(save(tmp_path, mesh="grid.obj", symmetry="turns"))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.json"):
        load_sheet(tmp_path / "none.json")
