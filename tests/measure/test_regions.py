"""The regions of a cloth, and the errors in them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from queries import make_queries

from mmgsd.measure.regions import find_regions, measure_rings, summarise_places, summarise_regions


def test_regions_by_hand() -> None:
    regions = find_regions()
    assert {name: points.sum() for name, points in regions.items()} == {"corner": 100, "edge": 180, "interior": 169}
    assert not (regions["corner"] & regions["edge"]).any() and not (regions["edge"] & regions["interior"]).any()
    assert regions["corner"][[0, 24, 600, 624]].all() and regions["interior"][312] and regions["edge"][12]
    for points in regions.values():  # every group of a square leaves a region where it is
        grid = points.reshape(25, 25)
        assert (grid == grid[::-1]).all() and (grid == grid.T).all()


def test_rings_lead_from_the_border_to_the_centre() -> None:
    row, column = np.divmod(np.arange(625), 25)
    errors = np.maximum(abs(row - 12), abs(column - 12)).astype(float).tolist()
    assert measure_rings(errors) == list(range(12, -1, -1))
    assert measure_rings([*errors[:312], None, *errors[313:]])[-1] is None


def test_regions_are_summarised_over_visible_sources() -> None:
    summary = summarise_regions(make_queries(10.0, 30.0))
    assert summary["corner"] == {"rmse_px": 10.0, "entropy": 1.0, "queries": 100}
    assert summary["interior"] == {"rmse_px": 30.0, "entropy": 3.0, "queries": 169}


def test_a_region_never_asked_has_no_mean() -> None:
    queries = make_queries(10.0, 30.0)
    summary = summarise_regions(queries[~find_regions()["interior"][queries.point]])
    assert summary["interior"] == {"rmse_px": None, "entropy": None, "queries": 0}


def test_places_are_regions_and_an_error_a_point() -> None:
    queries = make_queries(10.0, 30.004)
    asked = queries[queries.point != 3]
    places = summarise_places(asked)
    assert places["regions"] == summarise_regions(asked)
    assert places["map_px"][3] is None and places["map_px"][0] == 10.0 and places["map_px"][312] == pytest.approx(30.0)
    again = json.loads(json.dumps(places))
    assert np.isnan(np.array(again["map_px"], float)).sum() == 1 and len(again["map_px"]) == 625
