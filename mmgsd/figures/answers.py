"""What the methods answer: pictures for a reader who has not read a word yet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from mmgsd.figures.style import (
    COLUMN_IN,
    MARK,
    PAGE_IN,
    check_filled,
    make_grid,
    mark_pixel,
    show_answer,
    show_source,
    styled,
)

if TYPE_CHECKING:
    from mmgsd.match.match import Match


@styled
def plot_teaser(matches: Mapping[str, Sequence[Match]]) -> Figure:
    """A row an object ({object: matches}), and of each match's first query the source, its matches and the heatmap.

    Lines lead from the pixel to its matches, which have its sign.
    """
    check_filled("matches", matches)
    blocks = max(len(row) for row in matches.values())
    aspects = [get_aspect(row[0]) for row in matches.values()]
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


def get_aspect(match: Match) -> float:
    """Height by width of the target's image."""
    return match.image1.shape[0] / match.image1.shape[1]
