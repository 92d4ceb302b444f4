"""The figures of the main table: their panels, and lines that hold the numbers that went in."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from heatmaps import make_match
from matplotlib.figure import Figure

from mmgsd.measure.metrics import BIN_PX, summarise_errors
from mmgsd.studies import figure_data, main, sigma, training
from mmgsd.studies.figure_data import FigureData
from mmgsd.studies.models import get_colour, get_line_style

TRUE = np.array([[10.0, 10.0], [30.0, 20.0]])


def make_queries(error: float = 20.0, points: int = 625) -> pd.DataFrame:
    point = np.tile(np.unique(np.linspace(0, 624, points).round().astype(int)), 2)
    visible = np.arange(len(point)) % 5 > 0
    rmse = np.where(visible, error, 1e6)  # a hidden source must not count
    return pd.DataFrame({"point": point, "visible": visible, "rmse_px": rmse})


def make_drawn(points: int = 625) -> dict[str, FigureData]:
    errors = {"mmgsd": 20.0, "spcl": 40.0, "centre": 80.0}
    summaries = {method: summarise_errors(make_queries(error, points)) for method, error in errors.items()}
    return {name: FigureData(dict(summaries), size, {}, []) for name, size in (("cloth", 200.0), ("rope", 100.0))}


def combine(*methods: str) -> Figure:
    answers = {method: make_match(4) for method in (*methods, "mmgsd")}
    return main.plot_combined({"rope": FigureData({}, 1.0, answers, [TRUE] * 4)})


def test_plot_combined_has_five_columns():
    figure = combine("pcl", "spcl")
    assert len(figure.axes) == 10
    shown = figure.axes[3].images[0].get_array()
    assert shown.shape == (40, 60, 3)
    assert shown[10, 10, 0] > 0.9  # the heatmap's brightest colour at a true mode


def test_plot_combined_marks_modes_and_true_matches():
    source, *compared, first = combine("pcl", "spcl").axes[:6]
    assert [len(axis.patches) for axis in compared] == [2, 2, 0, 2]  # an ellipse a mode
    for axis in compared:
        np.testing.assert_array_equal(axis.collections[-1].get_offsets(), TRUE)
    assert [text.get_text() for text in first.texts] == ["1", "2", "3", "4"]


def test_plot_combined_says_what_is_not_trained():
    figure = combine("spcl")
    assert [len(axis.images) for axis in figure.axes[:5]] == [1, 0, 1, 1, 1]
    assert [text.get_text() for text in figure.axes[1].texts] == ["not trained"]


def test_compute_density_is_one_in_all_and_highest_at_the_data():
    centres, density = main.compute_density(np.bincount([48] * 100), 0.25)
    assert density.sum() * 0.25 == pytest.approx(1, abs=1e-3)
    assert centres[density.argmax()] == pytest.approx(12.125)


def test_compute_density_loses_nothing_at_zero():
    _, density = main.compute_density(np.array([10]), 0.25)
    assert density.sum() * 0.25 == pytest.approx(1, abs=1e-3)
    assert density.argmax() == 0


def test_plot_rmse_pdf_draws_visible_queries_in_percent():
    figure = main.plot_rmse_pdf(make_drawn())
    assert len(figure.axes) == 2
    for axis, peaks in zip(figure.axes, ((10, 20, 40), (20, 40, 80)), strict=True):
        found = [line.get_xdata()[line.get_ydata().argmax()] for line in axis.lines]
        assert found == pytest.approx(peaks, abs=BIN_PX)
    assert figure.axes[0].get_xlim()[1] == pytest.approx(40, abs=2 * BIN_PX)  # most errors of all methods but chance
    assert [line.get_linestyle() for line in figure.axes[0].lines] == ["-", "-", "--"]
    assert figure.axes[0].lines[0].get_color() == get_colour("mmgsd")


@pytest.mark.parametrize("points", [625, 25])
def test_plot_spatial_rmse_draws_lines_and_maps(points):
    drawn = make_drawn(points)
    figure = main.plot_spatial_rmse(drawn)
    assert len(figure.axes) == 5  # the last two are the colour bars
    assert figure.axes[0].lines[1].get_ydata() == pytest.approx(40)
    values = [axis.images[0].get_array() for axis in figure.axes[1:3]]
    assert [float(v.mean()) for v in values] == pytest.approx([20, 40])
    assert [axis.images[0].get_clim()[1] for axis in figure.axes[1:3]] == pytest.approx([22, 44])  # each by its own
    del drawn["cloth"].errors["spcl"]  # not trained
    assert len(main.plot_spatial_rmse(drawn).axes) == 3


def test_plot_sigma_ablation_sorts_by_sigma():
    results = {"cloth": {"16": {"rmse_mean": 60.0}, "2": {"rmse_mean": 30.0}}, "rope": {"2": {"rmse_mean": 20.0}}}
    cloth, rope = sigma.plot_sigma_ablation(results).axes
    assert cloth.lines[0].get_xdata().tolist() == [2, 16]
    assert cloth.lines[0].get_ydata().tolist() == [30, 60]
    assert [text.get_text() for text in (*cloth.texts, *rope.texts)] == ["30.0", "60.0", "20.0"]


def test_other_seeds_are_rings_beside_the_narrowest_target():
    results = {"cloth": {"1": {"rmse_mean": 42.6}, "16": {"rmse_mean": 38.5}}}
    rows = {f"{key}": {"rmse_mean": value} for key, value in
            {"mmgsd-0": 42.6, "mmgsd-1": 38.1, "spcl-1": 50.0, "mmgsd_deep-1": 3.0}.items()}  # fmt: skip
    (axis,) = sigma.plot_sigma_ablation(results, seeds={"cloth": rows}).axes
    assert axis.lines[1].get_xdata().tolist() == [1] and axis.lines[1].get_ydata().tolist() == [38.1]


def test_lines_that_lie_on_others_are_seen():
    mmgsd, unimodal, spcl, pcl = map(get_line_style, ("mmgsd", "unimodal", "spcl", "pcl"))
    assert pcl["zorder"] > spcl["zorder"] and unimodal["zorder"] > mmgsd["zorder"] > spcl["zorder"]
    assert pcl["linestyle"] != "-" == spcl["linestyle"]


def test_plot_training_has_a_panel_a_model():
    log = pd.DataFrame({"step": range(1, 6), "loss": [5.0, 4, 3, 2, 1], "seconds": range(60, 310, 60)})
    figure = training.plot_training({"cloth mmgsd": log, "rope pcl": log, "rope mmgsd": log})
    assert len(figure.axes) == 3
    assert figure.axes[0].lines[0].get_ydata().tolist() == [5, 4, 3, 2, 1]
    assert figure.axes[0].get_title() == "Cloth MMGSD · 5.0 min"


def test_compute_object_size_is_the_mean_diagonal():
    mask = np.zeros((20, 20), bool)
    mask[2:5, 3:7] = True  # 3 x 4 px
    assert figure_data.compute_object_size([mask, mask]) == pytest.approx(5)
