"""The answer to queries: its narrowest mode, its confidence, and how some of its queries are taken."""

from __future__ import annotations

import dataclasses
import pickle
import warnings

import numpy as np
import pytest
import torch
from heatmaps import CELL_PX, CELLS, CORNERS, SIZE, draw_mixture, one_cell

from mmgsd.match.describe import describe_answer
from mmgsd.match.heatmap import make_match
from mmgsd.match.match import Match
from mmgsd.model.network import compute_cell_centres


def answer(cells: torch.Tensor, n: int | str) -> Match:
    """What a matcher with these heatmaps answers."""
    blank = np.zeros((485, 485, 3), np.uint8)
    centres = compute_cell_centres(SIZE, (CELLS, CELLS))
    return make_match(blank, blank, np.zeros((len(cells), 2), np.float32), cells, centres, n)


def test_best_is_the_narrowest_mode() -> None:
    std = np.array([30.0, 12.0, 20.0, 25.0])
    best = answer(draw_mixture(CORNERS, std), 4).best()
    np.testing.assert_allclose(best.xy, CORNERS[[1]], atol=0.5)
    np.testing.assert_allclose(best.spread_px, np.hypot(12, CELL_PX / np.sqrt(6)), rtol=0.02)


def test_best_of_as_many_as_there_are() -> None:
    best = answer(torch.cat([draw_mixture(CORNERS[:1], 12.0), draw_mixture(CORNERS[1:], 12.0)]), "auto").best()
    assert np.isfinite(best.xy).all()
    np.testing.assert_allclose(best.xy[0], CORNERS[0], atol=0.1)


def test_confidence_is_the_mass_near_a_mode() -> None:
    for std in (10.0, 20.0, 40.0):
        match = answer(draw_mixture(CORNERS[:1] + 140, std), 1)
        x, y = np.meshgrid(*(np.arange(485) - c for c in match.modes[0, 0]))
        near = match.heatmap[0][np.hypot(x, y) <= 20].sum()
        assert match.confidence(radius_px=20)[0, 0] == pytest.approx(near, abs=0.01)


def test_four_equal_modes_are_as_sure_as_one() -> None:
    one, four = (answer(draw_mixture(CORNERS[:n], 16.0), n).confidence() for n in (1, 4))
    np.testing.assert_allclose(four, np.full((1, 4), one[0, 0]), atol=0.01)


def test_a_weak_mode_is_less_sure() -> None:
    match = answer(draw_mixture(CORNERS[:2], 8.0, np.array([0.9, 0.1])), 2)
    confidence = match.confidence(radius_px=100)[0]
    np.testing.assert_allclose(confidence, [1, 0.2], atol=0.01)


def test_best_abstains_where_it_is_not_sure_enough() -> None:
    match = answer(torch.cat([draw_mixture(CORNERS[:1], 6.0), draw_mixture(CORNERS[:1], 60.0)]), 1)
    best = match.best(min_confidence=0.5)
    assert np.isfinite(best.xy[0]).all() and np.isnan(best.xy[1]).all()
    assert best.confidence[0] > 0.5 > best.confidence[1]


def test_best_of_nothing() -> None:
    assert answer(one_cell(3, 3)[:0], 4).best().xy.shape == (0, 2)


