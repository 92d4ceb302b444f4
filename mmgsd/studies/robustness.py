"""What each part of the shipped models' training brings on clean and cluttered renders, and the figure of all of them.

    python -m mmgsd run robustness                    -> data/results/quick/robustness.json; a killed call goes on
    python -m mmgsd run robustness --set seeds=1 --set objects=cloth

Each row adds a part to the one above it, and is trained with several seeds for equally many steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmgsd.checks import read_count
from mmgsd.config import OBJECTS, ROUNDS, TrainConfig, load_preset
from mmgsd.figures.style import PAGE_IN, finish_axes, styled
from mmgsd.match.baselines import BASELINES, OPTIONAL
from mmgsd.paths import Paths
from mmgsd.progress import ProgressBar
from mmgsd.scene.stage import render_dataset
from mmgsd.studies import pose_range
from mmgsd.studies.claims import get
from mmgsd.studies.matrix import list_missing, measure_each, train_and_measure
from mmgsd.studies.models import Model, configure_study, get_colour, get_label, list_rows
from mmgsd.studies.parameters import choose_objects
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.seeds import SEEDS, compare_seeds, say_tested
from mmgsd.studies.shipped import Rows, get_photographs, list_names
from mmgsd.studies.table import MISSING, Table, make_page_table

WHERE = ("clean", "cluttered")  # renders that are asked about
PANELS = (  # a title, what is measured there, and times what
    ("Clean renders", "paper", "rmse_mean", 1.0, "RMSE (px)"),
    ("Cluttered renders", "workspace", "rmse_mean", 1.0, "RMSE (px)"),
    ("Photographs", "photographs", "found@5%", 100.0, "Found (%), 95 % intervals"),
)
STEPS = 600  # of each model
COLOURS = {"": get_colour(f"round{ROUNDS['cloth']}"), "paper": get_colour("mmgsd")}
COLOURS |= {name: get_colour(name) for name in (*BASELINES, *OPTIONAL)}
LABELS = {"": "MMGSD, shipped", "paper": "MMGSD, clean images only"}


def list_models(preset: str, object: str, seeds: int, steps: int) -> dict[str, TrainConfig]:
    """{"mmgsd_clutter-0": training} of each row and seed."""
    rows = [Model(f"{row.name}-{seed}", row.label, row.name, {"seed": seed}, ("robustness",))
            for row in list_rows("robustness") for seed in range(seeds)]  # fmt: skip
    return configure_study(load_preset(preset), object, "robustness", rows, steps=steps)


def check(paths: Paths, *, steps: int = STEPS, **options: Any) -> None:
    """ValueError for another number of steps than one from 1 on, and as `pose_range.check`."""
    if read_count("steps", steps) < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    pose_range.check(paths, **options)


def run(
    paths: Paths, *, seeds: int = SEEDS, steps: int = STEPS, objects: str | Sequence[str] = OBJECTS
) -> Path:  # fmt: skip
    """Render, train each row with each seed, and ask about clean and cluttered images; robustness.json.

    A row that is stored of the same model is kept: neither its images nor its weights are needed again.
    """
    file, kinds = paths.results / "robustness.json", (paths.preset, load_preset(paths.preset).cluttered)
    for name in ProgressBar(choose_objects(objects), desc="objects"):
        models = list_missing(list_models(paths.preset, name, seeds, steps), file, (name,))
        images = {where: render_dataset(load_preset(kind).render[name], Paths(paths.root, kind).dataset(name))
                  for where, kind in zip(WHERE, kinds, strict=True)} if models else {}  # fmt: skip
        ask = partial(_measure, paths=paths, images=images)
        measure_each(models, file, (name,), ask, desc=name)
    return file


def _measure(model: TrainConfig, *, paths: Paths, images: Mapping[str, Path], progress: bool) -> dict[str, Any]:
    place = paths.generated / "robustness"
    clean = images["clean"]  # whose cluttered counterpart the training finds by itself
    return train_and_measure(model, paths=paths, place=place, name=model.name, images=clean, asked=images,
                             progress=progress)  # fmt: skip


def get_rows(results: Results) -> dict[tuple[str, str], dict[str, Any]]:
    """{(object, "clean" or "cluttered"): {"mmgsd-0": errors}}."""
    return {(name, where): {key: row[where] for key, row in rows.items()}
            for name, rows in results.items() for where in WHERE}  # fmt: skip


def describe_parts(results: Results) -> Table:
    """Mean ± std over seeds of the error, a row a part; marked where the row above differs (`say_tested`)."""
    rows, names = get_rows(results), [row.name for row in list_rows("robustness")]
    tested = compare_seeds(rows, dict(zip(names[1:], names, strict=False)))
    lines = {f"{name}, {get_label(part)}": [say_tested(rows, tested, (name, where), part) or MISSING for where in WHERE]
             for name in OBJECTS if name in results for part in names}  # fmt: skip
    return make_page_table([f"{where}: RMSE px" for where in WHERE], lines)


def make_budget_sentence(results: Results) -> str:
    """How much the models of `describe_parts` learnt from."""
    images = load_preset("quick").render["cloth"]
    runs = [get(row, "run") for rows in results.values() for row in rows.values()]
    steps, seeds = sorted({run["steps"] for run in runs}), len({run["seed"] for run in runs})
    each = " or ".join(map(str, steps))
    return (f"Preset `quick`: {each} steps each, from {images.train_images:,} images of a kind; "
            f"{images.test_images} test images of each; {seeds} seeds.")  # fmt: skip


@styled
def plot_robustness(rows: Rows) -> Figure:
    """A panel for clean renders, cluttered ones and photographs: a bar for each model and baseline of each object."""
    names = [name for object in OBJECTS for name in list_names(rows, object)]
    places = [place + 0.6 * (not name.startswith(OBJECTS[0])) for place, name in enumerate(names)]
    size = PAGE_IN, 0.5 + 0.17 * len(names)
    figure, axes = plt.subplots(1, len(PANELS), figsize=size, layout="constrained", sharey=True)
    for axis, (title, part, key, scale, unit) in zip(axes, PANELS, strict=True):
        for place, name in zip(places, names, strict=True):
            measures = get_photographs(rows, name) if part == "photographs" else rows[name].get(part, {})
            value, named = measures.get(key), measures.get("by_name", {}).get(key)
            interval = [scale * bound for bound in (measures.get("intervals") or {}).get(key) or ()]
            _draw_bar(axis, place, name, value and scale * value, named and scale * named, interval)
            if value and measures.get("unanswered"):
                axis.texts[-1].set_text(f"{axis.texts[-1].get_text()}; {100 * measures['unanswered']:.0f} not answered")
        axis.set(title=title, xlabel=unit)
    widest = 1.12 * max(1.0, *(axis.dataLim.x1 for axis in axes[:2]))
    for axis, most in zip(axes, (widest, widest, 250), strict=True):  # %, with room for the words
        axis.set_xlim(0, most)
    axes[2].set_xticks([0, 50, 100])
    kinds = [name.partition("@")[0].partition("-") for name in names]
    labels = [f"{object.capitalize()}: {LABELS.get(kind) or get_label(kind)}" for object, _, kind in kinds]
    axes[0].set_yticks(places, labels)
    axes[0].invert_yaxis()
    return finish_axes(figure)


def _draw_bar(
    axis: Axes, place: float, name: str, value: float | None, named: float | None, interval: Sequence[float]
) -> None:  # fmt: skip
    """The bar of a ``value`` with its interval, dashed up to the one that asking by ``named`` places has."""
    if value is None:
        axis.annotate("not measured", (0, place), xytext=(2, 0), textcoords="offset points", va="center", fontsize=5.5)
        return
    colour = COLOURS[name.partition("@")[0].partition("-")[2]]
    axis.barh(place, value, height=0.72, color=colour)
    if interval:
        axis.plot(interval, [place] * 2, color="black", linewidth=0.8)
    text, end = f"{value:.0f}", max([value, *interval])
    if named is not None:
        axis.barh(place, named, height=0.72, fill=False, edgecolor=colour, linestyle="--", linewidth=0.8)
        text, end = f"{value:.0f}, by name {named:.0f}", max([value, named, *interval])
    axis.annotate(text, (end, place), xytext=(2, 0), textcoords="offset points", va="center", fontsize=6.5)


STUDY = Study(
    "robustness", 140, run, check, results=("robustness",),
    tables={
        "parts": Shown("quick/robustness.json", describe_parts),
        "budget_of_parts": Shown("quick/robustness.json", make_budget_sentence),
    },
)  # fmt: skip
