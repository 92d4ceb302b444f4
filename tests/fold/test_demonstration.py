"""Demonstrations as files: what was written is read, and what is wrong is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mmgsd.files import DamagedFileError
from mmgsd.fold.demonstration import Demonstration, Look, read_demonstration, write_demonstration


@pytest.fixture
def written(tmp_path: Path, rng: np.random.Generator) -> Path:
    image = rng.integers(0, 256, (40, 60, 3), dtype=np.uint8)
    first = Look(image, np.array([[[5.0, 6], [50, 30]], [[8, 9], [10.5, 11]]]), np.array([[20.0, 20], [30, 10]]),
                 (26, "corners", (0.5, 0.25), 0))  # fmt: skip
    second = Look(image[::-1], np.array([[[1.0, 2], [3, 4]]]), np.zeros((0, 2)))
    return write_demonstration(Demonstration("cloth", (first, second)), tmp_path / "edge.json")


def test_a_demonstration_is_read_as_it_was_written(written: Path) -> None:
    read = read_demonstration(written)
    assert read.object == "cloth" and [len(look.moves) for look in read.looks] == [2, 1]
    assert read.looks[0].moves[1].tolist() == [[8, 9], [10.5, 11]]
    assert read.looks[0].asked.tolist() == [[5, 6], [8, 9], [20, 20], [30, 10]]
    assert read.looks[0].places == (26, "corners", (0.5, 0.25), 0) and read.looks[1].places == ()
    assert read.looks[1].anchors.shape == (0, 2) and read.looks[1].image.shape == (40, 60, 3)


CASES = {
    "no object": (lambda v: v.pop("object"), "must hold an object with 'object' and 'looks'"),
    "no look": (lambda v: v.update(looks=[]), "looks a list of at least one"),
    "unknown key": (lambda v: v["looks"][0].update(colour="red"), "look 0 must hold 'image'"),
    "no moves": (lambda v: v["looks"][1].update(moves=[]), "look 1: moves must be at least one"),
    "flat moves": (lambda v: v["looks"][0].update(moves=[[1, 2], [3, 4]]), "look 0: moves must be a list of"),
    "words": (lambda v: v["looks"][0].update(anchors=["left"]), "look 0: anchors must be a list of"),
    "too few places": (lambda v: v["looks"][0].update(places=[3]), "look 0: places must be a list of 4"),
    "outside": (lambda v: v["looks"][0].update(anchors=[[100, 5], [1, 1]]), "look 0: .*edge_0.webp"),
    "one place": (lambda v: v["looks"].__setitem__(0, v["looks"][1]), "look 0: at least 2 picks and anchors"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_with_a_demonstration_is_named(written: Path, case: str) -> None:
    change, message = CASES[case]
    values = json.loads(written.read_text())
    change(values)
    written.write_text(json.dumps(values))
    with pytest.raises(DamagedFileError, match=message) as error:
        read_demonstration(written)
    assert "edge.json" in str(error.value)


def test_folders_are_divided_as_anywhere(written: Path) -> None:
    (written.parent / "looks").mkdir()
    written.with_name("edge_0.webp").rename(written.parent / "looks" / "edge_0.webp")
    written.write_text(written.read_text().replace("edge_0.webp", r"looks\\edge_0.webp"))
    assert read_demonstration(written).looks[0].image.shape == (40, 60, 3)


def test_a_missing_image_is_named(written: Path) -> None:
    written.with_name("edge_1.webp").unlink()
    with pytest.raises(FileNotFoundError, match="edge_1.webp"):
        read_demonstration(written)


def test_other_endings_are_refused(written: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="path must"):
        write_demonstration(read_demonstration(written), tmp_path / "edge.txt")
