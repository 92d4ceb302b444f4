"""The symmetry study's maps and bars."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from queries import make_queries

from mmgsd.measure.regions import summarise_places
from mmgsd.studies.models import get_colour
from mmgsd.studies.symmetry import plot_symmetry_study


@pytest.mark.parametrize("points", [625, 25])
def test_the_study_has_a_map_a_group_rings_and_bars(points):
    tables = {"v4": make_queries(10.0, 30.0, points), "c4": make_queries(10.0, 15.0, points)}
    figure = plot_symmetry_study({group: summarise_places(table) for group, table in tables.items()})
    maps = [axis for axis in figure.axes if axis.images]
    assert [axis.get_title() for axis in maps] == ["v4", "c4"]
    assert {axis.images[0].get_clim() for axis in maps} == {(0.0, 30.0)}
    rings, errors = figure.axes[2:4]
    edge = [30, 15] if points == 625 else [np.nan, np.nan]  # 25 points lie on a diagonal
    expected = [10, edge[0], 30, 10, edge[1], 15]
    assert [bar.get_height() for bar in errors.patches] == pytest.approx(expected, nan_ok=True)
    assert [line.get_ydata()[-1] for line in rings.lines] == [30, 15]  # at the centre
    assert [line.get_color() for line in rings.lines] == [get_colour(group) for group in ("v4", "c4")]
    assert errors.get_ylim()[0] == rings.get_ylim()[0] == 0  # no bar is cut off
    assert [bar.get_facecolor() for bar in errors.patches[::3]] == [to_rgba(get_colour(g)) for g in ("v4", "c4")]
