"""Each figure has its panels, and its lines hold the numbers that went in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from mmgsd.experiments import get_colour
from mmgsd.figures import answers, plots
from mmgsd.figures import style as drawing
from mmgsd.match.match import Match
from mmgsd.measure.metrics import BIN_PX, ErrorSummary, summarise_errors


def make_match(queries: int = 1, modes: int = 2, *, height: int = 40, width: int = 60) -> Match:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (2, height, width, 3), dtype=np.uint8)
    xy = rng.uniform(5, 35, (queries, 2)).astype(np.float32)
    centres = rng.uniform(5, 35, (queries, modes, 2))
    covariances = np.broadcast_to([[9.0, 2.0], [2.0, 4.0]], (queries, modes, 2, 2))
    cells = rng.random((queries, height // 4, width // 4)).astype(np.float32)
    weights = np.full((queries, modes), 1 / modes)
    cells /= cells.sum((1, 2), keepdims=True)
    entropy, outside = np.full(queries, 7.25), np.zeros(queries)
    return Match(*images, xy, centres, weights, covariances, entropy, outside, cells)


def make_queries(error: float = 20.0, points: int = 625) -> pd.DataFrame:
    point = np.tile(np.unique(np.linspace(0, 624, points).round().astype(int)), 2)
    visible = np.arange(len(point)) % 5 > 0
    rmse = np.where(visible, error, 1e6)  # a hidden source must not count
    return pd.DataFrame({"point": point, "visible": visible, "rmse_px": rmse})


def make_errors(points: int = 625) -> dict[str, dict[str, ErrorSummary]]:
    errors = {"mmgsd": 20.0, "spcl": 40.0, "centre": 80.0}
    return {o: {m: summarise_errors(make_queries(e, points)) for m, e in errors.items()} for o in ("cloth", "rope")}


def test_plot_match_shows_source_and_answer_with_entropy():
    figure = plots.plot_match(make_match(3), 1)
    assert isinstance(figure, Figure) and len(figure.axes) == 2
    assert "7.2" in figure.axes[1].get_title()
    assert len(figure.axes[1].patches) == 2  # an ellipse a mode


def test_plot_match_leaves_out_absent_modes():
    match = make_match()
    match.modes[0, 1] = np.nan
    assert len(plots.plot_match(match).axes[1].patches) == 1


def test_modes_without_weight_fade():
    match = make_match(modes=3)
    match.weights[0] = [0.98, 0.02, 0.0]
    opacity = [patch.get_alpha() for patch in plots.plot_match(match).axes[1].patches]
    assert opacity[0] == 1 and 0 < opacity[1] < 1 and opacity[2] == 0


def test_hidden_modes_are_dashed():
    match = dataclasses.replace(make_match(), visible=np.array([[0.9, 0.2]]))
    seen, hidden = plots.plot_match(match).axes[1].patches
    assert seen.get_linestyle() == "-" and hidden.get_linestyle() != "-"


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"absent": [0.93, 0.2]}, "absent: image1 does not show the object (93% sure)"),
        ({"on_object": [0.2, 0.7]}, "background: the pixel is not on the object (80% sure)"),
    ],
)
def test_what_has_no_answer_says_so_and_is_faint(known, said):
    match = dataclasses.replace(make_match(2), **{name: np.array(value) for name, value in known.items()})
    none, some = (plots.plot_match(match, k).axes[1] for k in (0, 1))
    assert none.get_title() == said and "entropy" in some.get_title()
    assert none.patches[0].get_alpha() < 0.5 and some.patches[0].get_alpha() == 1
    titles = [axis.get_title() for axis in plots.plot_page(match).axes]
    assert said.startswith(titles[1]) and titles[1] and titles[3] == "entropy 7.2 nats"


def test_ellipse_follows_the_covariance():
    ellipse = plots.plot_match(make_match()).axes[1].patches[0]
    values, vectors = np.linalg.eigh([[9.0, 2.0], [2.0, 4.0]])
    assert (ellipse.width, ellipse.height) == pytest.approx(tuple(2 * np.sqrt(values[::-1])))
    direction = np.array([np.cos(np.radians(ellipse.angle)), np.sin(np.radians(ellipse.angle))])
    assert abs(direction @ vectors[:, 1]) == pytest.approx(1)


@pytest.mark.parametrize("index", [-1, 1, 0.5, "0", None, True])
def test_plot_match_names_the_accepted_index(index):
    with pytest.raises(ValueError, match=r"index must be in \[0, 1\)"):
        plots.plot_match(make_match(), index)


@pytest.mark.parametrize(("queries", "rows"), [(1, 1), (2, 1), (5, 3)])
def test_a_page_has_two_queries_a_row(queries, rows):
    figure = plots.plot_page(make_match(queries))
    drawn = [axis for axis in figure.axes if axis.images]
    assert len(drawn) == 2 * queries
    assert figure.axes[0].get_gridspec().nrows == rows
    assert drawn[-2].get_title().startswith(f"{queries} · pixel ")


def test_a_page_shows_large_images_small_and_the_modes_where_they_are():
    match = make_match()
    large = dataclasses.replace(match, image1=np.zeros((4000, 6000, 3), np.uint8), modes=100 * match.modes)
    axis = plots.plot_page(large).axes[1]
    assert axis.images[0].get_array().shape[:2] == (427, 640)
    np.testing.assert_allclose(axis.patches[0].center, (large.modes[0, 0] + 0.5) * (640 / 6000) - 0.5, rtol=0.01)


@pytest.mark.parametrize("queries", [0, 101])
def test_a_page_holds_so_many_queries(queries):
    match = make_match(1)[np.zeros(queries, int)]
    with pytest.raises(ValueError, match=f"match must hold 1 to 100 queries to be drawn, got {queries}"):
        plots.plot_page(match)


def test_plot_teaser_has_three_panels_a_match():
    figure = answers.plot_teaser({"cloth": [make_match(height=60)], "rope": [make_match()]})
    assert len(figure.axes) == 6
    assert figure.get_figwidth() == pytest.approx(drawing.COLUMN_IN)


def test_the_teaser_marks_every_match_and_leads_to_it_from_the_pixel():
    match = make_match(modes=4)
    match.modes[0, 3] = np.nan
    figure = answers.plot_teaser({"cloth": [match]})
    source, target, _ = figure.axes
    marks = [tuple(mark.get_offsets()[0]) for mark in target.collections]
    assert marks == [pytest.approx(tuple(mode)) for mode in match.modes[0, :3]]
    lines = [line for line in figure.artists if isinstance(line, ConnectionPatch)]
    assert {tuple(line.xy1) for line in lines} == {tuple(match.xy[0])} and len(lines) == 2 * 3  # and their outlines
    assert len(source.collections) == 1


def test_plot_combined_has_five_columns():
    methods = {method: make_match() for method in ("pcl", "spcl", "mmgsd")}
    true = np.array([[10.0, 10.0], [30.0, 20.0]])
    figure = answers.plot_combined({"rope": methods}, {"rope": true}, {"rope": make_match(4)})
    assert len(figure.axes) == 10
    shown = figure.axes[3].images[0].get_array()
    assert shown.shape == (40, 60, 3)
    assert shown[10, 10, 0] > 0.9  # the heatmap's brightest colour at a true mode


def test_plot_combined_marks_modes_and_true_matches():
    methods = {method: make_match() for method in ("pcl", "spcl", "mmgsd")}
    true = np.array([[10.0, 10.0], [30.0, 20.0]])
    source, *compared, first = answers.plot_combined({"rope": methods}, {"rope": true}, {"rope": make_match(4)}).axes[
        :6
    ]
    assert [len(axis.patches) for axis in compared] == [2, 2, 0, 2]  # an ellipse a mode
    for axis in compared:
        np.testing.assert_array_equal(axis.collections[-1].get_offsets(), true)
    assert [text.get_text() for text in first.texts] == ["1", "2", "3", "4"]


def test_plot_combined_says_what_is_not_trained():
    methods = {method: make_match() for method in ("spcl", "mmgsd")}
    figure = answers.plot_combined({"rope": methods}, {"rope": np.array([[10.0, 10.0]])}, {})
    assert [len(axis.images) for axis in figure.axes] == [1, 0, 1, 1, 1]
    assert [text.get_text() for text in figure.axes[1].texts] == ["not trained"]


def test_plot_combined_wants_four_queries_inwards():
    with pytest.raises(ValueError, match="must hold 4 queries, got 3"):
        answers.plot_combined({"rope": {"mmgsd": make_match()}}, {}, {"rope": make_match(3)})


def test_compute_density_is_one_in_all_and_highest_at_the_data():
    centres, density = plots.compute_density(np.bincount([48] * 100), 0.25)
    assert density.sum() * 0.25 == pytest.approx(1, abs=1e-3)
    assert centres[density.argmax()] == pytest.approx(12.125)


def test_compute_density_loses_nothing_at_zero():
    _, density = plots.compute_density(np.array([10]), 0.25)
    assert density.sum() * 0.25 == pytest.approx(1, abs=1e-3)
    assert density.argmax() == 0


def test_plot_rmse_pdf_draws_visible_queries_in_percent():
    figure = plots.plot_rmse_pdf(make_errors(), {"cloth": 200.0, "rope": 100.0})
    assert len(figure.axes) == 2
    for axis, peaks in zip(figure.axes, ((10, 20, 40), (20, 40, 80)), strict=True):
        found = [line.get_xdata()[line.get_ydata().argmax()] for line in axis.lines]
        assert found == pytest.approx(peaks, abs=BIN_PX)
    assert figure.axes[0].get_xlim()[1] == pytest.approx(40, abs=2 * BIN_PX)  # most errors of all methods but chance
    assert [line.get_linestyle() for line in figure.axes[0].lines] == ["-", "-", "--"]
    assert figure.axes[0].lines[0].get_color() == get_colour("mmgsd")


@pytest.mark.parametrize("points", [625, 25])
def test_plot_spatial_rmse_draws_lines_and_maps(points):
    figure = plots.plot_spatial_rmse(make_errors(points))
    assert len(figure.axes) == 5  # the last two are the colour bars
    assert figure.axes[0].lines[1].get_ydata() == pytest.approx(40)
    values = [axis.images[0].get_array() for axis in figure.axes[1:3]]
    assert [float(v.mean()) for v in values] == pytest.approx([20, 40])
    assert [axis.images[0].get_clim()[1] for axis in figure.axes[1:3]] == pytest.approx([22, 44])  # each by its own
    errors = make_errors(points)
    del errors["cloth"]["spcl"]  # not trained
    assert len(plots.plot_spatial_rmse(errors).axes) == 3


def test_plot_sigma_ablation_sorts_by_sigma():
    results = {"cloth": {"16": {"rmse_mean": 60.0}, "2": {"rmse_mean": 30.0}}, "rope": {"2": {"rmse_mean": 20.0}}}
    cloth, rope = plots.plot_sigma_ablation(results).axes
    assert cloth.lines[0].get_xdata().tolist() == [2, 16]
    assert cloth.lines[0].get_ydata().tolist() == [30, 60]
    assert [text.get_text() for text in (*cloth.texts, *rope.texts)] == ["30.0", "60.0", "20.0"]


def test_other_seeds_are_rings_beside_the_narrowest_target():
    results = {"cloth": {"1": {"rmse_mean": 42.6}, "16": {"rmse_mean": 38.5}}}
    rows = {f"{key}": {"rmse_mean": value} for key, value in
            {"mmgsd-0": 42.6, "mmgsd-1": 38.1, "spcl-1": 50.0, "mmgsd_deep-1": 3.0}.items()}  # fmt: skip
    (axis,) = plots.plot_sigma_ablation(results, seeds={"cloth": rows}).axes
    assert axis.lines[1].get_xdata().tolist() == [1] and axis.lines[1].get_ydata().tolist() == [38.1]


def test_lines_that_lie_on_others_are_seen():
    mmgsd, unimodal, spcl, pcl = map(drawing.get_line_style, ("mmgsd", "unimodal", "spcl", "pcl"))
    assert pcl["zorder"] > spcl["zorder"] and unimodal["zorder"] > mmgsd["zorder"] > spcl["zorder"]
    assert pcl["linestyle"] != "-" == spcl["linestyle"]


def test_plot_training_has_a_panel_a_model():
    log = pd.DataFrame({"step": range(1, 6), "loss": [5.0, 4, 3, 2, 1], "seconds": range(60, 310, 60)})
    figure = plots.plot_training({"cloth mmgsd": log, "rope pcl": log, "rope mmgsd": log}, columns=2)
    assert len(figure.axes) == 3
    assert figure.axes[0].lines[0].get_ydata().tolist() == [5, 4, 3, 2, 1]
    assert figure.axes[0].get_title() == "Cloth MMGSD · 5.0 min"


def test_plot_samples_fills_a_sheet(rng):
    images = list(rng.integers(0, 255, (5, 20, 30, 3), dtype=np.uint8))
    figure = plots.plot_samples(images, [str(i) for i in range(5)], columns=3)
    assert [axis.get_title() for axis in figure.axes] == list("01234")
    with pytest.raises(ValueError, match="titles must be 5"):
        plots.plot_samples(images, ["one"])


@pytest.mark.parametrize("name", ["cloth", "rope"])
def test_plot_labels_tells_hidden_points_from_visible(rng, name):
    xy, visible = rng.uniform(0, 40, (625, 2)), rng.random(625) > 0.3
    figure = plots.plot_labels(np.zeros((40, 60, 3), np.uint8), xy, visible, object=name, orbit=[0, 624])
    hidden, seen, *rings = figure.axes[1].collections
    assert len(hidden.get_offsets()) == (~visible).sum() and len(seen.get_offsets()) == visible.sum()
    assert np.asarray(rings[0].get_offsets()) == pytest.approx(xy[[0, 624]])


def test_plot_labels_checks_shapes():
    with pytest.raises(ValueError, match="visible"):
        plots.plot_labels(np.zeros((4, 4, 3), np.uint8), np.zeros((3, 2)), np.ones(2, bool))


def test_plot_orbits_draws_every_orbit_of_every_group(rng):
    xy = rng.uniform(0, 40, (9, 2))
    figure = plots.plot_orbits(np.zeros((40, 40, 3), np.uint8), xy, {"identity": [[0], [4]], "c4": [[0, 2, 6, 8], [4]]})
    first, second = figure.axes
    assert [len(c.get_offsets()) for c in first.collections] == [1, 1]
    assert np.asarray(second.collections[0].get_offsets()) == pytest.approx(xy[[0, 2, 6, 8]])


def test_plot_variety_counts_states_and_hues():
    red, blue, grey = np.array([200.0, 0, 0]), np.array([0, 0, 200.0]), np.array([90.0, 90, 90])
    table = pd.DataFrame({
        "state": ["flat", "flat", "folded", "flat"], "visible": [1.0, 0.99, 0.5, 0.98],
        "object_colour": [red, red, blue, red], "background_colour": [grey] * 4,
    })  # fmt: skip
    states, visible, hues, modes = plots.plot_variety({"cloth": table}, {"cloth": {"c4": [4, 4, 1]}}).axes
    assert [bar.get_width() for bar in states.patches] == [75, 25]
    assert [bar.get_height() for bar in visible.patches][10] == 1 and visible.patches[19].get_height() == 3
    assert sorted(bar.get_height() for bar in hues.patches if bar.get_height()) == [-4, 1, 3]
    assert [bar.get_height() for bar in modes.patches] == [1, 2]
    assert {hues.yaxis.get_major_formatter()(count) for count in (-4, 4)} == {"4"}  # downwards are no negative images


def test_a_number_of_modes_has_one_colour_for_all_objects():
    table = pd.DataFrame({"state": ["flat"], "visible": [1.0], "object_colour": [np.zeros(3)],
                          "background_colour": [np.zeros(3)]})  # fmt: skip
    groups = {"cloth": {"c4": [4, 4, 1], "d4": [8, 8, 4]}, "rope": {"c2": [2, 2, 1]}}
    figure = plots.plot_variety(dict.fromkeys(groups, table), groups)
    cloth, rope = ({text.get_text(): bar.get_facecolor() for bar, text in zip(axis.get_legend().get_patches(),
                   axis.get_legend().get_texts(), strict=True)} for axis in figure.axes[3::4])  # fmt: skip
    assert cloth["1"] == rope["1"] and len({*cloth.values(), *rope.values()}) == 4
    assert list(cloth) == ["1", "4", "8"] and list(rope) == ["1", "2"]


def test_compute_point_colours_differ_at_the_corners():
    colours = drawing.compute_point_colours("cloth")
    assert colours.shape == (625, 3) and colours.min() >= 0 and colours.max() <= 1
    assert len(np.unique(colours[[0, 24, 600, 624]], axis=0)) == 4


def test_compute_object_size_is_the_mean_diagonal():
    mask = np.zeros((20, 20), bool)
    mask[2:5, 3:7] = True  # 3 x 4 px
    assert plots.compute_object_size([mask, mask]) == pytest.approx(5)


def test_save_figure_gives_the_same_bytes_twice(tmp_path):
    figure = plots.plot_match(make_match())
    first = [path.read_bytes() for path in drawing.save_figure(figure, tmp_path / "match")]
    second = [path.read_bytes() for path in drawing.save_figure(figure, tmp_path / "match")]
    assert first == second
    assert sorted(path.name for path in tmp_path.iterdir()) == ["match.pdf", "match.png"]


@pytest.mark.parametrize("call", [
    lambda: answers.plot_teaser({}),
    lambda: answers.plot_combined({}, {}, {}),
    lambda: plots.plot_rmse_pdf({}, {}),
    lambda: plots.plot_rmse_pdf({"cloth": {}}, {"cloth": 1.0}),
    lambda: plots.compute_density(np.zeros(3, int), 0.25),
    lambda: plots.plot_spatial_rmse({}),
    lambda: plots.plot_sigma_ablation({}),
    lambda: plots.plot_training({}),
    lambda: plots.plot_samples([]),
    lambda: plots.plot_orbits(np.zeros((4, 4, 3), np.uint8), np.zeros((3, 2)), {}),
    lambda: plots.plot_variety({}, {}),
    lambda: plots.compute_object_size([]),
])  # fmt: skip
def test_empty_input_is_an_error(call):
    with pytest.raises(ValueError, match="must not be empty"):
        call()


def test_no_figure_stays_open():
    from matplotlib import pyplot

    before = pyplot.get_fignums()  # of other tests
    plots.plot_sigma_ablation({"cloth": {"1": {"rmse_mean": 1.0}}})
    assert pyplot.get_fignums() == before
