"""Why one match is nearly as good as all of them, and when it is not: models trained on poses within ± a limit.

    python -m mmgsd run pose_range              -> data/results/quick/pose_range.json; a killed call goes on
    python -m mmgsd run pose_range --set objects=cloth --set seeds=1 --set folds=0

Cross-entropy is linear in its target: where each labelling of what is seen is as probable as any other, the mean of
one-match targets is the mixture of all matches, and Unimodal a noisier estimate of MMGSD's objective. Where the object
always arrives about the same way round, its labelling can be told from its pose, and a one-match model learns it.
Nothing is turned by augmentation here: a limit is that of the rendered images. The first seed's models fold, too, from
states that are seen within the same limit.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.checks import read_count
from mmgsd.config import OBJECTS, TrainConfig, load_preset
from mmgsd.figures.style import PAGE_IN, finish_axes, save_figure, styled
from mmgsd.fold.moves import AGREE
from mmgsd.learn.training import train_model
from mmgsd.measure.evaluation import read_results, write_results
from mmgsd.paths import Paths
from mmgsd.progress import ProgressBar
from mmgsd.scene.stage import render_dataset
from mmgsd.studies.bench import Bench, list_limited, measure_success
from mmgsd.studies.claims import MARGIN, Claim, get, say
from mmgsd.studies.matrix import list_missing, measure_each, train_and_measure
from mmgsd.studies.models import ROWS, Model, configure_study, get_colour, get_label, get_line_style
from mmgsd.studies.parameters import choose_objects
from mmgsd.studies.policies import Policy
from mmgsd.studies.registry import Finding, Results, Shown, Study, read_table
from mmgsd.studies.seeds import Tested, compare_seeds, list_seeds, mark_tested, say_count, say_p, say_seeds
from mmgsd.studies.table import Column, Table

LIMITS_DEG = (15, 45, 90, 180)  # of the object's turn, both ways; the last is any
METHODS = ("mmgsd", "unimodal", "spcl", "pcl")
SEEDS = 3
FOLDS = 24  # rollouts within each limit
NARROW = (15, 45)  # limits within which a pose tells the labelling: no more than half of the turn that looks alike


def list_models(preset: str, object: str, seeds: int) -> dict[str, TrainConfig]:
    """{"mmgsd-0": training} of each method and seed; the limit is the images', not the training's."""
    rows = [Model(f"{method}-{seed}", ROWS[method].label, method, {"seed": seed, "rotate": False}, ("pose_range",))
            for method in METHODS for seed in range(seeds)]  # fmt: skip
    return configure_study(load_preset(preset), object, "pose_range", rows)


def render_limited(paths: Paths, object: str, limit: int) -> Path:
    """The images of an object turned by no more than ``limit`` (°), of any turn those of the preset; their folder."""
    scene = load_preset(paths.preset).render[object]
    limited = dataclasses.replace(scene, rotation_deg=float(limit))
    folder = paths.dataset(object) if limited == scene else paths.generated / "pose_range" / f"{object}-{limit}"
    return render_dataset(limited, folder)


def check(
    paths: Paths, *, seeds: int = SEEDS, objects: str | Sequence[str] = OBJECTS, folds: int = FOLDS
) -> None:  # fmt: skip
    """ValueError for other numbers of seeds and folds than from 1 and 0 on, and for objects without such a symmetry."""
    read_count("folds", folds)
    if read_count("seeds", seeds) < 1:
        raise ValueError(f"seeds must be at least 1, got {seeds}")
    choose_objects(objects)


def run(
    paths: Paths, *, seeds: int = SEEDS, objects: str | Sequence[str] = OBJECTS, folds: int = FOLDS
) -> Path:  # fmt: skip
    """Render each limit's images, train each method with ``seeds`` seeds on them, and ask; pose_range.json.

    Then the first seed's models fold, in so many rollouts (``folds``) of each object and limit, or in none. A row that
    is stored of the same model is kept: neither its images nor its weights are needed again.
    """
    file = paths.results / "pose_range.json"
    arms = [(name, limit) for name in choose_objects(objects) for limit in LIMITS_DEG]
    for name, limit in ProgressBar(arms, desc="limits"):
        place = name, str(limit)
        models = list_missing(list_models(paths.preset, name, seeds), file, place)
        folders = [render_limited(paths, name, turn) for turn in (limit, LIMITS_DEG[-1])] if models else []
        ask = partial(_measure, paths=paths, limit=limit, folders=folders)
        measure_each(models, file, place, ask, desc=f"{name} {say_limit(limit)}")
    for name, limit in ProgressBar(arms if folds else [], desc="folding within limits"):
        _fold(paths, name, limit, folds)
    save_figure(plot_limits(read_results(file, depth=3)), paths.figures / "pose_range")
    return file


def _measure(
    model: TrainConfig, *, paths: Paths, limit: int, folders: Sequence[Path], progress: bool
) -> dict[str, Any]:  # fmt: skip
    """The row of a model that is trained on the first of the ``folders`` and asked about both."""
    return train_and_measure(
        model, paths=paths, place=paths.generated / "pose_range", name=f"{model.name}-within-{limit}",
        images=folders[0], asked=dict(zip(("within", "any"), folders, strict=True)), progress=progress,
    )  # fmt: skip


def _fold(paths: Paths, object: str, limit: int, count: int) -> None:
    """Put into the rows of the first seed's models how often they fold; those that are there stay."""
    file, place = paths.results / "pose_range.json", paths.generated / "pose_range"
    results = read_results(file, depth=3)
    rows = {key: row for key, row in results[object][str(limit)].items() if key.endswith("-0")}
    models = {key: model for key, model in list_models(paths.preset, object, 1).items()
              if key in rows and get(rows[key], "folds", "rollouts") != count}  # fmt: skip
    if not models:
        return
    images = render_limited(paths, object, limit)
    weights = {key: train_model(model, images, place / "models" / f"{model.name}-within-{limit}")
               for key, model in models.items()}  # fmt: skip
    policies = [Policy(f"{key}-{limit}", "", "", chosen=AGREE, weights=path) for key, path in weights.items()]
    bench = Bench(place / "folding", {"progress": True})
    shares = measure_success(bench, policies, list_limited(object, count, limit))
    for key in models:
        rows[key]["folds"] = shares[f"{key}-{limit}"] | {"rollouts": count}
    write_results(results, file)


