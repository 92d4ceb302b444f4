"""How wide a target should be where cells are fine enough to tell: MMGSD goes on with larger images, with each σ.

    python -m mmgsd ship paper --restore              the trained models that it starts from
    python -m mmgsd run cells --preset paper          -> data/results/paper/cells.json; a killed call goes on

A cell of the main table's heatmaps is 15 px wide: targets with a σ of 1, 2 and 4 px hardly differ there. Here the
trained MMGSD takes more steps with inputs of about the images' own size, where cells are 4 px wide; and as many steps
with its own inputs, to compare with.
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
from mmgsd.studies.models import ITS_OWN, Model, by_object, configure_study, times
from mmgsd.studies.parameters import check_images, choose_objects
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Column, Table, collect_rows

WIDTHS_PX = (1.0, 2.0, 4.0, 8.0)  # σ
START, COARSE = "start", "coarse"
PAIRS, POINTS = 100, 65  # at most, of images and of points a pair: fine heatmaps take long to ask
# half a batch, for the memory that large images take
MORE = {"trunk_weights": ITS_OWN, "steps": times(0.1), "learning_rate": times(0.5), "batch": times(0.5),
        "pairs": times(0.5), "sigma_start_px": 8.0, "prototype_weight": 0.0}  # fmt: skip
ROWS = (
    Model(START, "cells of 15 px, as trained", "mmgsd"),
    Model(COARSE, "the same, a tenth of the steps more", "mmgsd", MORE),
    *(Model(f"{s:g}", f"then cells of 4 px, σ = {s:g} px", "mmgsd",
            {**MORE, "input_px": by_object(cloth=480, rope=640), "sigma_px": s}) for s in WIDTHS_PX),
)  # fmt: skip


def list_models(preset: str, object: str) -> dict[str, TrainConfig]:
    """{"start", "coarse", or σ (px): training} of an object."""
    return configure_study(load_preset(preset), object, "cells", ROWS)


def check(paths: Paths, *, objects: str | Sequence[str] = OBJECTS) -> None:
    """ValueError for other objects, FileNotFoundError where their images or the models to start from are missing."""
    for name in choose_objects(objects):
        check_images(paths, [name], split="train")
        check_start(list_models(paths.preset, name)[COARSE], paths.model(list_models(paths.preset, name)[START]).parent)


def run(paths: Paths, *, objects: str | Sequence[str] = OBJECTS) -> Path:
    """Train and ask each model of the objects, one after another; cells.json.

    A row that is stored of the same training is kept.
    """
    file = paths.results / "cells.json"
    for name in choose_objects(objects):
        models = list_missing(list_models(paths.preset, name), file, [name])
        measure_each(models, file, [name], partial(_measure, paths=paths), desc=name)
    return file


def _measure(model: TrainConfig, *, paths: Paths, progress: bool) -> dict[str, Any]:
    """The errors of a model, how wide (px) its modes and its cells are, and what its training took."""
    data, questions = paths.dataset(model.object), load_preset(paths.preset).evaluate
    fewer = dataclasses.replace(questions, pairs=min(PAIRS, questions.pairs), points=min(POINTS, questions.points))
    weights = paths.model(model) / WEIGHTS
    if not weights.is_file():
        weights = train_model(model, data, paths.model(model), progress=progress)
    table = evaluate_model(weights, data, fewer, paths.queries(f"{model.name}-cells"), progress=progress)
    widths = load_queries(table).spread_px.explode().to_numpy(float)
    return summarise({"": table})[""] | {"width_px": float(np.median(widths)), "run": describe_run(weights)}


def describe_cells(results: Results) -> Table:
    """Errors, and the median width of the modes that are answered."""
    columns = [Column("rmse_mean", page="RMSE px"), Column("median", page="median px"),
               Column("pck@5px", page="pck@5px", form=".0f", scale=100),
               Column("width_px", page="modes' σ px")]  # fmt: skip
    return Table("", {"": columns}, collect_rows(results, {row.name: row.label for row in ROWS}), OBJECTS)


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
