"""Cloths folded in halves twice: what one picture leaves open, and what a second one, or a film of the fold, adds.

    python -m mmgsd run folded_twice --preset paper    -> data/results/paper/folded_twice.json

The folding bench's physics folds flat cloths by the true matches, on plain ground, and once more by the other order of
folds that ends alike. Questions of three random points of the flat cloth's picture are answered about the folded one's.
States are files: a killed run goes on.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mmgsd.checks import check, check_choice
from mmgsd.files import write_json
from mmgsd.fold.jobs import act_job, film_job, look_job, run_jobs, start_job, true_moves
from mmgsd.fold.measures import estimate_mean
from mmgsd.fold.state import State, read_state
from mmgsd.fold.tasks import Move, Task, find_task
from mmgsd.match.match import RADIUS_PX
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.measure.joint import POINTS, QUESTIONS
from mmgsd.model.heads import Outputs
from mmgsd.model.network import name_hardware
from mmgsd.paths import Paths
from mmgsd.progress import ProgressBar
from mmgsd.studies.bench import Bench, find_on_table
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Table, make_page_table
from mmgsd.studies.tail import list_ways
from mmgsd.symmetry import load_group, load_mirror

CLOTHS = {"smoke": 1, "quick": 6, "paper": 24}
FRAMES = 20  # of a film of each of the two folds
TILT_DEG = 60.0  # from straight down, of the look from aside
SIDE = 25  # points along a side of the cloth
LABELS = {
    "once": "folded once, first joint answer",
    "heaviest": "twice: one picture, heaviest modes",
    "one": "one picture, first joint answer",
    "possible": "one picture, best choice of modes",
    "above": "and a second one from above",
    "aside": "and a second one from aside",
    "film": "a film of both folds, tracked",
    "orders": "all but the order of folds known",
    "outline": "all but the way round of the outline known",
}


@dataclasses.dataclass(frozen=True)
class Folded:
    """A cloth before, after and between two folds; seen again from above and aside; folded in the other order."""

    before: State
    half: State
    after: State
    films: tuple[State, State]
    looks: Mapping[str, State]
    other: State


def run(paths: Paths, *, cloths: int = 0, frames: int = FRAMES, workers: int = 0, progress: bool = True) -> Path:
    """Fold so many ``cloths`` (0: the preset's), ask the shipped weights about them; ``folded_twice.json``.

    ``workers`` child processes at once (0: one a core). ValueError for another preset than those of `CLOTHS`, and where
    physics spoils all cloths.
    """
    check_choice("preset", paths.preset, tuple(CLOTHS))
    bench = Bench(paths.generated / "folding", {"workers": workers, "progress": progress})
    folded = make_folded(bench, count := cloths or CLOTHS[paths.preset], frames)
    check("cloths", count, "more, since physics spoils all of so few", bool(folded))
    file, rows = find_weights("cloth"), []
    matcher = Matcher.load(file)
    for seed, one in ProgressBar(folded.items(), desc="folded twice", unit="cloth", disable=not progress):
        rows.append(measure_cloth(matcher, one, np.random.default_rng(seed)))
    how = {"cloths": len(folded), "spoilt": count - len(folded), "frames": frames, "tilt_deg": TILT_DEG}
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    results: dict[str, Any] = {"run": how | {"sha256": digest, "hardware": name_hardware(matcher.device)}}
    for name in LABELS:  # an interval is over cloths: questions about one are alike
        results[name] = {key: estimate_mean([row[name][key] for row in rows]) for key in rows[0][name]}
    return write_json(paths.results / "folded_twice.json", results)


# Cloths. ------------------------------------------------------------------------------------------------------------


def make_folded(bench: Bench, count: int, frames: int) -> dict[int, Folded]:
    """{seed: a folded cloth} of so many; what physics spoils is left out."""
    task, folder = find_task("twice"), bench.folder / "folded_twice"
    other, seeds = transpose(task), range(count)
    bench.demonstrate([task])
    flat = bench.demonstrated[task.name][0].points

    def make(jobs: dict[str, dict]) -> dict[str, Path]:
        """Their states' files by name."""
        return run_jobs(jobs, folder, **bench.how)

    def move(task: Task, number: int, file: Path) -> list:
        """The true moves (px) of one of a task's two folds."""
        return true_moves(task.looks[number], flat, read_state(file))

    files = make({f"{seed}-before": start_job(task, "flat", "plain", seed) for seed in seeds})
    before = {seed: files[f"{seed}-before"] for seed in seeds}
    for name, folds in {"half": task, "other-half": other}.items():
        files |= make({f"{k}-{name}": act_job(file, move(folds, 0, file)) for k, file in before.items()})
    for name, folds in {"after": task, "other-after": other}.items():
        halves = {seed: files[f"{seed}-{name.replace('after', 'half')}"] for seed in seeds}
        files |= make({f"{k}-{name}": act_job(file, move(folds, 1, file)) for k, file in halves.items()})
    whole = [seed for seed in seeds if not any(read_state(files[f"{seed}-{name}"]).about["fault"]
                                               for name in ("after", "other-after"))]  # fmt: skip
    jobs = {}
    for seed in whole:
        for number, name in enumerate(("before", "half")):
            file = files[f"{seed}-{name}"]
            jobs[f"{seed}-film{number}"] = film_job(file, move(task, number, file), "fold", frames=frames)
        jobs[f"{seed}-above"] = look_job(files[f"{seed}-after"], 1)
        jobs[f"{seed}-aside"] = look_job(files[f"{seed}-after"], 2, tilt_deg=TILT_DEG)
    states = {name: read_state(file) for name, file in (files | make(jobs)).items()}
    return {
        seed: Folded(states[f"{seed}-before"], states[f"{seed}-half"], states[f"{seed}-after"],
                     (states[f"{seed}-film0"], states[f"{seed}-film1"]),
                     {name: states[f"{seed}-{name}"] for name in ("above", "aside")}, states[f"{seed}-other-after"])
        for seed in whole
    }  # fmt: skip


def transpose(task: Task) -> Task:
    """The same folds across the cloth's diagonal: in halves by columns first where they were by rows, and so on."""

    def turn(move: Move) -> Move:
        """One move across the diagonal."""
        row, column = divmod(move.pick, SIDE)
        return Move(SIDE * column + row, (-move.place[1], -move.place[0]))

    return dataclasses.replace(task, looks=tuple(tuple(map(turn, look)) for look in task.looks))


# Answers. -----------------------------------------------------------------------------------------------------------


def measure_cloth(matcher: Matcher, cloth: Folded, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """{row of `LABELS`: share of right questions and error px}, and what the orders and the outline leave open."""
    seen = np.flatnonzero(cloth.before.visible)
    points = rng.choice(seen, QUESTIONS * POINTS, replace=False)
    members = np.array(load_group("cloth", "c4").permutations)
    true = cloth.after.xy.astype(float)[members[:, points]]  # (G, S, 2)
    xy, images = cloth.before.xy[points], (cloth.before.image, cloth.after.image)
    alone, joint = (matcher.match(*images, xy, joint=joint) for joint in (False, True))
    film = np.concatenate([film.image for film in cloth.films])
    answers = {
        "heaviest": alone.modes[:, 0],
        "one": joint.modes[:, 0],
        "film": find_last(matcher.track(film, xy).xy),
        **{name: match_both(matcher, cloth, view, xy) for name, view in cloth.looks.items()},
    }
    rows = {name: score(answer[None], true) for name, answer in answers.items()}
    rows["possible"] = score_choice(alone.modes, true)
    once = matcher.match(cloth.before.image, cloth.half.image, xy, joint=True)
    rows["once"] = score(once.modes[None, :, 0], cloth.half.xy.astype(float)[members[:, points]])
    laid, shifted = lay_onto(cloth.other, cloth.after)
    orders = [cloth.after.xy.astype(float), laid]
    orbits = list(members.T)
    ways = list_ways(orders[0], cloth.after.mask, load_mirror("cloth"), orbits)
    for name, candidates in {"orders": orders, "outline": ways}.items():
        rows[name] = score_open(candidates, members, points)
    overlap = (shifted & cloth.after.mask).sum() / (shifted | cloth.after.mask).sum()
    distance = score(laid[points][None], true)["error"]
    rows["orders"] |= {"overlap": float(overlap), "distance_px": distance}
    rows["outline"] |= {"ways": float(len(ways))}
    return rows


def find_last(xy: np.ndarray) -> np.ndarray:
    """(S, 2) px, where tracks (T, S, 2) have their points last: NaN are frames in which the object is not seen."""
    known = np.isfinite(xy).all(-1)
    last = len(xy) - 1 - known[::-1].argmax(0)
    return xy[last, np.arange(xy.shape[1])]


def match_both(matcher: Matcher, cloth: Folded, view: State, xy: np.ndarray) -> np.ndarray:
    """(S, 2) px, the first joint answer in the folded cloth's picture and in another view of it.

    The view is laid onto the picture as the table is seen in both, and both descriptions are averaged.
    """
    pair = matcher.prepare(cloth.before.image, cloth.after.image)
    laid = matcher.describe([rectify(view, cloth.after)])[0]
    both = dataclasses.replace(pair, outputs=(pair.outputs[0], Outputs.mean([pair.outputs[1], laid])))
    return both.match(xy, joint=True).modes[:, 0]


def rectify(view: State, onto: State) -> np.ndarray:
    """(H, W, 3) uint8, a state's picture as the camera of another state would see it, were all of it on the table."""
    height, width = onto.mask.shape
    corners = np.array([(0, 0), (width - 1, 0), (width - 1, height - 1), (0, height - 1)], float)
    there = view.project(np.column_stack([find_on_table(corners, onto), np.zeros(4)]))
    warp = cv2.getPerspectiveTransform(there.astype(np.float32), corners.astype(np.float32))
    return cv2.warpPerspective(view.image, warp, (width, height), borderMode=cv2.BORDER_REPLICATE)


def score(answers: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Share of questions that are ``right``, and their mean ``error`` (px), of the best of some answers (A, S, 2).

    Right is a question of `POINTS` points that one member of the symmetry takes all to within `RADIUS_PX`; its error is
    the root mean square over the points, under the member that fits best. ``true`` is (G, S, 2) px.
    """
    distance = np.nan_to_num(np.linalg.norm(answers[:, None] - true[None], axis=-1), nan=np.inf)  # (A, G, S)
    distance = distance.reshape(*distance.shape[:2], -1, POINTS)
    right = (distance < RADIUS_PX).all(-1).any((0, 1))
    error = np.sqrt(np.square(distance).mean(-1)).min((0, 1))
    return {"right": float(right.mean()), "error": float(error.mean())}


def score_choice(modes: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """As `score`, of the mode of each point (S, n, 2) that is nearest to a member's match: the best choice."""
    distance = np.nan_to_num(np.linalg.norm(modes[None] - true[:, :, None], axis=-1), nan=np.inf)  # (G, S, n)
    chosen = distance.argmin(-1)  # (G, S)
    return score(modes[np.arange(len(modes)), chosen], true)


def score_open(ways: Sequence[np.ndarray], members: np.ndarray, points: np.ndarray) -> dict[str, float]:
    """As `score`, of the one of several ``ways`` (P, 2) px that errs least where each is as likely to be the truth."""
    scores = [[score(answer[points][None], truth[members[:, points]]) for truth in ways] for answer in ways]
    means = [{key: float(np.mean([row[key] for row in rows])) for key in ("right", "error")} for rows in scores]
    return min(means, key=lambda mean: mean["error"])


def lay_onto(other: State, onto: State) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 2) px and outline (H, W) bool of a state, shifted until its middle is that of another one's."""
    middles = [np.argwhere(state.mask)[:, ::-1].mean(0) for state in (other, onto)]
    shift = middles[1] - middles[0]
    mask = cv2.warpAffine(other.mask.astype(np.uint8), np.column_stack([np.eye(2), shift]), onto.mask.shape[::-1]) > 0
    return other.xy.astype(float) + shift, mask


# Tables. ------------------------------------------------------------------------------------------------------------


def describe_folded(results: Results) -> Table:
    """The rows of `LABELS`: right questions and the error, with 95 % intervals over cloths.

    Where all cloths are alike there is no interval.
    """

    def say(estimate: Mapping[str, Any], scale: float, form: str, unit: str) -> str:
        """A cell of the table."""
        mean, low, high = (format(scale * estimate[key], form) for key in ("mean", "low", "high"))
        return f"{mean}{unit}" + (f" ({low} to {high})" if low != high else "")

    lines = {label: [say(results[name]["right"], 100, ".0f", " %"), say(results[name]["error"], 1, ".1f", "")]
             for name, label in LABELS.items()}  # fmt: skip
    return make_page_table(["right", "error px"], lines)


def make_folded_sentence(results: Results) -> str:
    """How many cloths there are, and what the orders of folds and the outline leave open."""
    count, ways = results["run"]["cloths"], results["outline"]["ways"]["mean"]
    overlap, distance = (results["orders"][key]["mean"] for key in ("overlap", "distance_px"))
    return (f"{count} cloths. Two orders of folds: outlines overlap by {100 * overlap:.0f} %, matches are "
            f"{distance:.1f} px apart; an outline fits {ways:.1f} ways round.")  # fmt: skip


STUDY = Study(
    "folded_twice", 167, run, results=("folded_twice",),
    tables={
        "folded_twice": Shown("paper/folded_twice.json", describe_folded),
        "folded_twice_orders": Shown("paper/folded_twice.json", make_folded_sentence),
    },
)  # fmt: skip
