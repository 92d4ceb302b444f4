"""The tail of the errors: each match has one cause; an outline that is its own mirror image leaves two ways open."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest

import mmgsd
from mmgsd.config import EvaluateConfig
from mmgsd.dataset import load_dataset
from mmgsd.studies import tail
from mmgsd.studies.table import to_markdown
from mmgsd.studies.tail import find_mixed, find_outline_symmetries, list_matches, measure_floors, summarise_tail
from mmgsd.symmetry import load_mirror

FEW = EvaluateConfig(pairs=4, points=9)


def test_every_match_of_every_query_has_one_cause_and_its_error(cloth_dataset: Path) -> None:
    matcher, data = mmgsd.load("cloth-paper"), load_dataset(cloth_dataset, "test")
    matches = list_matches(matcher, data, config=FEW)
    assert set(matches.cause) <= set(tail.CAUSES) and (matches.cause.eq("hidden") == ~matches.seen).all()
    by_query = matches.groupby("query")
    assert by_query.size().isin([1, 4]).all()
    rmse = by_query.error_px.apply(lambda errors: np.sqrt(np.square(errors).mean()))
    assert np.allclose(rmse, by_query.rmse_px.first())
    found = summarise_tail(matches, measure_floors(data, FEW, ""))
    shares = [found[cause]["share"] for cause in tail.CAUSES]
    assert sum(shares) == pytest.approx(1, abs=1e-3) and found["all"]["matches"] == len(matches)
    tails = [found[cause]["tail"] for cause in tail.CAUSES]
    assert found["all"]["tail"] in (None, 1.0) and (tails[0] is None or sum(tails) == pytest.approx(1, abs=1e-3))
    page = to_markdown(tail.describe_tail({"cloth-paper": {"quick": found, "workspace": found}}))
    assert "cloth-paper, workspace" in page and "match is hidden" in page
    assert "least error" in to_markdown(tail.describe_floors({"cloth-paper": {"quick": found}}))


def make_data(xy: np.ndarray, object: str = "cloth", mask: np.ndarray | None = None) -> SimpleNamespace:
    return SimpleNamespace(xy=xy[None], object=object, mirror=load_mirror(object), load_mask=lambda _: mask,
                           labels=pd.DataFrame({"state": ["folded"]}), n_points=len(xy))  # fmt: skip


def lay_cloth(side_px: float = 240, at: tuple[float, float] = (100, 60)) -> np.ndarray:
    rows, columns = np.divmod(np.arange(625), 25)
    return np.stack([columns, rows], -1) * side_px / 24 + at


def test_points_are_mixed_where_two_layers_lie_within_a_cell() -> None:
    flat = lay_cloth()
    assert not find_mixed(make_data(flat), 0).any()
    folded = flat.copy()
    folded[:, 0] = np.where(flat[:, 0] > 220, 440 - flat[:, 0], flat[:, 0])  # the right half over the left one
    mixed = find_mixed(make_data(folded), 0).reshape(25, 25)
    assert mixed[:, [0, 1, 23, 24]].all() and not mixed[:, 12].any()
    circle = np.linspace(0, 2 * np.pi, 625)[:, None]
    loop = np.hstack([np.cos(circle), np.sin(circle)]) * 150 + 200
    ends = find_mixed(make_data(loop, "rope"), 0)
    assert ends[[0, 624]].all() and not ends[100:500].any()


def draw(corners: list[tuple[int, int]]) -> np.ndarray:
    return cv2.fillPoly(np.zeros((300, 400), np.uint8), [np.array(corners)], 1) > 0


def test_outlines_are_laid_onto_themselves_in_every_way_that_fits() -> None:
    rectangle = find_outline_symmetries(draw([(50, 60), (290, 60), (290, 180), (50, 180)]))
    kinds = sorted(round(float(np.linalg.det(affine[:, :2]))) for affine in rectangle)
    assert kinds == [-1, -1, 1, 1] and (rectangle[0] == np.eye(2, 3)).all()
    for affine in rectangle:
        assert affine[:, :2] @ (170, 120) + affine[:, 2] == pytest.approx((170, 120), abs=1)
    crooked = find_outline_symmetries(draw([(50, 60), (290, 60), (200, 130), (190, 250), (50, 100)]))
    assert len(crooked) == 1


def test_a_fold_that_may_be_on_either_side_has_a_floor_and_a_flat_cloth_has_none(monkeypatch) -> None:
    flat = lay_cloth()
    folded = flat.copy()
    folded[:, 0] = np.where(flat[:, 0] > 220, 440 - flat[:, 0], flat[:, 0])
    group = SimpleNamespace(distinct_modes=lambda p: np.unique(
        [p, (p % 25) * 25 + 24 - p // 25, 624 - p, (24 - p % 25) * 25 + p // 25]))  # fmt: skip
    monkeypatch.setattr(tail, "draw_pairs", lambda *_: np.array([[0, 0]]))
    for xy, corners, many in ((flat, [(100, 60), (340, 60), (340, 300), (100, 300)], False),
                              (folded, [(100, 60), (220, 60), (220, 300), (100, 300)], True)):  # fmt: skip
        data = make_data(xy, mask=draw(corners))
        data.group = lambda _: group
        row = measure_floors(data, EvaluateConfig(pairs=1, points=25), "").iloc[0]
        assert (row.ways > 1) == many and (row.floor_px > 5) == many
