"""Photographs with marked places: what counts as found by hand, every format, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from mmgsd.figures.photographs import ContactSheet
from mmgsd.files import DamagedFileError
from mmgsd.match.match import Match
from mmgsd.measure import photographs
from mmgsd.measure.photographs import (
    ask_photographs,
    describe_marks,
    digest_marks,
    make_photographs_table,
    measure_photographs,
    read_photographs,
    score_answer,
    store_photographs,
    summarise_photographs,
    write_sample_marks,
)

ROOT = Path(__file__).parents[2]
SQUARE = np.array([[20, 20], [120, 20], [120, 120], [20, 120]])
SIZE = (160, 140)


def answer_with(modes: np.ndarray, size: tuple[int, int] = SIZE, queries: int = 1) -> Match:
    """Every query's answer: these modes (n, 2), the first the narrowest."""
    image, n = np.zeros((*size[::-1], 3), np.uint8), len(modes)
    covariances = np.eye(2) * np.arange(1, n + 1)[:, None, None]
    arrays = (modes, np.full(n, 1 / n), covariances, np.array(5.0), np.array(0.0), np.full((4, 4), 1 / 16))
    stacked = [np.stack([array] * queries) for array in arrays]
    return Match(image, image, np.zeros((queries, 2), np.float32), *stacked)


