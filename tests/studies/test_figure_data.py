"""What the figures are drawn from: kept, read back, and chosen by rule."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from mmgsd.dataset import load_dataset
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher
from mmgsd.measure.metrics import ErrorSummary, summarise_errors
from mmgsd.paths import find_root
from mmgsd.studies.figure_data import (
    FigureData,
    choose_contrast,
    choose_example,
    choose_plain,
    gather_figure_data,
    keep_stored,
    load_figure_data,
    save_figure_data,
)


def make_queries(errors: list[float], visible: list[bool]) -> pd.DataFrame:
    """Four pairs of images asked about the points 3 and 7."""
    pair = np.repeat(np.arange(4), 2)
    table = {"pair": pair, "image0": pair, "image1": pair + 10, "point": np.tile([3, 7], 4)}
    return pd.DataFrame({**table, "visible": visible, "hidden": 0, "rmse_px": errors})


QUERIES = make_queries([1.01, 3.0, 9.0, 9.0, 5.0, 6.0, 0.0, 8000.0], [True] * 6 + [True, False])


def answer_by_rote(self: None, image0: np.ndarray, image1: np.ndarray, xy: np.ndarray) -> Match:
    """A match whose numbers are known, in place of a network's."""
    count = len(xy)
    covariances = np.tile(np.eye(2), (count, 4, 1, 1))
    weights, nothing = np.full((count, 4), 0.25), np.zeros(count)
    return Match(image0, image1, xy, np.ones((count, 4, 2)), weights, covariances, nothing, nothing,
                 np.full((count, 5, 5), 0.04, np.float32))  # fmt: skip


def test_the_example_is_the_median_of_the_pairs_that_show_the_points() -> None:
    assert choose_example(QUERIES, [3, 7]) == (2, 12)  # means 2, 5.5 and 9; the fourth pair hides a point
    assert choose_example(QUERIES, [3]) == (2, 12)  # 0, 1.01, 5 and 9


def test_the_example_hides_no_match_where_a_pair_shows_all() -> None:
    assert choose_example(QUERIES.assign(hidden=[0, 0, 0, 0, 1, 0, 0, 0]), [3, 7]) == (1, 11)


def make_example(modes: dict[str, list[list[list[float]]]], true: list[list[list[float]]]) -> FigureData:
    """Answers of two queries each, and what is true of them."""
    answers = {}
    for method, places in modes.items():
        match = answer_by_rote(None, np.zeros((9, 9, 3), np.uint8), np.zeros((9, 9, 3), np.uint8), np.zeros((2, 2)))
        answers[method] = dataclasses.replace(match, modes=np.array(places))
    return FigureData({}, 1.0, answers, [np.array(places) for places in true])


def test_the_contrast_is_where_the_methods_errors_differ_most() -> None:
    nan = [np.nan, np.nan]
    modes = {"mmgsd": [[[0.0, 0.0], [8.0, 0.0]], [[5.0, 5.0], [6.0, 6.0]]],
             "pcl": [[[4.0, 0.0], nan], [[40.0, 5.0], nan]]}  # fmt: skip
    true = [[[0.0, 0.0], [8.0, 0.0]], [[5.0, 5.0]]]
    assert choose_contrast(make_example(modes, true)) == 1
    assert choose_contrast(make_example(modes, true[:1])) == 0  # of the other one nothing is known


def test_what_needs_no_explanation_leads_from_a_flat_cloth_to_another_state() -> None:
    data = load_dataset(find_root(Path(__file__).parent) / "data/sample/cloth", "test")
    first, second = choose_plain(data)
    states, corners = data.labels.state.tolist(), data.group().distinct_modes(0)
    assert states[first] == "flat" and states[second] != "flat"
    assert data.visible[first, corners].all() and data.visible[second, corners].all()
    hidden = dataclasses.replace(data, labels=data.labels.assign(state="flat"))
    with pytest.raises(ValueError, match="data must"):
        choose_plain(hidden)


