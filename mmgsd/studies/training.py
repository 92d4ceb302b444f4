"""The four methods' training: the same network, images and number of steps, four ways to learn."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.config import METHODS, OBJECTS, Preset, TrainConfig, load_preset
from mmgsd.figures.style import PAGE_IN, finish_axes, styled
from mmgsd.learn.checkpoints import LOG
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import Matcher
from mmgsd.model.tensors import WEIGHTS, describe_run
from mmgsd.paths import Paths
from mmgsd.studies.claims import get
from mmgsd.studies.matrix import run_each
from mmgsd.studies.models import ROWS, configure_model, configure_study, get_colour, get_label
from mmgsd.studies.parameters import check_training
from mmgsd.studies.registry import Experiment, Shown, Study
from mmgsd.studies.sample import load_shipped
from mmgsd.studies.table import LABELS, Column, Results, Table, collect_rows

COSTS = ["steps", "minutes", "images", "seed", "hardware"]


def list_models(preset: Preset) -> dict[tuple[str, str], TrainConfig]:
    """{(object, method): training} of the four methods."""
    return {(name, method): configure_model(preset, name, method) for name in OBJECTS for method in METHODS}


def check(paths: Paths, *, overwrite: bool = False, device: str = "") -> None:
    """ValueError where the images to train on are not rendered."""
    check_training(paths, list_models(load_preset(paths.preset)).values(), overwrite=overwrite)


def run(paths: Paths, *, overwrite: bool = False, device: str = "") -> Path:
    """Train the four methods on both objects, each unless it is trained; the folder of the models."""
    models = list_models(load_preset(paths.preset)).values()
    train = partial(_train, paths=paths, overwrite=overwrite, device=device)
    dict(run_each(train, {model.name: model for model in models}, desc="models", device=device))
    return paths.generated / "models"


def _train(model: TrainConfig, *, paths: Paths, **how: Any) -> Path:
    return train_model(model, paths.dataset(model.object), paths.model(model), **how)


def read_costs(study: Experiment) -> pd.DataFrame:
    """What the trainings took, a row an object and method: those that were run, or else as it is stored."""
    models, stored = list_models(study.preset), {} if study.runs else study.read("runs")
    costs = {key: describe_run(study.paths.model(model) / WEIGHTS) if study.runs else stored.get("-".join(key), {})
             for key, model in models.items()}  # fmt: skip
    return pd.DataFrame(costs, COSTS).T.rename_axis(["object", "method"])


def draw_losses(study: Experiment) -> Figure | None:
    """`plot_training` of what was run; None where nothing was, and where models came from elsewhere without a log."""
    models = list_models(study.preset) if study.runs else {}
    logs = {" ".join(key): study.paths.model(model) / LOG for key, model in models.items()}
    logs = {key: pd.read_csv(log) for key, log in logs.items() if log.is_file()}
    return plot_training(logs) if logs else None


def read_errors(study: Experiment) -> pd.DataFrame | None:
    """The stored mean errors (px) by the steps of the studies' budget and the preset's training; None after a run."""
    if study.runs:
        return None
    errors: dict[int, dict[tuple[str, str], float | None]] = {}
    for rows, file in {"budget": "budget", "main": "rmse"}.items():
        stored = study.read(file, depth=2)
        for name, method in list_models(study.preset):
            steps = configure_study(study.preset, name, rows)[method].steps
            errors.setdefault(steps, {})[name, method] = get(stored, name, method, "rmse_mean")
    table = pd.DataFrame(errors, dtype=float).rename_axis(["object", "method"]).rename_axis(columns="steps")
    return table.round(1)


def load_trained(study: Experiment, object: str, method: str = "mmgsd") -> Matcher:
    """What was trained, or else the shipped weights of the same training."""
    if not study.runs:
        return load_shipped(object, method)
    return Matcher.load(study.paths.model(list_models(study.preset)[object, method]) / WEIGHTS)


def describe_runs(results: Results) -> Table:
    """What each model's training took."""
    rows: dict[str, Any] = {name: {method: results.get(f"{name}-{method}") for method in LABELS} for name in OBJECTS}
    columns = [Column("steps", "steps", form="d", optional=True), Column("minutes", "minutes", optional=True)]
    return Table("", {"": columns}, collect_rows(rows, LABELS), OBJECTS)


@styled
def plot_training(logs: Mapping[str, pd.DataFrame]) -> Figure:
    """Loss against step, a panel a model: ``logs`` {"cloth mmgsd": columns step, loss, seconds}, last word the method.

    Losses of different methods have different scales. Dark: mean of a tenth of the steps.
    """
    columns = min(4, len(logs))
    rows = -(-len(logs) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(PAGE_IN * columns / 4, 1.5 * rows), layout="constrained",
                                squeeze=False)  # fmt: skip
    for axis, (name, log) in zip(axes.flat, logs.items(), strict=False):
        colour = get_colour(name.split()[-1])
        axis.plot(log.step, log.loss, color=colour, alpha=0.3, lw=0.6)
        axis.plot(log.step, log.loss.rolling(max(1, len(log) // 10), min_periods=1).mean(), color=colour)
        title = " ".join(get_label(word, short=True) if word in ROWS else word.capitalize() for word in name.split())
        axis.set(title=f"{title} · {log.seconds.iloc[-1] / 60:.1f} min", xlabel="Step")
    for axis in axes[:, 0]:
        axis.set_ylabel("Loss")
    for axis in axes.flat[len(logs) :]:
        axis.remove()
    return finish_axes(figure)


STUDY = Study(
    "training", 0, run, check, "04_evaluate", ("runs",),
    lambda paths, **_: [paths.results / "runs.json", paths.results / "rmse.json"],
    tables={"runs": Shown("paper/runs.json", describe_runs, "runs_table")},
)  # fmt: skip
