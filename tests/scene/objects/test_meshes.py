"""Mesh files as programs write them, and those that are refused before anything is simulated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_planar_object import grid_obj

from mmgsd.scene.objects import meshes
from mmgsd.scene.objects.meshes import read_obj

GRID = grid_obj(20, 37)
VERTICES = [line for line in GRID.splitlines() if line[0] == "v"]
FACES = [line for line in GRID.splitlines() if line[0] == "f"]


def stand_up(text: str) -> str:
    """As Blender's exporter writes a flat sheet: x, z, -y."""
    lines = [line.split() for line in text.splitlines()]
    return "\n".join(f"v {w[1]} {w[3]} {-float(w[2])}" if w[0] == "v" else " ".join(w) for w in lines)


def count_back(text: str) -> str:
    """Indices as negative ones."""
    lines = (line.replace("//1", "").split() for line in text.splitlines())
    return "\n".join(" ".join(["f", *(str(int(c) - 741) for c in w[1:])] if w[0] == "f" else w) for w in lines)


SPELLINGS = {
    "comments behind values": GRID.replace("//1\n", "//1 # quad\\\n").replace(" 0\n", " 0 # corner\n"),
    "continued lines": "\n".join(line.replace(" ", " \\\n ", 1) for line in GRID.splitlines()),
    "names in Latin-1": "o Geschirrt\xfccher\x85v 1 2\n" + GRID,
    "carriage returns": GRID.replace("\n", "\r\n"),
    "continued with carriage returns": GRID.replace(" 0\n", " \\\n0\n").replace("\n", "\r\n"),
    "colours": GRID.replace(" 0\n", " 0 0.5 0.25 1\n"),
    "negative indices": count_back(GRID),
    "textures and normals": "vt 0 0\nvn 0 0 1\n" + GRID.replace("//1", "/1/1") + "\ns off\nl 1 2",
}


@pytest.mark.parametrize("text", SPELLINGS.values(), ids=SPELLINGS)
def test_every_spelling_of_a_mesh_gives_the_same(tmp_path: Path, text: str) -> None:
    (tmp_path / "plain.obj").write_text(GRID)
    (tmp_path / "other.obj").write_bytes(text.encode("latin-1"))
    for found, expected in zip(read_obj(tmp_path / "other.obj"), read_obj(tmp_path / "plain.obj"), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_byte_order_mark_does_not_hide_the_first_vertex(tmp_path: Path) -> None:
    (tmp_path / "grid.obj").write_bytes(b"\xef\xbb\xbf" + "\n".join([*VERTICES, *FACES]).encode())
    assert len(read_obj(tmp_path / "grid.obj")[0]) == 740


def test_a_polygon_is_cut_into_triangles(tmp_path: Path) -> None:
    first, second = FACES[0].split(), FACES[1].split()  # neighbours: 38 39 2 1 and 39 40 3 2
    hexagon = " ".join(["f", first[1], first[2], second[2], second[3], second[4], first[4]])
    (tmp_path / "grid.obj").write_text("\n".join([*VERTICES, *FACES[2:], hexagon]))
    with pytest.raises(ValueError, match="without an area"):  # three of its corners lie on one line
        read_obj(tmp_path / "grid.obj")
    bent = [line.replace("v 1 0 0", "v 1 0.3 0") for line in VERTICES]
    bent = [line.replace("v 1 -1 0", "v 1 -1.3 0") for line in bent]
    (tmp_path / "grid.obj").write_text("\n".join([*bent, *FACES[2:], hexagon]))
    assert len(read_obj(tmp_path / "grid.obj")[1]) == 2 * len(FACES)


def test_a_mesh_whose_y_axis_points_up_lies_as_it_did(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text(GRID)
    (tmp_path / "upright.obj").write_text(stand_up(GRID))
    expected, found = read_obj(tmp_path / "flat.obj"), read_obj(tmp_path / "upright.obj", up="y")
    np.testing.assert_allclose(found[0], expected[0], atol=1e-12)
    np.testing.assert_array_equal(found[1], expected[1])


def change(line: str, other: str) -> str:
    assert GRID.count(f"\n{line}\n") == 1
    return GRID.replace(f"\n{line}\n", f"\n{other}\n")


REFUSED = {
    "stands upright": (stand_up(GRID), 'must lie flat.*write "up": "y"'),
    "lies in no plane": (GRID.replace("v 0 0 0", "v 0 0 30"), "must lie flat.*lay it flat"),
    "a face repeats a vertex": (change(FACES[5], "f 3 4 4"), "'f 3 4 4' must hold different vertices"),
    "a face of two vertices": (change(FACES[5], "f 3 4"), "three or more vertices"),
    "a missing vertex": (change(FACES[5], "f 3 4 741"), "has 740 vertices, and faces that refer to vertex 741"),
    "a missing vertex, counted back": (change(FACES[5], "f 3 4 -741"), "three or more vertices"),
    "vertex 0": (change(FACES[5], "f 0 3 4"), "three or more vertices"),
    "a face of words": (change(FACES[5], "f a b c"), "'f a b c' must hold the numbers"),
    "a vertex of words": (change(VERTICES[5], "v 1 x 0"), "'v 1 x 0' must hold three finite numbers"),
    "a flat vertex": (change(VERTICES[5], "v 5 0"), "'v 5 0' must hold three"),
    "a vertex nowhere": (change(VERTICES[5], "v nan 0 0"), "three finite numbers"),
    "a vertex in no face": (GRID + "\nv 1 1 0", "1 vertices that belong to no face, like vertex 741"),
    "one place": ("\n".join(["v 1 1 0"] * 3 + ["f 1 2 3"]), "all its vertices in one place"),
    "no faces": ("\n".join(VERTICES), "vertices and faces, got 740 and 0"),
    "another format": ("solid ascii\nfacet normal 0 0 1\nendsolid", "Wavefront OBJ file"),
    "nothing": ("", "Wavefront OBJ file"),
    "an edge of three faces": (change(FACES[0], FACES[0] + "\nf 2 38 400"), "faces share|look one way"),
    "a face twice": (GRID + "\n" + FACES[100] + "\n" + FACES[100], r"that \d faces share"),
    "two pieces": ("\n".join([*VERTICES, *(f for i, f in enumerate(FACES) if i // 36 != 9)]), "in one piece, got 2"),
    "two layers": (GRID + "\n" + "\n".join("f " + " ".join(f.split()[:0:-1]) for f in FACES), "must have one layer"),
    "one normal down": (change(FACES[5], "f " + " ".join(FACES[5].split()[:0:-1])), "2 down"),
    "too coarse": (grid_obj(5, 9), "remesh"),
    "too many vertices": (grid_obj(101, 101), "at most 10000 vertices"),
}


@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_flat_sheet_is_refused_with_the_reason(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "wrong.obj").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_obj(tmp_path / "wrong.obj")
    assert f"mesh: {tmp_path / 'wrong.obj'}" in str(error.value)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "read_bytes", None)
    with open(tmp_path / "huge.obj", "wb") as file:
        file.truncate(meshes.MAX_BYTES + 1)
    with pytest.raises(ValueError, match=f"at most {meshes.MAX_BYTES} bytes and {meshes.MAX_VERTICES} vertices"):
        read_obj(tmp_path / "huge.obj")
