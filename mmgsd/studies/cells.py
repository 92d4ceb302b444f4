"""How wide a target should be where cells are fine enough to tell: MMGSD goes on with larger images, with each σ.

    python -m mmgsd ship paper --restore              the trained models that it starts from
    python -m mmgsd run cells --preset paper          -> data/results/paper/cells.json; a killed call goes on

A cell of the main table's heatmaps is 15 px wide: targets with a σ of 1, 2 and 4 px hardly differ there. Here the
trained MMGSD goes on with larger and larger inputs, to about the images' own size, where cells are 4 px wide, and from
there with each σ. As many steps with its own inputs are there to compare with.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.config import OBJECTS, TrainConfig, load_preset
from mmgsd.learn.training import check_start, train_model
from mmgsd.measure.evaluation import evaluate_model, load_queries, summarise
from mmgsd.model.tensors import WEIGHTS, describe_run
from mmgsd.paths import Paths
from mmgsd.studies.claims import Claim, get, is_better, say
from mmgsd.studies.matrix import list_missing, measure_each
from mmgsd.studies.models import ITS_OWN, ROWS, Model, configure_study, list_rows, times
from mmgsd.studies.parameters import check_images, choose_objects
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Column, Table, collect_rows

WIDTHS_PX = (1.0, 2.0, 4.0, 8.0)  # σ
GROWN = [row.name for row in list_rows("cells")]  # each goes on from the one before
LAST_STEPS = 0.4  # of the steps of those before, with each σ
PAIRS, POINTS = 100, 65  # at most, of images and of points a pair: fine heatmaps take long to ask
# the other models' steps after the trained one, at its own size
COARSE = {**ROWS[GROWN[0]].changes, "input_px": times(1), "sigma_px": 1.0,
          "steps": times(0.25 * (len(GROWN) + LAST_STEPS))}  # fmt: skip
SHOWN = (
    Model("start", "cells of 15 px, as trained", "mmgsd"),
    Model("coarse", "the same, longer", "mmgsd", COARSE),
    *(ROWS[name] for name in GROWN),
    *(Model(f"{width:g}", f"then σ = {width:g} px", GROWN[-1],
            {"trunk_weights": ITS_OWN, "steps": times(LAST_STEPS), "learning_rate": times(0.5), "sigma_px": width})
      for width in WIDTHS_PX),
)  # fmt: skip


def list_models(preset: str, object: str) -> dict[str, TrainConfig]:
    """{"start", "coarse", those of `GROWN`, or σ (px): training} of an object."""
    return configure_study(load_preset(preset), object, "cells", SHOWN)


def check(paths: Paths, *, objects: str | Sequence[str] = OBJECTS) -> None:
    """ValueError for other objects, FileNotFoundError where their images or the models to start from are missing."""
    for name in choose_objects(objects):
        models = list_models(paths.preset, name)
        check_images(paths, [name], split="train")
        check_start(models["coarse"], paths.model(models["start"]).parent)


def run(paths: Paths, *, objects: str | Sequence[str] = OBJECTS) -> Path:
    """Train and ask each model of the objects: cells.json.

    A row that is stored of the same training is kept.
    """
    file = paths.results / "cells.json"
    for name in choose_objects(objects):
        models = list_models(paths.preset, name)
        missing = list_missing(models, file, [name])
        for key in GROWN if missing else ():  # what the others go on from
            _train(models[key], paths, progress=True)
        measure_each(missing, file, [name], partial(_measure, paths=paths), desc=name)
    return file


def _train(model: TrainConfig, paths: Paths, *, progress: bool) -> Path:
    """Its weights, which may be restored ones, of fewer digits than training leaves."""
    weights = paths.model(model) / WEIGHTS
    if weights.is_file():
        return weights
    return train_model(model, paths.dataset(model.object), paths.model(model), progress=progress)


def _measure(model: TrainConfig, *, paths: Paths, progress: bool) -> dict[str, Any]:
    """The errors of a model, how wide (px) its modes are, and what its training took."""
    data, questions = paths.dataset(model.object), load_preset(paths.preset).evaluate
    fewer = dataclasses.replace(questions, pairs=min(PAIRS, questions.pairs), points=min(POINTS, questions.points))
    weights = _train(model, paths, progress=progress)
    table = evaluate_model(weights, data, fewer, paths.queries(f"{model.name}-cells"), progress=progress)
    widths = load_queries(table).spread_px.explode().to_numpy(float)
    return summarise({"": table})[""] | {"width_px": float(np.median(widths)), "run": describe_run(weights)}


def describe_cells(results: Results) -> Table:
    """Errors, and the median width of the modes that are answered."""
    columns = [Column("rmse_mean", page="RMSE px"), Column("median", page="median px"),
               Column("pck@5px", page="pck@5px", form=".0f", scale=100),
               Column("width_px", page="modes' σ px")]  # fmt: skip
    return Table("", {"": columns}, collect_rows(results, {row.name: row.label for row in SHOWN}), OBJECTS)


def judge_cells(results: Results) -> Claim:
    """The width of the target, where cells are fine."""
    errors = {name: get(results, "cells", name) or {} for name in OBJECTS}
    widths = [f"{width:g}" for width in WIDTHS_PX]
    found = {name: {w: rows[w]["rmse_mean"] for w in widths if w in rows} for name, rows in errors.items()}
    parts = [is_better(row.get(widths[0]), row.get(w)) for row in found.values() for w in widths[1:]]
    texts = [f"{name}: {', '.join(f'{say(e)} at {w}' for w, e in row.items()) or '–'}" for name, row in found.items()]
    return Claim(
        "fine", "A target of σ = 1 px is best; here with cells of 4 px instead of 15.",
        "The wider target's error is larger; a part each object and width.", f"{'; '.join(texts)}; one seed",
        tuple(parts), "`.venv/bin/python -m mmgsd run cells --preset paper`", runs="cells",
    )  # fmt: skip


STUDY = Study(
    "cells", 21, run, check, results=("cells",), tables={"cells": Shown("paper/cells.json", describe_cells)},
    claims=(judge_cells,),
)  # fmt: skip