@pytest.mark.parametrize(("name", "bad"), [("min_confidence", 1.1), ("min_confidence", -1), ("radius_px", 0)])
def test_best_of_other_arguments(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be .*, got {bad}"):
        answer(one_cell(3, 3), 1).best(**{name: bad})


@pytest.fixture
def five() -> Match:
    """Five queries, each with another answer."""
    match = answer(torch.cat([draw_mixture(CORNERS, 10.0 + 2 * k) for k in range(5)]), 4)
    return dataclasses.replace(match, xy=np.arange(10.0).reshape(5, 2))


@pytest.mark.parametrize(
    ("index", "rows"),
    [
        (0, [0]), (-1, [4]), (np.int64(2), [2]), (slice(0, 2), [0, 1]), (slice(None, None, -2), [4, 2, 0]),
        ([3, 0], [3, 0]), (np.array([1, -1]), [1, 4]), (np.array([True, False, False, True, False]), [0, 3]),
        ([False] * 5, []), ([], []), (slice(5, 9), []),
    ],
)  # fmt: skip
def test_some_queries_are_taken_as_numpy_does(five: Match, index: object, rows: list[int]) -> None:
    taken = five[index]
    assert len(taken) == len(rows)
    for name in ("xy", "modes", "weights", "covariances", "entropy", "outlier_mass", "cells"):
        np.testing.assert_array_equal(getattr(taken, name), getattr(five, name)[rows])
    assert taken.heatmap.shape == (len(rows), 485, 485)
    assert taken.image0 is five.image0


@pytest.mark.parametrize("bad", [5, -6, [0, 5], [True, False], True, None, 0.5, "0", (0, 1), np.zeros((2, 2), int)])
def test_what_is_no_index(five: Match, bad: object) -> None:
    with pytest.raises(IndexError):
        five[bad]


def test_a_loop_goes_through_the_queries(five: Match) -> None:
    assert [match.xy.tolist() for match in five] == [[row] for row in five.xy.tolist()]
    assert len(five) == 5


def test_the_heatmap_of_one_query_is_made_alone(five: Match) -> None:
    np.testing.assert_array_equal(five.compute_heatmap(3), five.heatmap[3])
    match = five[:]
    match.plot(3)
    assert "heatmap" not in vars(match)


def test_an_answer_is_described_in_a_line(five: Match) -> None:
    assert repr(five) == "Match(5 queries, up to 4 modes each, images of 485 x 485 px and 485 x 485 px, not calibrated)"
    assert repr(five[0]).startswith("Match(1 query, ")


def test_an_answer_can_be_kept(five: Match) -> None:
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(five)).modes, five.modes)
    assert five == five and five != five[:]


def test_the_best_mode_is_one_that_is_seen(rng: np.random.Generator) -> None:
    image, modes = np.zeros((20, 20, 3), np.uint8), np.arange(6.0).reshape(1, 3, 2)
    covariances = np.eye(2) * np.array([1.0, 4.0, 9.0])[:, None, None]
    match = Match(image, image, np.zeros((1, 2)), modes, np.full((1, 3), 1 / 3), covariances[None], np.zeros(1),
                  np.zeros(1), np.ones((1, 2, 2)) / 4)  # fmt: skip
    seen = dataclasses.replace(match, visible=np.array([[0.1, 0.9, 0.8]]))
    assert match.best().xy.tolist() == [[0, 1]] and seen.best().xy.tolist() == [[2, 3]]
    hidden = dataclasses.replace(match, visible=np.array([[0.1, 0.2, 0.3]]))
    assert hidden.best().xy.tolist() == [[0, 1]]
    for unable in ({"on_object": np.array([0.2])}, {"absent": np.array([0.9])}):
        assert np.isnan(dataclasses.replace(seen, **unable).best().xy).all()


def test_modes_that_are_seen_come_first_if_asked() -> None:
    image, modes = np.zeros((20, 20, 3), np.uint8), np.arange(6.0).reshape(1, 3, 2)
    modes[0, 0] = np.nan
    match = Match(image, image, np.zeros((1, 2)), modes, np.array([[0.0, 0.6, 0.4]]), np.ones((1, 3, 2, 2)),
                  np.zeros(1), np.zeros(1), np.ones((1, 2, 2)) / 4, visible=np.array([[np.nan, 0.2, 0.9]]))  # fmt: skip
    first = match.seen_first()
    assert first.visible.tolist()[0][:2] == [0.9, 0.2] and first.weights.tolist() == [[0.4, 0.6, 0.0]]
    assert first.modes[0, :2].tolist() == [[4, 5], [2, 3]] and np.isnan(first.modes[0, 2]).all()
    unknown = dataclasses.replace(match, visible=None)
    assert unknown.seen_first() is unknown
    with pytest.raises(ValueError, match="joint"):
        dataclasses.replace(match, joint_weights=np.ones(3) / 3).seen_first()


def test_where_nothing_shows_the_object_nothing_is_sure() -> None:
    match = answer(draw_mixture(CORNERS[:2], 8.0), 2)
    known = dataclasses.replace(match, on_object=np.array([0.4]), absent=np.array([0.5]))
    np.testing.assert_allclose(known.confidence(), 0.2 * match.confidence(), rtol=1e-6)


def test_an_answer_is_described_without_the_old_names_which_warn() -> None:
    match = answer(draw_mixture(CORNERS[:2], 8.0, np.array([0.75, 0.25])), 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (query,) = describe_answer(match)
    assert query["outside"] == round(float(match.outlier_mass[0]), 4) and len(query["modes"]) == 2
