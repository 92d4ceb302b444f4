"""What the methods answer: pictures for a reader who has not read a word yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from mmgsd.figures.style import (
    COLUMN_IN,
    MARK,
    PAGE_IN,
    blend_heatmap,
    check_filled,
    make_grid,
    mark_pixel,
    mark_true,
    show_answer,
    show_source,
    styled,
)
from mmgsd.match.match import Match


@styled
def plot_teaser(matches: Mapping[str, Sequence[Match]]) -> Figure:
    """A row an object ({object: matches}), and of each match's first query the source, its matches and the heatmap.

    Lines lead from the pixel to its matches, which have its sign.
    """
    check_filled("matches", matches)
    blocks = max(len(row) for row in matches.values())
    aspects = [_get_aspect(row[0]) for row in matches.values()]
    figure, axes = make_grid(aspects, 3 * blocks, COLUMN_IN if blocks == 1 else PAGE_IN)
    for line, (name, row) in zip(axes, matches.items(), strict=True):
        line[0].set_ylabel(name.capitalize())
        for block, match in enumerate(row):
            source, target, answer = line[3 * block : 3 * block + 3]
            target.imshow(match.image1)
            target.autoscale(False)
            _lead_to_matches(source, target, match)
            show_source(source, match, 0)
            show_answer(answer, match, 0)
    for column, axis in enumerate(axes[0]):
        axis.set_title(("Source", "Matches", "Heatmap")[column % 3])
    return figure


def _lead_to_matches(source: Axes, target: Axes, match: Match) -> None:
    for mode in match.modes[0][np.isfinite(match.modes[0]).all(-1)]:
        ends = {"xyA": tuple(match.xy[0]), "xyB": tuple(mode), "coordsA": source.transData, "coordsB": target.transData}
        for colour, width in (("black", 1.8), (MARK, 0.8)):
            source.figure.add_artist(ConnectionPatch(**ends, color=colour, lw=width, zorder=2))
        mark_pixel(target, *mode)


@styled
def plot_combined(
    answers: Mapping[str, Mapping[str, Match]], true: Mapping[str, np.ndarray], inwards: Mapping[str, Match],
    *, sigma_px: float = 10.0,
) -> Figure:  # fmt: skip
    """A: contrastive answers, B: the true and MMGSD's distribution of the same query, C: queries moved inwards.

    ``answers`` {object: {"pcl", "spcl", "mmgsd": match}}, first query of each, contrastive ones where they are
    trained; ``true`` {object: (n, 2) px}, crosses, and in B Gaussians of ``sigma_px``, wide enough to be seen;
    ``inwards`` {object: match of four queries, extremity first}. Modes are rings with their 1-std ellipses.
    """
    check_filled("answers", answers)
    for name, match in inwards.items():
        if len(match.xy) != 4:
            raise ValueError(f"inwards[{name!r}] must hold 4 queries, got {len(match.xy)}")
    aspects = [_get_aspect(m["mmgsd"]) for m in answers.values()] + [_get_aspect(m) for m in inwards.values()]
    figure, axes = make_grid(aspects, 5, PAGE_IN)
    for line, (name, methods) in zip(axes, answers.items(), strict=False):
        _draw_comparison(line, methods, true[name], sigma_px)
        line[0].set_ylabel(name.capitalize())
    for line, (name, match) in zip(axes[len(answers) :], inwards.items(), strict=True):
        _draw_inwards(line, match)
        line[0].set_ylabel(name.capitalize())
    for axis, title in zip(axes[0], (r"$\bf{A}$  Source", "PCL", "SPCL", r"$\bf{B}$  True", "MMGSD"), strict=True):
        axis.set_title(title)
    if inwards:
        axes[len(answers), 0].set_title(r"$\bf{C}$  Sources 1–4")
    return figure


def _draw_comparison(line: Sequence[Axes], methods: Mapping[str, Match], true: np.ndarray, sigma_px: float) -> None:
    match = methods["mmgsd"]
    show_source(line[0], match, 0)
    for axis, method in zip(line[[1, 2, 4]], ("pcl", "spcl", "mmgsd"), strict=True):
        if method in methods:
            show_answer(axis, methods[method], 0)
            mark_true(axis, true)
        else:
            axis.set_axis_off()
            axis.text(0.5, 0.5, "not trained", ha="center", va="center", fontsize=6, transform=axis.transAxes)
    ys, xs = np.mgrid[: match.image1.shape[0], : match.image1.shape[1]]
    mixture = sum(np.exp(-((xs - x) ** 2 + (ys - y) ** 2) / (2 * sigma_px**2)) for x, y in true)
    line[3].imshow(blend_heatmap(match.image1, mixture))
    mark_true(line[3], true)


def _draw_inwards(line: Sequence[Axes], match: Match) -> None:
    line[0].imshow(match.image0)
    for index, (x, y) in enumerate(match.xy):
        line[0].text(x, y, str(index + 1), ha="center", va="center", fontsize=5.5, zorder=3,
                     bbox={"boxstyle": "circle,pad=0.15", "fc": MARK, "ec": "black", "lw": 0.6})  # fmt: skip
        show_answer(line[index + 1], match, index)
        line[index + 1].set_title(f"{index + 1} · {match.entropy[index]:.1f} nats")


def _get_aspect(match: Match) -> float:
    return match.image1.shape[0] / match.image1.shape[1]
