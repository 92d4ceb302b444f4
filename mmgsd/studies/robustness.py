"""What each part of the shipped models' training brings, on clean and cluttered renders and in photographs.

`run` trains its models; what they do on cluttered renders is measured by `mmgsd.studies.shipped`, into its rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmgsd.config import OBJECTS, ROUNDS, load_preset
from mmgsd.figures.style import PAGE_IN, finish_axes, styled
from mmgsd.match.baselines import BASELINES, OPTIONAL
from mmgsd.studies.matrix import run_matrix
from mmgsd.studies.models import get_colour, get_label, list_rows
from mmgsd.studies.registry import Shown, Study
from mmgsd.studies.shipped import RESULTS, Rows, describe_pictures, get_photographs, list_names
from mmgsd.studies.table import Table, describe_errors

PANELS = (  # a title, what is measured there, and times what
    ("Clean renders", "paper", "rmse_mean", 1.0, "RMSE (px)"),
    ("Cluttered renders", "workspace", "rmse_mean", 1.0, "RMSE (px)"),
    ("Photographs", "photographs", "found@5%", 100.0, "Found (%), 95 % intervals"),
)
COLOURS = {"": get_colour(f"round{ROUNDS['cloth']}"), "paper": get_colour("mmgsd")}
COLOURS |= {name: get_colour(name) for name in (*BASELINES, *OPTIONAL)}
LABELS = {"": "MMGSD, shipped", "paper": "MMGSD, clean images only"}


def describe_parts(rows: Rows) -> Table:
    """`describe_pictures` of the models, each with one part of the training more than the one before."""
    labels = {f"{object}-{row.name}": row.label for object in OBJECTS for row in list_rows("robustness")}
    return describe_pictures(rows, {name: label for name, label in labels.items() if name in rows})


def make_budget_sentence(rows: Rows) -> str:
    """How much the models of `describe_parts` learnt from."""
    row = next(row for row in rows.values() if "steps" in row)
    images = load_preset(row["preset"]).render["cloth"]
    return (f"Preset `{row['preset']}`: {row['steps']} steps each, from {images.train_images:,} images of a kind; "
            f"{images.test_images} test images of each.")  # fmt: skip


@styled
def plot_robustness(rows: Rows) -> Figure:
    """A panel for clean renders, cluttered ones and photographs: a bar for each model and baseline of each object."""
    names = [name for object in OBJECTS for name in list_names(rows, object)]
    places = [place + 0.6 * (not name.startswith(OBJECTS[0])) for place, name in enumerate(names)]
    size = PAGE_IN, 0.5 + 0.17 * len(names)
    figure, axes = plt.subplots(1, len(PANELS), figsize=size, layout="constrained", sharey=True)
    for axis, (title, part, key, scale, unit) in zip(axes, PANELS, strict=True):
        for place, name in zip(places, names, strict=True):
            found = get_photographs(rows, name) if part == "photographs" else rows[name].get(part, {})
            value, named = found.get(key), found.get("by_name", {}).get(key)
            interval = [scale * bound for bound in (found.get("intervals") or {}).get(key) or ()]
            _draw_bar(axis, place, name, value and scale * value, named and scale * named, interval)
            if value and found.get("unanswered"):
                axis.texts[-1].set_text(f"{axis.texts[-1].get_text()}; {100 * found['unanswered']:.0f} not answered")
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
    "robustness", 140, partial(run_matrix, study="robustness"),
    tables={
        "robustness": Shown("paper/robustness.json", describe_errors),
        "parts": Shown(RESULTS, describe_parts),
        "budget_of_parts": Shown(RESULTS, make_budget_sentence),
    },
)  # fmt: skip
