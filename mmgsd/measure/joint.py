"""Do the answers to several pixels belong together? Questions of three random points, answered jointly and one by one.

The test images of the presets `SETS` have to be rendered. A question is right where one member of the symmetry takes
all its points to within `RADIUS_PX` of the chosen modes. Answers are chosen four ways: each point's heaviest mode; the
best choice that the modes allow, for which one has to know the truth; the first joint answer (`mmgsd.match.joint`); and
all joint answers, of which the share that is right counts. A fifth share says what sorting alone loses: the one of true
matches, shuffled and sorted as modes are.
"""

from __future__ import annotations

import hashlib
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mmgsd.config import DEFAULT_GROUP, OBJECTS, EvaluateConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.joint import PLACES, join
from mmgsd.match.match import RADIUS_PX, Match
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.measure.questions import draw_pairs
from mmgsd.model.network import name_hardware
from mmgsd.paths import Paths
from mmgsd.progress import ProgressBar
from mmgsd.symmetry import locate_points

SETS = ("paper", "workspace")  # presets whose test images are asked about
PAIRS, QUESTIONS, POINTS = 200, 3, 3  # pairs of images, questions about each, points of a question
CHOSEN = ("heaviest", "possible", "joint", "any_joint", "true_modes")  # shares of right questions
SWAPS = ("swaps_heaviest", "swaps_joint")  # shares of two right points of a question that belong to two members
RESULTS = "joint.json"


def measure_joint(name: str, root: Path, *, pairs: int = PAIRS, progress: bool = True) -> dict[str, Any]:
    """The row of shipped weights: of each of `SETS` `summarise_questions`, of all and by the second image's state.

    And how many milliseconds a joint answer takes and one that is not, the median over the pairs. FileNotFoundError
    where weights or images are missing.
    """
    file = find_weights(name)
    matcher = Matcher.load(file)
    row: dict[str, Any] = {"object": matcher.object, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for preset in SETS:
        data = load_dataset(Paths(root, preset).dataset(matcher.object), "test")
        scores_by_state: dict[str, list[dict[str, float]]] = {"all": []}
        drawn, rng = draw_pairs(data, EvaluateConfig(pairs=pairs)), np.random.default_rng(0)
        for first, second in ProgressBar(drawn, desc=f"{name}, {preset}", unit="pair", disable=not progress):
            seen = np.flatnonzero(data.visible[first])
            if len(seen) < QUESTIONS * POINTS:
                continue
            points = rng.choice(seen, QUESTIONS * POINTS, replace=False)
            images, matches = (data.load_image(first), data.load_image(second)), {}
            for joint in (False, True):
                begun = time.perf_counter()
                matches[joint] = matcher.match(*images, data.xy[first][points], joint=joint)
                seconds[joint].append(time.perf_counter() - begun)
            sorted_true = sort_true_matches(data, (first, second), points, np.random.default_rng([first, second]))
            scores = score_questions(data, second, points, matches[False], matches[True], sorted_true)
            scores_by_state["all"] += scores
            scores_by_state.setdefault(str(data.labels.state[second]), []).extend(scores)
        row[preset] = {kind: summarise_questions(scores) for kind, scores in sorted(scores_by_state.items())}
    took = {joint: round(1000 * statistics.median(values)) for joint, values in seconds.items()}
    row["milliseconds"] = {"joint": took[True], "alone": took[False]}
    return row | {"hardware": name_hardware(matcher.device)}


def sort_true_matches(
    data: Dataset, pair: tuple[int, int], points: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """(S, n, 2) px, the true matches of material ``points`` (S,), shuffled and then sorted by `join`.

    The places that it is helped by are further points that the first image shows; of each it is told where it lies on
    a cloth or rope.
    """
    first, second = pair
    others = np.setdiff1d(np.flatnonzero(data.visible[first]), points)
    places = rng.choice(others, min(PLACES, len(others)), replace=False)
    numbers = np.concatenate([points, places])
    true = data.xy[second][_list_members(data)[:, numbers].T].astype(float)  # (S + P, n, 2)
    true = np.take_along_axis(true, rng.random(true.shape[:2]).argsort(1)[..., None], 1)
    even = np.full(true.shape[:2], 1 / true.shape[1])
    xy, spread = data.xy[first, numbers].astype(float), np.ones_like(even)
    located = locate_points(data.object)[_list_members(data)[:, numbers]] if data.object in OBJECTS else None
    order = join(xy, data.load_mask(first), true, even, spread, places=len(places), located=located)
    return np.take_along_axis(true, order[..., None], 1)[: len(points)]


def _list_members(data: Dataset) -> np.ndarray:
    """(G, P) where each member of the symmetry takes the material points."""
    return np.array(data.group(DEFAULT_GROUP.get(data.object, "")).permutations)


def score_questions(
    data: Dataset, second: int, points: np.ndarray, alone: Match, joint: Match, sorted_true: np.ndarray
) -> list[dict[str, float]]:
    """Of each question of `POINTS` of material ``points`` (S,), whether the ways of `CHOSEN` are right; its swaps.

    ``sorted_true`` are of `sort_true_matches`. A measure that a question has not, NaN: swaps of fewer than two points
    that are right each by itself.
    """
    members = _list_members(data)[:, points]
    true = data.xy[second][members].astype(float)  # (G, S, 2)
    ways = {"alone": alone.modes, "joint": joint.modes, "true": sorted_true}
    near = {name: np.linalg.norm(modes[None] - true[:, :, None], axis=-1) < RADIUS_PX for name, modes in ways.items()}
    rows = []
    for start in range(0, len(points), POINTS):
        one, all_, exact = (near[name][:, start : start + POINTS] for name in ways)  # (G, POINTS, n)
        rows.append({"heaviest": float(one[:, :, 0].all(1).any()),
                     "possible": float(one.any(2).all(1).any()),
                     "joint": float(all_[:, :, 0].all(1).any()),
                     "any_joint": float(all_.all(1).any(0).mean()),
                     "true_modes": float(exact.all(1).any(0).mean()),
                     "swaps_heaviest": _measure_swaps(one[:, :, 0]),
                     "swaps_joint": _measure_swaps(all_[:, :, 0])})  # fmt: skip
    return rows


def _measure_swaps(near: np.ndarray) -> float:
    """Of pairs of points that are right (G, S) each by itself, the share that no member explains together."""
    right = np.flatnonzero(near.any(0))
    pairs = [(i, j) for i in right for j in right if i < j]
    return float(np.mean([not (near[:, i] & near[:, j]).any() for i, j in pairs])) if pairs else float("nan")


def summarise_questions(scores: list[dict[str, float]]) -> dict[str, float]:
    """{measure: mean over questions, "questions": how many}; None where no question has the measure."""
    means = pd.DataFrame(scores, columns=[*CHOSEN, *SWAPS], dtype=float).mean()
    rounded = {name: None if np.isnan(mean) else round(float(mean), 4) for name, mean in means.items()}
    return {"questions": len(scores), **rounded}
