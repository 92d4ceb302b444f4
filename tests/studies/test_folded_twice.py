"""Cloths folded twice: which answers count as right, how views are laid onto each other, and the whole way once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from mmgsd.files import read_json
from mmgsd.fold.jobs import look_job, run_jobs, start_job
from mmgsd.fold.state import State, read_state
from mmgsd.fold.tasks import TASKS
from mmgsd.paths import Paths
from mmgsd.studies import folded_twice
from mmgsd.studies.folded_twice import (
    LABELS,
    Folded,
    describe_folded,
    find_last,
    lay_onto,
    make_folded_sentence,
    rectify,
    score,
    score_choice,
    score_open,
    transpose,
)
from mmgsd.studies.table import to_markdown

MEMBERS = np.array([[0, 1, 2], [2, 1, 0]])
TRUE = np.array([(0.0, 0.0), (100.0, 0.0), (200.0, 0.0)])


def test_the_other_order_of_folds_takes_the_same_corner_to_the_same_corner() -> None:
    other = transpose(TASKS["twice"])
    assert transpose(other) == TASKS["twice"] != other
    first, last = TASKS["twice"].looks[0][0], TASKS["twice"].looks[-1][0]
    assert other.looks[0][0].pick == first.pick and other.looks[0][0].place == pytest.approx((0.458, 0.458), abs=1e-3)
    assert other.looks[-1][0].pick == last.pick and other.looks[-1][0].place == pytest.approx(last.place)


def test_a_question_is_right_under_one_member_and_not_under_two() -> None:
    true = TRUE[MEMBERS]
    assert score(TRUE[None], true) == {"right": 1.0, "error": 0.0} == score(TRUE[None, ::-1], true)
    assert score(TRUE[None, [2, 1, 2]], true)["right"] == 0.0  # one end taken twice
    assert score(TRUE[None] + (0, 12), true) == {"right": 1.0, "error": 12.0}
    assert score(TRUE[None] + (0, 25), true) == {"right": 0.0, "error": 25.0}


def test_the_best_choice_takes_modes_of_one_member() -> None:
    true = TRUE[MEMBERS]
    modes = np.stack([TRUE[[2, 1, 2]] + (0, 5), TRUE[[0, 1, 0]] + (0, 5)], axis=1)
    assert score_choice(modes, true) == {"right": 1.0, "error": 5.0}


def test_a_track_ends_where_its_point_is_known_last() -> None:
    xy = np.stack([TRUE, TRUE + 1, TRUE + 2])
    xy[1:, 0] = np.nan
    xy[2, 1] = np.nan
    assert find_last(xy).tolist() == [[0, 0], [101, 1], [202, 2]]


def test_of_ways_that_are_as_likely_one_is_answered() -> None:
    points = np.arange(3)
    assert score_open([TRUE], MEMBERS, points) == {"right": 1.0, "error": 0.0}
    assert score_open([TRUE, TRUE + (0, 50)], MEMBERS, points) == {"right": 0.5, "error": 25.0}
    middle = score_open([TRUE, TRUE + (0, 50), TRUE - (0, 50)], MEMBERS, points)
    assert middle["error"] == pytest.approx(100 / 3)  # the one between the others


@pytest.fixture(scope="module")
def looks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, State]:
    """A flat cloth, and again from above and from aside."""
    pytest.importorskip("bpy")
    folder, how = tmp_path_factory.mktemp("looks"), {"workers": 1, "progress": False}
    (file,) = run_jobs({"flat": start_job(TASKS["twice"], "flat", "plain", 0)}, folder, **how).values()
    jobs = {"above": look_job(file, 1), "aside": look_job(file, 2, tilt_deg=folded_twice.TILT_DEG)}
    return {name: read_state(path) for name, path in {"flat": file, **run_jobs(jobs, folder, **how)}.items()}


@pytest.mark.parametrize("name", ["above", "aside"])
def test_a_view_laid_onto_another_shows_the_cloth_where_it_lies(looks: dict[str, State], name: str) -> None:
    flat, view = looks["flat"], looks[name]
    height = view.camera_pose[2, 3] / np.linalg.norm(view.camera_pose[:3, 3] - view.points.mean(0))
    assert height < 0.7 if name == "aside" else height > 0.9  # the cosine of the tilt
    shown = dataclasses.replace(view, image=np.repeat(255 * view.mask[..., None].astype(np.uint8), 3, axis=-1))
    laid = rectify(shown, flat)[..., 0] > 127
    assert (laid & flat.mask).sum() / (laid | flat.mask).sum() > 0.95


def test_an_outline_is_shifted_onto_another(looks: dict[str, State]) -> None:
    flat = looks["flat"]
    moved = dataclasses.replace(flat, mask=np.roll(flat.mask, (3, -5), (0, 1)), xy=flat.xy + np.float32((-5, 3)))
    xy, mask = lay_onto(moved, flat)
    assert np.allclose(xy, flat.xy, atol=0.1) and (mask == flat.mask).mean() > 0.99


def test_a_cloth_that_nobody_folded_is_found_again(
    looks: dict[str, State], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flat = looks["flat"]
    film = dataclasses.replace(flat, image=flat.image[None].repeat(2, 0))
    views = {name: looks[name] for name in ("above", "aside")}
    cloth = Folded(flat, flat, flat, (film, film), views, flat)
    monkeypatch.setattr(folded_twice, "make_folded", lambda *_: {0: cloth})
    results = read_json(folded_twice.run(Paths(tmp_path, "smoke"), progress=False))
    assert results["run"]["cloths"] == 1 and results["run"]["spoilt"] == 0 and results["run"]["hardware"]
    assert all(results[name]["right"]["mean"] == 1 for name in ("once", "one", "possible", "film", "orders"))
    assert results["orders"]["distance_px"]["mean"] == 0 and results["orders"]["overlap"]["mean"] == 1
    assert results["outline"]["ways"]["mean"] == 1  # a flat cloth's turns and mirror images are symmetries
    assert len(to_markdown(describe_folded(results)).splitlines()) == 2 + len(LABELS)
    assert make_folded_sentence(results).startswith("1 cloths. Two orders")


def test_spoilt_cloths_alone_are_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folded_twice, "make_folded", lambda *_: {})
    with pytest.raises(ValueError, match="cloths must"):
        folded_twice.run(Paths(tmp_path, "smoke"), progress=False)
    assert not list(tmp_path.rglob("*.json"))


def test_only_presets_with_a_number_of_cloths_are_folded(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="preset"):
        folded_twice.run(Paths(tmp_path, "workspace"))