class Knowing:
    """A matcher that always answers with the same modes; it counts what it is asked."""

    def __init__(self, modes: np.ndarray) -> None:
        self.modes, self.asked = modes, []

    def match_many(self, questions: Any) -> Iterator[Match]:
        for image0, image1, xy in questions:
            self.asked.append((image0, image1, xy))
            yield answer_with(self.modes, image1.shape[1::-1], len(xy))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Six drawn squares: five flat ones, and one of which a corner is hidden."""
    entries = []
    for k in range(6):
        image = np.zeros((*SIZE[::-1], 3), np.uint8)
        cv2.fillConvexPoly(image, SQUARE.astype(np.int32), (200, 20 * k, 90))
        Image.fromarray(image).save(tmp_path / f"{k}.png")
        corners = [*SQUARE.tolist()[:3], None if k == 5 else SQUARE[3].tolist()]
        repo = {"repo": "some/where"} if k < 3 else {}
        entries.append({"file": f"{k}.png", "kind": "cloth", "corners": corners, **repo})
    write_index(tmp_path, entries)
    return tmp_path


def write_index(folder: Path, entries: Any) -> None:
    (folder / "index.json").write_text(json.dumps(entries))


def read_one(folder: Path, kind: str = "cloth", **entry: Any) -> photographs.Photograph:
    """What is read of one entry, beside another that can be asked about."""
    write_index(folder, [{"file": "0.png", "kind": kind} | entry, {"file": "1.png", "marks": [[1, 2]]}])
    return read_photographs(folder, kind)[0]


def test_folders_are_divided_as_anywhere(folder: Path) -> None:
    (folder / "imgs" / "new").mkdir(parents=True)
    (folder / "0.png").rename(folder / "imgs" / "new" / "a.png")
    for name in ("imgs/new/a.png", "imgs\\new\\a.png", ".\\imgs/new\\a.png"):
        assert read_one(folder, file=name, corners=SQUARE.tolist()).read().shape == (*SIZE[::-1], 3)
    (folder / "b\\c.png").write_bytes((folder / "1.png").read_bytes())  # a legal name where / divides
    assert read_one(folder, file="b\\c.png", corners=SQUARE.tolist()).read().shape == (*SIZE[::-1], 3)


def test_what_is_found_by_hand(folder: Path) -> None:
    (flat, *_) = read_photographs(folder, "cloth")  # of 100 px
    modes = np.array([[24.0, 20.0], [120.0, 28.0], [120.0, 135.0], [np.nan, np.nan], [20.0, 121.0]])
    (row,) = score_answer(answer_with(modes), flat).to_dict("records")
    assert row == {
        "from": "some/where",
        "file": str(flat.path),
        "found@5%": 2 / 4,  # 4, 8, 15 and 1 px from the corners
        "found@10%": 3 / 4,
        "spurious": 1 / 4,  # of the four first that are there
        "best": pytest.approx(4.0),
    }


def test_only_so_many_modes_can_be_spurious_as_places_are_seen(folder: Path) -> None:
    hidden = read_photographs(folder, "cloth")[-1]  # three corners of an unknown size: half of 160 px
    modes = np.array([[20.0, 20.0], [80.0, 70.0], [120.0, 24.1], [0.0, 0.0]])
    (row,) = score_answer(answer_with(modes), hidden).to_dict("records")
    assert (row["found@5%"], row["found@10%"], row["spurious"]) == (1 / 3, 2 / 3, 1 / 3)


def test_an_answer_that_abstains_counts_as_unanswered_and_not_in_best(folder: Path) -> None:
    (flat, *_) = read_photographs(folder, "cloth")
    answer, silent = answer_with(SQUARE.astype(float)), answer_with(SQUARE.astype(float))
    object.__setattr__(silent, "on_object", np.array([0.1]))
    rows = pd.concat([score_answer(a, flat) for a in (answer, silent)])
    summary = summarise_photographs(rows)
    assert (summary["queries"], summary["unanswered"], summary["best"]) == (2, 0.5, 0.0)
    assert summarise_photographs(score_answer(silent, flat))["best"] is None


def test_intervals_are_over_photographs_with_all_their_queries() -> None:
    rows = pd.DataFrame({"from": "a", "file": ["1"] * 90 + ["2"] * 10, "found@5%": [1.0] * 90 + [0.0] * 10})
    rows = rows.assign(**{"found@10%": 1.0, "spurious": 0.0, "best": np.nan})
    intervals = summarise_photographs(rows)["intervals"]
    assert intervals["found@5%"] == [0, 1]  # two photographs, whatever their hundred queries say
    assert intervals["found@10%"] == [1, 1] and intervals["best"] is None


def test_other_marks_are_told_from_these(folder: Path) -> None:
    before = digest_marks(read_photographs(folder, "cloth"))
    entries = json.loads((folder / "index.json").read_text())
    write_index(folder, [{**entry, "note": "more"} for entry in entries])
    assert digest_marks(read_photographs(folder, "cloth")) == before
    entries[0]["corners"][0] = [21, 20]
    write_index(folder, entries)
    assert digest_marks(read_photographs(folder, "cloth")) != before


def test_flat_cloths_are_asked_about_in_every_other_photograph(folder: Path) -> None:
    cloths, matcher = read_photographs(folder, "cloth"), Knowing(SQUARE.astype(float))
    answered = list(ask_photographs(matcher, cloths, progress=False))
    assert len(answered) == 4 * 5  # four of the five flat ones
    asked = [image0[70, 70, 1] // 20 for image0, _, _ in matcher.asked]
    targets = [image1[70, 70, 1] // 20 for _, image1, _ in matcher.asked]
    assert set(asked) == {0, 1, 3, 4} and all(a != b for a, b in zip(asked, targets, strict=True))
    assert targets == sorted(targets)  # each is read and described once
    rows = pd.concat([score_answer(answer, target) for target, answer in answered])
    summary = summarise_photographs(rows)
    assert (summary["queries"], summary["found@5%"], summary["spurious"], summary["best"]) == (80, 1, 0, 0)
    assert summary["sources"].keys() == {"some/where", "own"}
    assert sum(part["queries"] for part in summary["sources"].values()) == 80
    *_, every, named, interval, _ = make_photographs_table(summary | {"by_name": summary}).splitlines()
    assert every.split() == ["all", "80", *["1.000"] * 2, *["0.000"] * 3] and named.split()[:3] == ["by", "name", "80"]
    assert interval == "95 % intervals, all: found@5% 1.00 to 1.00, spurious 0.00 to 0.00"


@pytest.mark.parametrize(
    ("entry", "places", "askable", "px"),
    [
        ({"corners": SQUARE.tolist()}, 4, True, 100),
        ({"corners": [None, [1, 2], [3, 4], None]}, 2, False, 80),
        ({"corners": [None] * 4, "visible_corner_stickers": [[1, 2]]}, 1, False, 0.65 * 160),
        ({"corners": SQUARE.tolist(), "visible_corner_stickers": [[1, 2]]}, 4, True, 100),
        ({"visible_corners_unordered": [[1, 2], [3, 4]]}, 2, False, 80),
        ({"visible_corners_unordered": [[1, 2], [3, 4]], "stickers": [[5, 6]]}, 2, False, 0.65 * 160),
        ({"ends": [[1, 2], [3, 4]]}, 2, True, 80),
        ({"marks": [[1, 2]], "size_px": 33}, 1, True, 33),
    ],
)
def test_places_and_sizes(folder: Path, entry: dict, places: int, askable: bool, px: float) -> None:
    read = read_one(folder, **entry)
    assert (len(read.xy), read.askable) == (places, askable)
    modes = np.array([read.xy[0] + [0.5 * px, 0]])  # half its size away
    assert score_answer(answer_with(modes), read).best[0] == pytest.approx(50, abs=25)
    assert (read.size_px or read.share * 160) == px


def test_what_the_explorer_saves_is_read(folder: Path) -> None:
    two = SQUARE[:2].tolist()
    for kind, pins in (("cloth", SQUARE.tolist()), ("cloth", two), ("rope", two), ("shirt", two), ("", two)):
        read = read_one(folder, **{"kind": kind or "cloth", **describe_marks("0.png", pins, kind)})
        assert read.xy.tolist() == pins and read.askable == (kind != "cloth" or len(pins) == 4)


def test_others_kinds_and_unmarked_photographs_are_left_out(folder: Path) -> None:
    entries = json.loads((folder / "index.json").read_text())
    entries += [{"file": "0.png", "kind": "rope", "ends": [[1, 1]]}, {"file": "1.png", "kind": "cloth"}]
    write_index(folder, entries)
    assert len(read_photographs(folder, "cloth")) == len(read_photographs(folder / "index.json", "cloth")) == 6


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({}, "must be a list of dictionaries"),
        ([3], "must be a list of dictionaries"),
        ([], "must mark at least two photographs of kind 'cloth'"),
        ([{"file": "0.png", "corners": [[1, 1]] * 4}], "got 1 marked"),
        ([{"file": "0.png", "visible_corners_unordered": [[1, 1]]}] * 2, "all corners of one cloth"),
        ([{"corners": [[1, 1]]}], "photograph 0: file must be a path, got None"),
        ([{"file": "0.png", "corners": [[1, 2, 3]]}], "corners must be a list of .x, y. px or null"),
        ([{"file": "0.png", "corners": "left"}], "corners must be a list of .x, y. px or null, got 'left'"),
        ([{"file": "0.png", "corners": 7}], "corners must be a list of .x, y. px or null, got 7"),
        ([{"file": "0.png", "marks": [[1, 1]], "size_px": 0}], "size_px must be a number above 0, got 0"),
    ],
)
def test_another_format_is_refused(folder: Path, entries: Any, message: str) -> None:
    write_index(folder, entries)
    with pytest.raises(ValueError, match=f"index.json.*{message}"):
        read_photographs(folder, "cloth")


def test_what_is_no_json_is_named(folder: Path) -> None:
    (folder / "index.json").write_text("[")
    with pytest.raises(DamagedFileError, match="index.json is damaged"):
        read_photographs(folder, "cloth")
    with pytest.raises(FileNotFoundError, match="give a folder with index.json"):
        read_photographs(folder / "0.png" / "there", "cloth")


def test_a_mark_outside_names_its_photograph(folder: Path) -> None:
    read = read_one(folder, corners=[[1000, 5], [1, 1], [2, 2], [3, 3]])
    with pytest.raises(ValueError, match="0.png: of its marks, xy must be finite and inside the image of 160 x 140"):
        read.read()


def test_the_samples_marks_are_those_of_its_labels(tmp_path: Path) -> None:
    sample = ROOT / "data" / "sample"
    for name in ("cloth", "rope"):
        (tmp_path / name).symlink_to(sample / name)
    assert write_sample_marks(tmp_path).read_bytes() == (sample / "photographs.json").read_bytes()
    assert {entry["repo"] for entry in json.loads((sample / "photographs.json").read_text())} == {"rendered"}


def test_the_shipped_model_is_measured_and_drawn(folder: Path) -> None:
    sheet, weights = ContactSheet(), ROOT / "data" / "weights" / "cloth.safetensors"
    results = measure_photographs(weights, folder, progress=False, seen=sheet.add)
    assert (results["weights"], results["object"], results["photographs"]) == ("cloth.safetensors", "cloth", 6)
    assert len(results["sha256"]) == 64 and results["queries"] == 80
    assert results["found@10%"] > 0.8  # flat squares on black
    figure = sheet.plot()
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert [title for title in titles if title] == [f"{k}.png" for k in range(6)]


def test_an_empty_sheet_is_not_drawn() -> None:
    with pytest.raises(ValueError, match="the sheet must not be empty"):
        ContactSheet().plot()


def test_results_are_stored_under_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photographs, "find_root", lambda: tmp_path)
    path = store_photographs({"queries": 3}, "mine")
    assert path == tmp_path / "data" / "results" / "photographs_mine.json"
    assert json.loads(path.read_text()) == {"queries": 3}
    with pytest.raises(ValueError, match="name must .*got '../x'"):
        store_photographs({}, "../x")