@pytest.fixture
def gathered(cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> FigureData:
    """Figure data of two methods, one of them a model."""
    monkeypatch.setattr(Matcher, "load", lambda path: Matcher.__new__(Matcher))

    def match(*asked: Any, n: list[int]) -> Match:
        assert n == [4, 4]  # of every method, whatever it was taught
        return answer_by_rote(*asked)

    monkeypatch.setattr(Matcher, "match", match)
    queries = QUERIES.assign(image0=0, image1=2)
    tables = {"mmgsd": queries, "sift": queries.assign(rmse_px=7.3)}
    return gather_figure_data(tables, {"mmgsd": Path("any")}, load_dataset(cloth_dataset, "test"), points=[3, 7])


def test_gathering_asks_the_models_about_the_example(gathered: FigureData, cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset, "test")
    np.testing.assert_array_equal(gathered.answers["mmgsd"].xy, data.xy[0, [3, 7]])
    np.testing.assert_array_equal(gathered.true, [data.xy[2, data.group().distinct_modes(p)] for p in (3, 7)])
    assert 240 < gathered.object_size_px < 2 * 240  # of a square of 240 px, turned by any angle


def test_kept_and_read_back(gathered: FigureData, tmp_path: Path) -> None:
    back = load_figure_data(save_figure_data(gathered, tmp_path / "kept" / "cloth.safetensors"))
    assert list(back.errors) == ["mmgsd", "sift"]
    assert back.object_size_px == gathered.object_size_px
    for method, summary in back.errors.items():
        before = gathered.errors[method]
        for field in dataclasses.fields(ErrorSummary):
            np.testing.assert_array_equal(getattr(summary, field.name), getattr(before, field.name))
    before, after = gathered.answers["mmgsd"], back.answers["mmgsd"]
    np.testing.assert_array_equal(after.xy, before.xy)
    np.testing.assert_array_equal(after.cells, before.cells)
    for name in ("image0", "image1"):  # stored as JPEG
        assert np.abs(np.asarray(getattr(after, name), float) - getattr(before, name)).mean() < 6
    np.testing.assert_array_equal(back.true, gathered.true)
    old = dataclasses.replace(gathered, true=gathered.true[:1])
    assert len(load_figure_data(save_figure_data(old, tmp_path / "old.safetensors")).true) == 1


def test_stored_heatmaps_have_as_many_modes_as_there_are_matches(gathered: FigureData, tmp_path: Path) -> None:
    cells = np.zeros((2, 24, 24), np.float32)
    cells[0, [4, 4, 20, 20], [4, 20, 4, 20]] = 0.25
    cells[1, 8, 16] = 1.0
    modes = np.zeros((2, 4, 2))
    modes[1, 1:] = np.nan  # the second query has one match
    answer = dataclasses.replace(gathered.answers["mmgsd"], cells=cells, modes=modes)
    stored = dataclasses.replace(gathered, answers={"mmgsd": answer, "pcl": answer})
    back = load_figure_data(save_figure_data(stored, tmp_path / "cloth.safetensors")).answers["pcl"]
    cell = answer.image1.shape[0] / 24
    corners = (np.array([[4, 4], [4, 20], [20, 4], [20, 20]]) + 0.5) * cell - 0.5
    np.testing.assert_allclose(sorted(back.modes[0].tolist()), corners, atol=1)
    np.testing.assert_allclose(back.modes[1, 0], [16.5 * cell - 0.5, 8.5 * cell - 0.5], atol=1)
    assert np.isnan(back.modes[1, 1:]).all()


def test_answers_of_another_machine_are_kept_where_questions_are_the_same(gathered: FigureData, tmp_path: Path) -> None:
    ours, answer, path = gathered.errors["mmgsd"], gathered.answers["mmgsd"], tmp_path / "cloth.safetensors"
    assert keep_stored(gathered, path, ["pcl"]) is gathered  # nothing is there
    theirs = {name: dataclasses.replace(ours, mean_px=ours.mean_px + 1) for name in ("pcl", "mmgsd", "old")}
    stored = dataclasses.replace(gathered, errors=theirs, answers=dict.fromkeys(("pcl", "mmgsd"), answer))
    save_figure_data(stored, path)
    both = keep_stored(gathered, path, ["pcl", "mmgsd", "sift"])
    assert set(both.errors) == {"pcl", "mmgsd", "sift"} and set(both.answers) == {"pcl", "mmgsd"}
    assert both.errors["mmgsd"] is ours
    np.testing.assert_array_equal(both.errors["pcl"].mean_px, theirs["pcl"].mean_px)
    example = keep_stored(dataclasses.replace(gathered, true=[true + 1 for true in gathered.true]), path, ["pcl"])
    assert set(example.errors) == {"pcl", "mmgsd", "sift"} and set(example.answers) == {"mmgsd"}
    fewer = {method: dataclasses.replace(row, asked=row.asked - 1) for method, row in gathered.errors.items()}
    assert set(keep_stored(dataclasses.replace(gathered, errors=fewer), path, ["pcl"]).errors) == {"mmgsd", "sift"}


def test_other_queries_are_refused(gathered: FigureData, tmp_path: Path) -> None:
    gathered.errors["sift"] = summarise_errors(QUERIES.assign(point=5))
    with pytest.raises(ValueError, match=r"errors\['sift'\] must"):
        save_figure_data(gathered, tmp_path / "cloth.safetensors")


def test_a_missing_or_damaged_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="04_evaluate"):
        load_figure_data(tmp_path / "cloth.safetensors")
    (tmp_path / "cloth.safetensors").write_bytes(b"0123456789")
    with pytest.raises(ValueError, match="does not hold the data of figures"):
        load_figure_data(tmp_path / "cloth.safetensors")
