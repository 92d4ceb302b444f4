"""Points through films of objects that are folded, turned and hidden: do they stay where, and what, they are?

    python -m mmgsd run tracking paper    -> data/results/paper/tracking.json, figures/paper/tracking

The folding bench's physics makes the films (`mmgsd.fold.jobs.film_job`), with truth for every frame. `METHODS` follow
`POINTS` of those that the first frame shows. Films and answers are files: a killed run goes on.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.checks import check_choice
from mmgsd.command import Option
from mmgsd.config import DEFAULT_GROUP, IMAGE_SIZE, OBJECTS
from mmgsd.figures.style import PAGE_IN, finish_axes, save_figure, styled
from mmgsd.files import write_json
from mmgsd.fold.jobs import film_job, run_jobs, true_moves
from mmgsd.fold.state import State, read_state
from mmgsd.fold.tasks import GROUNDS, MOTIONS, TASKS, find_task
from mmgsd.match import matcher
from mmgsd.match.match import LIKELY
from mmgsd.match.matcher import find_weights
from mmgsd.measure.tracking import Truth, average_tracks, measure_track
from mmgsd.paths import Paths, find_root
from mmgsd.progress import ProgressBar
from mmgsd.studies.bench import Bench, Rollout, read_kept
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Column, Table
from mmgsd.symmetry import load_group

VERSION = 3  # to be raised where a method answers the same film otherwise than before
FILMS = {"smoke": 1, "quick": 8, "paper": 30}  # of each object
FRAMES, SCALE = 32, 1.0  # of a film; of its sides, by those of a rendered data set's image
POINTS = {"cloth": [25 * r + c for r in range(0, 25, 6) for c in range(0, 25, 6)],
          "rope": list(range(0, 625, 26))}  # fmt: skip
CONSISTENT_PX = 2.0  # a point that flow takes there and back to so near is seen
HEADS = {"delta": "δ_avg", "swaps": "swaps", "taken": "at a like point", "occlusion": "occlusion", "jaccard": "Jaccard"}
COLUMNS = [Column(key, page=head, scale=100) for key, head in HEADS.items()]

Answer = tuple[np.ndarray, np.ndarray]  # (T, S, 2) px, and (T, S) bool, whether the point is seen
Follow = Callable[[str, np.ndarray, np.ndarray], Answer]  # of an object's frames (T, H, W, 3) and first pixels (S, 2)

load = cache(matcher.load)  # the shipped weights of an object


@dataclass(frozen=True)
class Method:
    """A row: who follows, and whether with shipped weights."""

    label: str
    colour: str
    follow: Follow
    learnt: bool = True


def track(object: str, frames: np.ndarray, xy: np.ndarray) -> Answer:
    """`Matcher.track`."""
    tracks = load(object).track(frames, xy)
    return tracks.xy, tracks.visible > LIKELY


def match_each(object: str, frames: np.ndarray, xy: np.ndarray, *, nearest: bool) -> Answer:
    """Each frame's most probable mode, or the one ``nearest`` to the last frame's, each point by itself."""
    places, seen, rows = [xy], [np.ones(len(xy), bool)], np.arange(len(xy))
    for match in load(object).match_many((frames[0], frame, xy) for frame in frames[1:]):
        distance = np.nan_to_num(np.linalg.norm(match.modes - places[-1][:, None], axis=-1), nan=np.inf)
        chosen = distance.argmin(1) if nearest else 0 * rows
        places.append(match.modes[rows, chosen])
        seen.append(match.visible[rows, chosen] > LIKELY)
    return np.stack(places), np.stack(seen)


def flow_lucas_kanade(object: str, frames: np.ndarray, xy: np.ndarray) -> Answer:
    """OpenCV's pyramidal Lucas and Kanade, from each frame to the next."""

    def step(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (P, 2) px are a frame later, and which (P,) were followed."""
        moved, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points.astype(np.float32)[:, None], None)
        return moved[:, 0], status[:, 0] > 0

    return _chain(frames, xy, step)


def flow_dis(object: str, frames: np.ndarray, xy: np.ndarray) -> Answer:
    """OpenCV's dense inverse search (Kroeger et al., ECCV 2016), from each frame to the next."""
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def step(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (P, 2) px are a frame later, and which (P,) were followed."""
        x, y = np.moveaxis(points.astype(np.float32), -1, 0)
        flow = cv2.remap(search.calc(before, after, None), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return points + flow.reshape(-1, 2), np.ones(len(points), bool)

    return _chain(frames, xy, step)


def _chain(frames: np.ndarray, xy: np.ndarray, step: Callable[..., tuple[np.ndarray, np.ndarray]]) -> Answer:
    """Points taken on from frame to frame; seen are those that come back, inside the picture."""
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    places, seen = [xy.astype(float)], [np.ones(len(xy), bool)]
    for before, after in zip(grey, grey[1:], strict=False):
        moved, followed = step(before, after, places[-1])
        back, _ = step(after, before, moved)
        inside = ((moved >= 0) & (moved <= np.array(after.shape[::-1]) - 1)).all(1)
        seen.append(followed & inside & (np.linalg.norm(back - places[-1], axis=1) < CONSISTENT_PX))
        places.append(moved)
    return np.stack(places), np.stack(seen)


METHODS = {
    "track": Method("MMGSD, tracked", "#D55E00", track),
    "nearest": Method("MMGSD, mode nearest to the last", "#F0A070", partial(match_each, nearest=True)),
    "alone": Method("MMGSD, most probable mode", "#A6761D", partial(match_each, nearest=False)),
    "lucas_kanade": Method("Lucas–Kanade, chained", "#0072B2", flow_lucas_kanade, learnt=False),
    "dis": Method("DIS flow, chained", "#009E73", flow_dis, learnt=False),
}


def run(
    paths: Paths, *, count: int = 0, frames: int = FRAMES, scale: float = SCALE, workers: int = 0,
    progress: bool = True,
) -> Path:  # fmt: skip
    """Follow points through the films of a preset and write what is measured, and its figure; the results' path.

    ``count`` films of each object (0: the preset's), of so many ``frames`` whose sides are ``scale`` times the data
    set's; ``workers`` child processes render at once (0: one a core). ValueError for another preset.
    """
    check_choice("preset", paths.preset, tuple(FILMS))
    count, how = count or FILMS[paths.preset], {"workers": workers, "progress": progress}
    results: dict[str, Any] = {"run": {"films": count, "frames": frames, "scale": scale}, "methods": {}}
    for object in OBJECTS:
        films = make_films(object, Bench(paths.generated / "folding", how), count, frames, scale)
        pairs = [(name, film) for name in METHODS for film in films]
        bar = ProgressBar(pairs, desc=f"track, {object}", unit="film", disable=not progress)
        measured = {(name, film): measure_film(name, films[film], paths.generated / "tracking" / f"{name}-{film}.json")
                    for name, film in bar}  # fmt: skip
        results["methods"][object] = {name: summarise({film: measured[name, film] for film in films})
                                      for name in METHODS}  # fmt: skip
    save_figure(plot_tracking(results), paths.figures / "tracking", kinds=("png",))
    return write_json(paths.results / "tracking.json", results)


def list_films(object: str, count: int) -> dict[str, Rollout]:
    """{name, a motion first: first state} of so many films: motions in turn, then grounds, tasks and their starts."""
    kinds = [(task.name, start) for task in TASKS.values() if task.object == object for start in task.starts]
    rounds = [k // len(MOTIONS) for k in range(count)]
    return {f"{MOTIONS[k % len(MOTIONS)]}-{object}-{k}": Rollout(*kinds[r % len(kinds)], GROUNDS[r % len(GROUNDS)], k)
            for k, r in enumerate(rounds)}  # fmt: skip


def make_films(object: str, bench: Bench, count: int, frames: int, scale: float) -> dict[str, Path]:
    """The films' files by name; what physics spoils is left out."""
    rollouts = list_films(object, count)
    starts = bench.make_starts(list(rollouts.values()))
    size, jobs = tuple(round(side * scale) for side in IMAGE_SIZE[object]), {}
    for name, rollout in rollouts.items():
        state = read_state(starts[rollout])
        if not state.about["fault"]:
            moves = true_moves(find_task(rollout.task).looks[0], bench.demonstrated[rollout.task][0].points, state)
            motion = name.partition("-")[0]
            jobs[name] = film_job(starts[rollout], moves, motion, frames=frames, size=size)
    files = run_jobs(jobs, bench.folder / "films", **bench.how)
    return {name: file for name, file in files.items() if not read_state(file).about["fault"]}


def measure_film(name: str, file: Path, out: Path) -> dict[str, float]:
    """What `measure_track` says of a method's answer about a film, which is kept in ``out`` and not asked for again."""
    film, method = read_state(file), METHODS[name]
    weights = find_weights(film.about["object"]).read_bytes() if method.learnt else b""
    mark = {"film": film.about["mark"], "weights": hashlib.sha256(weights).hexdigest(), "version": VERSION}
    stored, (points, truth) = read_kept(out, mark), find_truth(film)
    if stored is None:
        xy, seen = method.follow(film.about["object"], film.image, film.xy[0, points])
        places = np.where(np.isfinite(xy), np.round(np.asarray(xy, float), 2), None)
        stored = {"mark": mark, "xy": places.tolist(), "visible": np.asarray(seen, bool).tolist()}
        write_json(out, stored)
    return measure_track(np.array(stored["xy"], float), np.array(stored["visible"]), truth)


def find_truth(film: State) -> tuple[np.ndarray, Truth]:
    """The material points (S,) that are asked for, and where they and those like them are."""
    object, all_points = film.about["object"], np.array(POINTS[film.about["object"]])
    points = all_points[film.visible[0, all_points]]
    likes = load_group(object, DEFAULT_GROUP[object]).permutations[1:, points]  # (G, S)
    xy = film.xy.astype(float)
    return points, Truth(xy[:, points], film.visible[:, points], xy[:, likes], film.image.shape[2:0:-1])


def summarise(measured: Mapping[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    """Means over all films and over those of each motion, and how many there are."""
    kinds = {motion: [row for film, row in measured.items() if film.startswith(motion)] for motion in MOTIONS}
    groups = {"all": list(measured.values())} | kinds
    return {kind: average_tracks(rows) | {"films": len(rows)} for kind, rows in groups.items() if rows}


def describe_tracking(results: Results) -> Table:
    """The measures of `HEADS` of each method, an object below the other."""
    rows = {method.label: {object: results["methods"][object][name]["all"] for object in OBJECTS}
            for name, method in METHODS.items()}  # fmt: skip
    return Table(" ", {"": COLUMNS}, rows, OBJECTS)


def make_films_sentence(results: Results) -> str:
    """What was measured, for beside the table."""
    counts = [f"{results['methods'][object]['track']['all']['films']} films of a {object}" for object in OBJECTS]
    return (f"{' and '.join(counts)}, {results['run']['frames']} frames each: folds, half turns, grippers in front, a "
            "hand across. δ_avg, occlusion accuracy and average Jaccard are TAP-Vid's, at 256 × 256 px; a swap is "
            "nearer to a like point's place than to its own, where those are over 16 px apart; at a like point is "
            "within 16 px of that one alone.")


@styled
def plot_tracking(results: Results) -> Figure:
    """δ_avg and swaps of each method, a panel each, by object."""
    panels = {"delta": "δ_avg (%)", "swaps": "Identity swaps (%)"}
    drawn, axes = plt.subplots(1, 2, figsize=(PAGE_IN, 0.7 + 0.35 * len(METHODS)), layout="constrained", sharey=True)
    for axis, (key, label) in zip(axes, panels.items(), strict=True):
        for row, object in enumerate(OBJECTS):
            values = [100 * results["methods"][object][name]["all"][key] for name in METHODS]
            bars = axis.barh(np.arange(len(METHODS)) + 0.4 * row - 0.2, values, height=0.36, alpha=1 - 0.45 * row,
                             color=[method.colour for method in METHODS.values()])  # fmt: skip
            axis.bar_label(bars, [f"{object}, {value:.0f}" for value in values], padding=2, fontsize=6)
        axis.set(xlabel=label, xlim=(0, 112))
    axes[0].set_yticks(range(len(METHODS)), [method.label for method in METHODS.values()])
    axes[0].invert_yaxis()
    return finish_axes(drawn)


STUDY = Study(
    "tracking", 150, run, results=("tracking",),
    tables={
        "tracking": Shown("paper/tracking.json", describe_tracking),
        "films": Shown("paper/tracking.json", make_films_sentence),
    },
)  # fmt: skip


def main(
    preset: Annotated[str, Option(choices=tuple(FILMS))],
    *,
    count: Annotated[int, Option("films of each object (default: the preset's)")] = 0,
    frames: Annotated[int, Option(f"of a film (default: {FRAMES})")] = FRAMES,
    scale: Annotated[float, Option("of a frame's sides (default: 1, full size)")] = SCALE,
    workers: Annotated[int, Option("child processes at once (default: one a core)")] = 0,
) -> None:
    """Follow points through the films of a preset."""
    print(run(Paths(find_root(), preset), count=count, frames=frames, scale=scale, workers=workers))
