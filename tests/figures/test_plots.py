"""Each figure has its panels, and its lines hold the numbers that went in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest
from heatmaps import make_match
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from mmgsd.figures import plots
from mmgsd.figures import style as drawing


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
    assert none.get_title().split() == said.split() and max(map(len, none.get_title().splitlines())) <= 40
    assert "entropy" in some.get_title()
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
    with pytest.raises(ValueError, match=r"index must"):
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
    with pytest.raises(ValueError, match=f"match must .*got {queries}"):
        plots.plot_page(match)


def test_plot_teaser_has_three_panels_a_match():
    figure = plots.plot_teaser({"cloth": make_match(height=60), "rope": make_match()})
    assert len(figure.axes) == 6
    assert figure.get_figwidth() == pytest.approx(drawing.COLUMN_IN)


def test_the_teaser_marks_every_match_and_leads_to_it_from_the_pixel():
    match = make_match(modes=4)
    match.modes[0, 3] = np.nan
    figure = plots.plot_teaser({"cloth": match})
    source, target, _ = figure.axes
    marks = [tuple(mark.get_offsets()[0]) for mark in target.collections]
    assert marks == [pytest.approx(tuple(mode)) for mode in match.modes[0, :3]]
    lines = [line for line in figure.artists if isinstance(line, ConnectionPatch)]
    assert {tuple(line.xy1) for line in lines} == {tuple(match.xy[0])} and len(lines) == 2 * 3  # and their outlines
    assert len(source.collections) == 1


def test_plot_samples_fills_a_sheet(rng):
    images = list(rng.integers(0, 255, (5, 20, 30, 3), dtype=np.uint8))
    figure = plots.plot_samples(images, columns=3)
    assert [axis.images[0].get_array().shape for axis in figure.axes] == [(20, 30, 3)] * 5


@pytest.mark.parametrize("name", ["cloth", "rope"])
def test_plot_labels_tells_hidden_points_from_visible(rng, name):
    xy, visible = rng.uniform(0, 40, (625, 2)), rng.random(625) > 0.3
    figure = plots.plot_labels(np.zeros((40, 60, 3), np.uint8), xy, visible, object=name, orbit=[0, 624])
    hidden, seen, *rings = figure.axes[1].collections
    assert len(hidden.get_offsets()) == (~visible).sum() and len(seen.get_offsets()) == visible.sum()
    assert np.asarray(rings[0].get_offsets()) == pytest.approx(xy[[0, 624]])


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
    colours = drawing.compute_point_colours("cloth", 625)
    assert colours.shape == (625, 3) and colours.min() >= 0 and colours.max() <= 1
    assert len(np.unique(colours[[0, 24, 600, 624]], axis=0)) == 4


def test_save_figure_gives_the_same_bytes_twice(tmp_path):
    figure = plots.plot_match(make_match())
    first = [path.read_bytes() for path in drawing.save_figure(figure, tmp_path / "match")]
    second = [path.read_bytes() for path in drawing.save_figure(figure, tmp_path / "match")]
    assert first == second
    assert sorted(path.name for path in tmp_path.iterdir()) == ["match.pdf", "match.png"]


def test_no_figure_stays_open():
    from matplotlib import pyplot

    before = pyplot.get_fignums()  # of other tests
    plots.plot_samples([np.zeros((4, 4, 3), np.uint8)])
    assert pyplot.get_fignums() == before


def test_a_rope_laid_flat_takes_as_much_room_as_its_answer():
    match = dataclasses.replace(make_match(2), image0=np.zeros((16, 625, 3), np.uint8))
    for figure in (plots.plot_match(match), plots.plot_page(match, ["ends", "middle"])):
        low, high = figure.axes[0].get_ylim()
        assert low - high == pytest.approx(0.75 * 625)
        figure.canvas.draw()
        first, second = (axis.get_window_extent() for axis in figure.axes[:2])
        assert second.height > 0.6 * first.height
    assert [axis.get_title() for axis in figure.axes[::2]] == ["ends", "middle"]
