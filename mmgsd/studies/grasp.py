"""Take the corner that you are surest of: one grasp by one pixel's matches, and what it lifts.

    python -m mmgsd run grasp paper    -> data/results/paper/grasp.json

A policy is shown one corner of a flat cloth, and a picture of another cloth; it grasps at one of the four modes,
carries what it holds to the middle of what it sees, and lets go. A corner is lifted where one then lies within `NEAR`
of the side of that place. A killed run goes on.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from mmgsd.command import Option
from mmgsd.config import DEFAULT_GROUP
from mmgsd.files import write_json
from mmgsd.fold.jobs import act_job, read_state, run_jobs
from mmgsd.fold.measures import SIDES_M, estimate_mean, estimate_share
from mmgsd.fold.state import State
from mmgsd.fold.tasks import GRASP, GROUNDS
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher, load
from mmgsd.paths import Paths, find_root
from mmgsd.studies.bench import Bench, Rollout, find_on_table
from mmgsd.studies.claims import Claim, get, say
from mmgsd.studies.folding import ROLLOUTS, say_beyond, say_share
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Table, make_page_table
from mmgsd.symmetry import load_group

MATCHERS = {"mmgsd": "cloth", "mmgsd_paper": "cloth-paper", "spcl": "cloth-spcl"}  # shipped weights that answer
LABELS = {"mmgsd": "MMGSD", "mmgsd_paper": "MMGSD of clean images alone", "spcl": "SPCL"}
# The narrowest mode, the most probable one, or one at random.
WAYS = {"surest": "the surest corner", "probable": "the most probable", "any": "any"}
NEAR = 0.05  # of the side
CORNERS = load_group(GRASP.object, DEFAULT_GROUP[GRASP.object]).orbit(GRASP.looks[0][0].pick)  # where one was shown

Outcome = dict[str, float | bool]


def list_grasps(count: int) -> list[Rollout]:
    """``count`` rollouts, the starts and the grounds in turn."""
    starts = GRASP.starts
    return [Rollout(GRASP.name, starts[k % len(starts)], GROUNDS[k // len(starts) % len(GROUNDS)], k)
            for k in range(count)]  # fmt: skip


def run(paths: Paths, *, workers: int = 0, progress: bool = True) -> Path:
    """{matcher: {way: `summarise_grasps`}} of a preset's number of rollouts, as ``grasp.json``; its path."""
    how = {"workers": workers, "progress": progress}
    bench = Bench(paths.generated / "folding", how)
    files = bench.make_starts(list_grasps(ROLLOUTS[paths.preset]))
    states = {rollout: read_state(file) for rollout, file in files.items()}
    states = {rollout: state for rollout, state in states.items() if not state.about["fault"]}
    look, results = bench.make_demonstration(GRASP).looks[0], {}
    for name, weights in MATCHERS.items():
        matcher: Matcher = load(weights)
        picks = {r: choose_picks(matcher.match(look.image, state.image, look.moves[:1, 0]), seed=r.seed)
                 for r, state in states.items()}  # fmt: skip
        jobs = {f"{name}-{way}-{r.name}": act_job(files[r], [(pick, find_middle(states[r]))] if pick else [])
                for r, row in picks.items() for way, pick in row.items()}  # fmt: skip
        end_files = run_jobs(jobs, bench.folder / "acts", **how)
        outcomes = {way: {r.name: judge_grasp(states[r], row[way], read_state(end_files[f"{name}-{way}-{r.name}"]))
                          for r, row in picks.items()} for way in WAYS}  # fmt: skip
        results[name] = {way: summarise_grasps(rows, outcomes["any"]) for way, rows in outcomes.items()}
    return write_json(paths.results / "grasp.json", results)


def choose_picks(match: Match, *, seed: int) -> dict[str, list[float] | None]:
    """{way: the pixel [x, y] of one query's answer that it grasps at}; None where the answer abstains."""
    modes = match.modes[0][np.isfinite(match.modes[0]).all(-1)]
    chosen = (match.best().xy[0], modes[0], modes[np.random.default_rng(seed).integers(len(modes))])
    return {way: xy.tolist() if np.isfinite(xy).all() else None for way, xy in zip(WAYS, chosen, strict=True)}