def get_rows(results: Results, object: str, limit: int, poses: str = "within") -> dict[str, Any]:
    """{"mmgsd-0": errors} of the models trained within a limit, asked about ``poses`` "within" it or about "any"."""
    return {key: row[poses] for key, row in (get(results, object, str(limit)) or {}).items()}


def compare_limits(results: Results) -> Tested:
    """`compare_seeds` within each object's limits, (object, limit) a part, against MMGSD of the same images."""
    return compare_seeds({(name, limit): get_rows(results, name, limit) for name in OBJECTS for limit in LIMITS_DEG})


def describe_limits(results: Results) -> Table:
    """Mean ± std over seeds of the error, and what is found, by limit and method.

    p is that of Welch's test against MMGSD's seeds, by Holm's correction for all that are compared (`compare_seeds`).
    """
    tested, lines = compare_limits(results), {}
    for limit in LIMITS_DEG:
        for method in METHODS:
            row = {name: _describe_row(results, name, limit, method) for name in OBJECTS
                   if get_rows(results, name, limit)}  # fmt: skip
            for name in row:
                row[name]["p"] = say_p(tested, (name, limit), method)
            lines[f"{say_limit(limit)}, {get_label(method, short=True)}"] = row
    columns = [
        Column("rmse", "RMSE", "RMSE px", optional=True),
        Column("found", "≤20", "pck@20px", ".0f", scale=100, optional=True),
        Column("folds", "folds", "folds", optional=True),
        Column("p", "p", optional=True),
        Column("any", page="RMSE px, all poses", optional=True),
    ]  # fmt: skip
    return Table("poses, method", {"": columns}, {label: row for label, row in lines.items() if row}, OBJECTS)


def _describe_row(results: Results, object: str, limit: int, method: str) -> dict[str, Any]:
    within = get_rows(results, object, limit)
    every = None if limit == LIMITS_DEG[-1] else _mean(get_rows(results, object, limit, "any"), method)
    pck = _mean(within, method, "pck@20px")
    folds = get(results, object, str(limit), f"{method}-0", "folds")
    success = folds and folds["count"] and f"{100 * folds['mean']:.0f} % of {folds['count']}"
    return {"rmse": say_seeds(within, method), "found": pck, "folds": success, "any": every}


def _mean(rows: Mapping[str, Results], method: str, measure: str = "rmse_mean") -> float | None:
    """The mean of a measure over a method's seeds; None of none."""
    values = [row.get(measure) for key, row in rows.items() if key.rpartition("-")[0] == method]
    return statistics.mean(values) if values and None not in values else None


def say_limit(limit: int) -> str:
    """A limit as tables name it."""
    return "any" if limit == LIMITS_DEG[-1] else f"±{limit}°"


