"""What explains an error, by hand, and the figures drawn from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.match import Match
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_shipped
from mmgsd.studies.errors import (
    describe_queries,
    find_model,
    list_models,
    plot_error_analysis,
    plot_worst_queries,
    summarise_entropy,
    summarise_states,
)


def test_a_model_that_was_not_trained_here_is_the_shipped_one(tmp_path: Path) -> None:
    model = list_models("paper", "mmgsd", ["rope"])["rope"]
    paths = Paths(tmp_path, "paper")
    assert find_model(paths, model) == find_shipped() / "rope-paper.safetensors"
    other = dataclasses.replace(model, seed=7)
    assert find_model(paths, other) == paths.model(other) / WEIGHTS  # there is none
    (paths.model(model) / WEIGHTS).parent.mkdir(parents=True)
    (paths.model(model) / WEIGHTS).touch()
    assert find_model(paths, model) == paths.model(model) / WEIGHTS


@pytest.fixture
def data(tiny_dataset: Callable[..., Path], request: pytest.FixtureRequest) -> Dataset:
    data = load_dataset(tiny_dataset(object=getattr(request, "param", "cloth")), "test")
    data.labels["state"] = [f"state {i % 2}" for i in range(len(data))]
    data.visible[:] = True
    return data


def make_queries(points: list[int]) -> pd.DataFrame:
    table = pd.DataFrame({"point": points, "pair": range(len(points)), "image0": 0, "image1": 1, "visible": True})
    return table.assign(rmse_px=np.arange(len(points)) * 10.0, hidden=0)


@pytest.mark.parametrize(("data", "hidden", "points", "border", "covered"), [
    ("cloth", 12 * 25 + 14, [0, 30, 312], [0, 1, 12], [14, 11, 2]),  # two points right of the centre
    ("rope", 100, [0, 90, 624], [0, 90, 0], [100, 10, 524]),
], indirect=["data"])  # fmt: skip
def test_distances_by_hand(
    data: Dataset, hidden: int, points: list[int], border: list[int], covered: list[int]
) -> None:
    data.visible[0, hidden] = False
    described = describe_queries(make_queries(points), data)
    assert described.border.tolist() == border and described.covered.tolist() == covered
    assert set(described.state0) == {"state 0"} and set(described.state1) == {"state 1"}


def test_hidden_sources_are_left_out(data: Dataset) -> None:
    queries = make_queries([0, 1])
    queries.loc[1, "visible"] = False
    assert describe_queries(queries, data).point.tolist() == [0]


def test_states_are_averaged() -> None:
    table = pd.DataFrame({"state0": ["a", "a", "b"], "state1": ["b", "b", "b"], "rmse_px": [1.0, 3.0, 7.0]})
    assert summarise_states(table)["b"].to_dict() == {"a": 2.0, "b": 7.0}


def test_entropy_is_told_by_what_is_hidden_and_by_state() -> None:
    table = pd.DataFrame({"hidden": [0, 0, 2], "state1": ["straight", "overhand knot", "overhand knot"],
                          "entropy": [8.0, 9.0, 11.0]})  # fmt: skip
    assert summarise_entropy(table) == {"seen": 8.5, "hidden": 11.0, "overhand knot": 10.0, "straight": 8.0}


def test_figures_show_every_object_and_query(data: Dataset) -> None:
    described = describe_queries(make_queries([0, 30, 312, 400]), data)
    figure = plot_error_analysis({"cloth": described})
    assert len(figure.axes) == 5
    bars = [bar.get_height() for bar in figure.axes[1].patches]
    assert bars == [15.0]  # nothing hidden: one bin, the mean of 0, 10, 20 and 30
    assert [text.get_text() for text in figure.axes[0].texts] == ["(15)"]  # of one pair


def test_states_of_enough_pairs_have_no_brackets_and_absent_ones_no_number(data: Dataset) -> None:
    described = pd.concat([describe_queries(make_queries([0]), data).assign(pair=k) for k in range(6)])
    described["state0"], described["state1"] = list("aaaaab"), list("aaaaaa")
    described.loc[described.state0 == "b", "state1"] = "b"
    texts = plot_error_analysis({"cloth": described}).axes[0].texts
    assert [text.get_text() for text in texts] == ["0", "(0)"]


class Told:
    """Stands for a matcher: what it was asked, and one mode for each match."""

    def __init__(self) -> None:
        self.asked: list[tuple[np.ndarray, int]] = []

    def match(self, image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, *, n: int) -> Match:
        self.asked.append((xy, n))
        round_modes = np.tile(9 * np.eye(2), (1, n, 1, 1))
        return Match(image0, image1, xy, np.full((1, n, 2), 50.0), np.ones((1, n)) / n, round_modes, np.zeros(1),
                     np.zeros(1), np.ones((1, 8, 8)) / 64)  # fmt: skip


def test_the_worst_queries_are_asked_anew(data: Dataset) -> None:
    queries = make_queries([7, 0, 30, 312]).assign(n=[4, 4, 4, 1], pair=[0, 1, 2, 2])  # one query a pair
    described, matcher = describe_queries(queries, data), Told()
    figure = plot_worst_queries(described, data, matcher, count=2)
    assert [axis.get_title() for axis in figure.axes] == ["30 px", "10 px"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["asked pixel", "mode", "true match"]
    assert [n for _, n in matcher.asked] == [1, 4]
    np.testing.assert_array_equal(matcher.asked[0][0], data.xy[0, [312]])
