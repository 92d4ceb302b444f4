"""The regions of a cloth, and the study's maps and bars."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgba

from mmgsd.experiments import get_colour
from mmgsd.figures.symmetry import find_regions, plot_symmetry_study, summarise_regions


def make_queries(corner: float, other: float, points: int = 625) -> pd.DataFrame:
    point = np.unique(np.linspace(0, 624, points).round().astype(int))
    errors = np.where(find_regions()["corner"][point], corner, other)
    table = pd.DataFrame({"point": point, "visible": True, "rmse_px": errors, "entropy": errors / 10})
    hidden = table.assign(visible=False, rmse_px=1e6)
    return pd.concat([table, hidden], ignore_index=True)


def test_regions_by_hand():
    regions = find_regions()
    assert {name: int(points.sum()) for name, points in regions.items()} == {
        "corner": 100,
        "edge": 180,
        "interior": 169,
    }
    assert not (regions["corner"] & regions["edge"]).any() and not (regions["edge"] & regions["interior"]).any()
    assert regions["corner"][[0, 24, 600, 624]].all() and regions["interior"][312] and regions["edge"][12]
    for points in regions.values():  # every group of a square leaves a region where it is
        grid = points.reshape(25, 25)
        assert (grid == grid[::-1]).all() and (grid == grid.T).all()


def test_regions_are_summarised_over_visible_sources():
    summary = summarise_regions(make_queries(10.0, 30.0))
    assert summary["corner"] == {"rmse_px": 10.0, "entropy": 1.0, "queries": 100}
    assert summary["interior"] == {"rmse_px": 30.0, "entropy": 3.0, "queries": 169}


def test_a_region_never_asked_has_no_mean():
    queries = make_queries(10.0, 30.0)
    summary = summarise_regions(queries[~find_regions()["interior"][queries.point]])
    assert summary["interior"] == {"rmse_px": None, "entropy": None, "queries": 0}


@pytest.mark.parametrize("points", [625, 25])
def test_the_study_has_a_map_a_group_and_two_sets_of_bars(points):
    figure = plot_symmetry_study({"v4": make_queries(10.0, 30.0, points), "c4": make_queries(10.0, 15.0, points)})
    maps = [axis for axis in figure.axes if axis.images]
    assert [axis.get_title() for axis in maps] == ["v4", "c4"]
    assert {axis.images[0].get_clim() for axis in maps} == {(0.0, 30.0)}
    errors, entropies = figure.axes[2:4]
    edge = [30, 15] if points == 625 else [np.nan, np.nan]  # 25 points lie on a diagonal
    expected = [10, edge[0], 30, 10, edge[1], 15]
    assert [bar.get_height() for bar in errors.patches] == pytest.approx(expected, nan_ok=True)
    assert [axis.get_ylabel() for axis in (errors, entropies)] == ["RMSE (px)", "Entropy (nats)"]
    assert not errors.get_title() and not entropies.get_title()  # an axis is named once
    for axis in (errors, entropies):
        assert axis.get_ylim()[0] == 0  # no bar is cut off
        assert [bar.get_facecolor() for bar in axis.patches[::3]] == [to_rgba(get_colour(g)) for g in ("v4", "c4")]


def test_nothing_to_study_is_refused():
    with pytest.raises(ValueError, match="tables must not be empty"):
        plot_symmetry_study({})
