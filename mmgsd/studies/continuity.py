"""Do the matches of neighbouring material points neighbour each other? MMGSD beside SPCL, both of clean images alone.

    python -m mmgsd run continuity    the shipped weights about the sample -> data/results/paper/continuity.json
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.config import OBJECTS, EvaluateConfig
from mmgsd.dataset import Dataset
from mmgsd.files import write_json
from mmgsd.match.matcher import Matcher
from mmgsd.measure.metrics import assign_modes
from mmgsd.measure.questions import draw_pairs
from mmgsd.measure.regions import SIDE
from mmgsd.paths import Paths, find_root
from mmgsd.progress import ProgressBar
from mmgsd.studies.claims import Claim, get, is_better, list_shares
from mmgsd.studies.registry import Results, Study
from mmgsd.studies.sample import PAPER_SIZE, load_sample, load_shipped

JUMP_PX = 20.0  # by which two neighbours' errors differ where a match jumps
PAIRS = EvaluateConfig(pairs=20)


def measure_jumps(matcher: Matcher, data: Dataset, *, config: EvaluateConfig = PAIRS) -> dict[str, Any]:
    """``jumps``, the share of neighbouring points' matches that jump, of so many ``neighbours``.

    A match jumps where its offset from the true one differs by more than `JUMP_PX` from the neighbour's, of the same
    member of the symmetry. Of points that the source shows and that have as many matches as the symmetry has members.
    """
    group, jumps = data.group(), []
    pairs = ProgressBar(draw_pairs(data, config), desc="continuity", leave=False)
    for first, second in pairs:
        points = np.flatnonzero(data.visible[first] & (group.count_modes(np.arange(data.n_points)) == group.order))
        modes = matcher.match(data.load_image(first), data.load_image(second), data.xy[first, points], n=group.order)
        true = data.xy[second][group.orbit(points)]  # (S, G, 2), a member of the group each
        offsets = np.full((data.n_points, group.order, 2), np.nan)
        assigned = assign_modes(modes.modes, true)[..., None]
        offsets[points] = np.take_along_axis(modes.modes, assigned, 1) - true
        neighbours = _list_neighbours(offsets, data)
        difference = np.concatenate([np.linalg.norm(a - b, axis=-1).ravel() for a, b in neighbours])
        jumps.append(difference[np.isfinite(difference)] > JUMP_PX)
    is_jump = np.concatenate(jumps)
    return {"jumps": round(float(is_jump.mean()), 4), "neighbours": len(is_jump)}


def _list_neighbours(offsets: np.ndarray, data: Dataset) -> list[tuple[np.ndarray, np.ndarray]]:
    """Values (625, …) of points beside those of their neighbours: along a rope, or a cloth's rows and columns."""
    if data.object != "cloth":
        return [(offsets[1:], offsets[:-1])]
    grid = offsets.reshape(SIDE, SIDE, *offsets.shape[1:])
    return [(grid[1:], grid[:-1]), (grid[:, 1:], grid[:, :-1])]


def run(paths: Paths) -> Path:
    """Measure the shipped weights that learnt from the paper's images alone; continuity.json."""
    rows = {name: {method: measure_jumps(load_shipped(name, method), load_sample(paths.root, name))
                   for method in PAPER_SIZE} for name in OBJECTS}  # fmt: skip
    return write_json(paths.results / "continuity.json", rows)


def judge_continuous(results: Results) -> Claim:
    """Whether neighbouring pixels have neighbouring matches."""
    jumps = {m: {name: get(results, "continuity", name, m, "jumps") for name in OBJECTS} for m in PAPER_SIZE}
    parts = (*(is_better(jumps["mmgsd"][name], jumps["spcl"][name]) for name in OBJECTS), None)
    texts = [f"{m.upper()}: {list_shares(row, 'permille')}" for m, row in jumps.items()]
    return Claim(
        "continuous", "SPCL's answers are discontinuous; MMGSD's are more continuous.",
        "Fewer of MMGSD's matches jump from one material point to its neighbour, a part each object; so they do where "
        "both have dense supervision, or neither, a part not measured.",
        f"jumps, {'; '.join(texts)}; MMGSD with dense supervision, SPCL without; the sample's images, one seed", parts,
        "`.venv/bin/python -m mmgsd run continuity`", PAPER_SIZE,
    )  # fmt: skip


STUDY = Study("continuity", 40, run, results=("continuity",), claims=(judge_continuous,))


def main() -> None:
    """Measure the shipped weights that learnt from the paper's images alone."""
    print(run(Paths(find_root(), "paper")))