@styled
def plot_limits(results: Results) -> Figure | None:
    """Error against the limit, a panel each object: seeds as dots, their mean as a line; None without results."""
    there = [name for name in OBJECTS if results.get(name)]
    if not there:
        return None
    figure, axes = plt.subplots(1, len(there), figsize=(PAGE_IN, 2.3), layout="constrained", squeeze=False)
    places = range(len(LIMITS_DEG))
    for axis, name in zip(axes[0], there, strict=True):
        for method in METHODS:
            errors = [list_seeds(get_rows(results, name, limit), method) for limit in LIMITS_DEG]
            measured = [k for k in places if errors[k]]
            axis.plot(measured, [statistics.mean(errors[k]) for k in measured], **get_line_style(method))
            axis.scatter([k for k in measured for _ in errors[k]], [e for k in measured for e in errors[k]], s=8,
                         color=get_colour(method), linewidths=0)  # fmt: skip
        axis.set_xticks(list(places), [say_limit(limit) for limit in LIMITS_DEG])
        axis.set(title=name, xlabel="poses trained and asked", ylabel="RMSE (px)", ylim=(0, None))
    axes[0, 0].legend()
    return finish_axes(figure)


def find_results(folder: Path, results: Results) -> dict[str, Any]:
    """A preset without results of its own has those of quick: the study is of that size."""
    file = folder.with_name("quick") / "pose_range.json"
    return {} if results or not file.is_file() else {"pose_range": read_table(file)}


def draw(folder: Path) -> Figure | None:
    """The figure from a preset's results."""
    return plot_limits(read_results(folder / "pose_range.json", depth=3))


def judge_one_match(results: Results) -> Claim:
    """This project's own conjecture: what the mixture is needed for."""
    rows, parts, texts = results.get("pose_range", {}), [], []
    for name in OBJECTS:
        gaps = {limit: _compute_gap(rows, name, limit) for limit in LIMITS_DEG}
        narrow, wide = [gaps[limit] for limit in NARROW], gaps[LIMITS_DEG[-1]]
        complete = None not in (*narrow, wide)
        parts.append(min(narrow) > max(MARGIN, wide) if complete else None)
        texts.append(f"{name} {', '.join(f'{say_limit(k)} {_say_gap(gap)}' for k, gap in gaps.items())}")
    return Claim(
        "one-match",
        "Our conjecture: one match teaches as much as all where poses are uniform, and less where they are limited.",
        f"Within {' and '.join(map(say_limit, NARROW))} Unimodal's error is above MMGSD's by more than "
        f"{100 * MARGIN:.0f} %, and by more than at any pose; means over seeds, a part each object.",
        f"Unimodal above MMGSD by: {'; '.join(texts)}{_say_seeds(rows)}", tuple(parts),
        "`.venv/bin/python -m mmgsd run pose_range`",
    )  # fmt: skip


def _compute_gap(results: Results, object: str, limit: int) -> float | None:
    """By which share Unimodal's mean error is above MMGSD's."""
    theirs, ours = (_mean(get_rows(results, object, limit), method) for method in ("unimodal", "mmgsd"))
    return theirs / ours - 1 if theirs and ours else None


def _say_gap(gap: float | None) -> str:
    return "–" if gap is None else f"{100 * gap:+.0f} %"


def count_finding(results: Results) -> dict[str, str]:
    """By how much of Unimodal's error MMGSD's is below it within the wider of the narrow limits (`mark_tested`)."""
    rows, limit = results.get("pose_range", {}), NARROW[-1]
    tested = compare_limits(rows)
    gaps = {name: _compute_gap(rows, name, limit) for name in OBJECTS}
    counts = [len(list_seeds(get_rows(rows, name, limit), "unimodal")) for name in OBJECTS]
    each = {name: say(None if gap is None else 1 - 1 / (1 + gap), "percent")
            + mark_tested(tested, (name, limit), "unimodal") for name, gap in gaps.items()}  # fmt: skip
    return each | {"seeds": f"{min(counts)}"}


def _say_seeds(results: Results) -> str:
    """How many seeds there are at least of Unimodal, where that is fewer than `SEEDS`."""
    counts = [len(list_seeds(get_rows(results, name, limit), "unimodal")) for name in results for limit in LIMITS_DEG]
    fewest = min((count for count in counts if count), default=SEEDS)
    return f", {say_count(fewest)}" if fewest < SEEDS else ""


STUDY = Study(
    "pose_range", 75, run, check, results=("pose_range",), derive=find_results,
    tables={"pose_range": Shown("quick/pose_range.json", describe_limits, "pose_range_table")},
    figures={"pose_range": draw}, claims=(judge_one_match,),
    findings=(
        Finding(5, "The same where poses are limited", f" to ±{NARROW[-1]}°, at the size of `quick`",
                "when-is-one-match-as-good-as-all", count_finding),
    ),
)  # fmt: skip
