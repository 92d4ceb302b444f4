"""The contact sheet of what was answered about photographs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from mmgsd.figures.plots import shrink_match
from mmgsd.figures.style import PAGE_IN, make_grid, mark_true, show_answer, show_source, styled

if TYPE_CHECKING:
    from mmgsd.match.match import Match
    from mmgsd.measure.photographs import Photograph

COLUMNS = 6  # three photographs a row, each beside what it was asked from
MOST = 60  # photographs on one sheet


class ContactSheet:
    """Collects the first answer about each photograph, made small, and draws them together."""

    def __init__(self) -> None:
        self._panels: dict[Path, tuple[Match, np.ndarray]] = {}

    def add(self, photograph: Photograph, match: Match) -> None:
        """Keep the answer to the first query, unless there is one about this photograph, or `MOST` of others."""
        if photograph.path not in self._panels and len(self._panels) < MOST:
            small = shrink_match(match[0])
            scale = np.divide(small.image1.shape[1::-1], match.image1.shape[1::-1])
            self._panels[photograph.path] = small, (photograph.xy + 0.5) * scale - 0.5

    @styled
    def plot(self) -> Figure:
        """Where each question was, and beside it the answer with crosses at the marked places. ValueError for none."""
        if not self._panels:
            raise ValueError("the sheet must not be empty")
        matches = [match for match, _ in self._panels.values()]
        aspects = [max(image.shape[0] / image.shape[1] for image in (m.image0, m.image1)) for m in matches]
        rows = [max(aspects[k : k + COLUMNS // 2]) for k in range(0, len(matches), COLUMNS // 2)]
        figure, axes = make_grid(rows, COLUMNS, PAGE_IN)
        for axis in axes.flat[2 * len(matches) :]:
            axis.set_axis_off()
        for (path, (match, xy)), (source, answer) in zip(self._panels.items(), axes.reshape(-1, 2), strict=False):
            show_source(source, match, 0)
            show_answer(answer, match, 0)
            mark_true(answer, xy)
            source.set_title(path.name, loc="left")
        return figure