def find_middle(state: State) -> list[float]:
    """The pixel [x, y] of the middle of what is seen of the object."""
    return np.argwhere(state.mask)[:, ::-1].mean(0).tolist()


def judge_grasp(before: State, pick: list[float] | None, after: State) -> Outcome:
    """``distance`` of the grasp to the nearest corner, a share of the side, and whether a corner was ``lifted``.

    No grasp is as far off as the side is long.
    """
    side = SIDES_M[GRASP.object]
    if pick is None:
        return {"distance": 1.0, "lifted": False}
    corners, ends = (state.points[CORNERS, :2] for state in (before, after))
    distance = np.linalg.norm(corners - find_on_table(np.array(pick), before), axis=1).min() / side
    aim = find_on_table(np.array(find_middle(before)), before)
    near = np.linalg.norm(ends - aim, axis=1).min() < NEAR * side
    was = np.linalg.norm(corners - aim, axis=1).min() < NEAR * side
    return {"distance": float(min(distance, 1.0)), "lifted": bool(near and not was and not after.about["fault"])}


def summarise_grasps(rows: Mapping[str, Outcome], others: Mapping[str, Outcome]) -> dict[str, Any]:
    """Mean ``distance``, share ``lifted``, and how much farther than ``others`` the grasps are, ``beyond``."""
    excess = [row["distance"] - others[name]["distance"] for name, row in rows.items()]
    return {"distance": estimate_mean([row["distance"] for row in rows.values()]), "beyond": estimate_mean(excess),
            "lifted": estimate_share([bool(row["lifted"]) for row in rows.values()])}  # fmt: skip


def describe_grasps(results: Results) -> Table | str:
    """Single grasps, a row a matcher and way: distance to the nearest corner, beside any mode, lifted.

    ``results`` are all of a preset.
    """
    if "grasp" not in results:
        return "*Not measured yet.*"
    lines = {f"{label}, {WAYS[way]}": [f"{100 * row['distance']['mean']:.1f} %", say_beyond(row["beyond"]),
                                       say_share(row["lifted"])]
             for name, label in LABELS.items() for way, row in results["grasp"].get(name, {}).items()}  # fmt: skip
    return make_page_table(["distance", "beside any", "lifted"], lines)


def judge_surest(results: Results) -> Claim:
    """What the paper is for: a robot takes the one of the like corners that it is surest of (its introduction)."""
    ways = {"surest": "surest", "most probable": "probable", "any": "any"}
    rows = {way: get(results, "grasp", "mmgsd", key) for way, key in ways.items()}
    high = get(results, "grasp", "mmgsd", "surest", "beyond", "high")
    texts = [f"{way} {say(get(row, 'distance', 'mean'), 'percent')} of the side off, lifted "
             f"{say(get(row, 'lifted', 'mean'), 'percent')}" for way, row in rows.items() if row]  # fmt: skip
    return Claim(
        "surest", "Of the four like corners, a robot should take the one that it is surest of.",
        "One grasp: the surest of the four modes is nearer to a corner than any of them, as far as the 95 % interval "
        "of the difference tells.", "; ".join(texts) or "–", (None if high is None else high < 0,),
        "`.venv/bin/python -m mmgsd run grasp paper`",
    )  # fmt: skip


STUDY = Study("grasp", 100, run, results=("grasp",), tables={"grasp": Shown("paper", describe_grasps)},
              claims=(judge_surest,))  # fmt: skip


def main(
    preset: Annotated[str, Option(choices=ROLLOUTS)],
    *,
    workers: Annotated[int, Option("child processes at once (default: one a core)")] = 0,
) -> None:
    """Grasp with every matcher."""
    print(run(Paths(find_root(), preset), workers=workers))
