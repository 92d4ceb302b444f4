"""The table of models: every row comes to a training, and the stored results stay those of their rows."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest

from mmgsd.config import METHODS, OBJECTS, TrainConfig, load_preset
from mmgsd.match.baselines import BASELINES
from mmgsd.measure.evaluation import CHANCE
from mmgsd.paths import find_root
from mmgsd.studies import cells
from mmgsd.studies.models import (
    GREY,
    MODELS,
    PRESET,
    ROWS,
    RUN,
    STUDIES,
    UNTRAINED,
    configure_model,
    configure_study,
    get_colour,
    get_label,
    list_rows,
    list_runs,
    vary_seed,
    vary_sigma,
)
from mmgsd.studies.robustness import STEPS, list_models

ROOT = find_root(Path(__file__).parent)
PAPER = load_preset("paper")
NAMES = {  # of the studies whose files of results do not hold their models' names
    "fixes": {
        "any rotation": "cloth-pcl-identity-r2-453b9419",
        "±45° only": "cloth-pcl-identity-r2-082a9bc6",
        "plain": "rope-pcl-identity-r2-b74ef067",
        "ball at one end": "rope-pcl-identity-r2-b74ef067",
    },
}


def list_stored(preset: str) -> dict[str, str]:
    """{"file/object/row": model's name} of all results of a preset that hold one."""
    stored = {}
    for file in sorted((ROOT / "data" / "results" / preset).glob("*.json")):
        for first, rows in json.loads(file.read_text()).items():
            if not isinstance(rows, dict):  # of stages.json, minutes
                continue
            if "model" in rows:
                stored["/".join((file.stem, *first.split("-", 1)))] = rows["model"]
            if "run" in rows:  # "rope, plain", or of cloths alone
                object, name = first.split(", ") if ", " in first else ("cloth", first)
                stored[f"{file.stem}/{object}/{name}"] = rows["run"]["model"]
            for second, row in rows.items():
                if isinstance(row, dict) and "run" in row:
                    stored[f"{file.stem}/{first}/{second}"] = row["run"]["model"]
    return stored


def find_row(preset: str, key: str) -> TrainConfig:
    file, object, name = key.split("/")
    study, steps = re.fullmatch(r"(.*?)(?:_(\d+))?", file).groups()
    if study == "robustness":
        return list_models(preset, object, int(name[-1]) + 1, STEPS)[name]
    varied = {"sigma": lambda: vary_sigma([float(name)]), "seeds": lambda: vary_seed([int(name[-1])]),
              "cells": lambda: cells.SHOWN}  # fmt: skip
    rows = varied[study]() if study in varied else None
    study = {"runs": "main", "broken_symmetry": "fixes"}.get(study, study)
    return configure_study(load_preset(preset), object, study, rows, steps=int(steps or 0))[name]


STORED = [(preset, *item) for preset in ("paper", "quick") for item in list_stored(preset).items()]


@pytest.mark.parametrize(("preset", "key", "name"), STORED, ids=lambda value: value.replace("/", "-"))
def test_models_whose_results_are_kept_keep_their_names(preset: str, key: str, name: str) -> None:
    assert find_row(preset, key).name == name


def test_every_file_of_results_with_models_is_looked_at() -> None:
    files = {f"{preset}/{key.split('/')[0]}" for preset, key, _ in STORED}
    paper = ("runs", "budget", "sigma", "sigma_4000", "seeds", "seeds_1000", "backbones_1500", "cells",
             "symmetry", "broken_symmetry_4000")  # fmt: skip
    quick = ("runs", "sigma", "seeds", "robustness")
    assert files == {f"paper/{name}" for name in paper} | {f"quick/{name}" for name in quick}


@pytest.mark.parametrize("study", NAMES)
def test_models_of_results_without_names_keep_theirs(study: str) -> None:
    models = {name: model for object in OBJECTS for name, model in configure_study(PAPER, object, study).items()}
    assert {name: model.name for name, model in models.items()} == NAMES[study]


@pytest.mark.parametrize("preset", ["smoke", "quick", "paper", "workspace"])
def test_every_row_comes_to_a_training_of_its_objects(preset: str) -> None:
    for study in {study for row in MODELS for study in row.studies}:
        for object in OBJECTS:
            models = configure_study(load_preset(preset), object, study)
            left_out = ("mmgsd_deep", "spcl_deep") if preset == "quick" else ()  # whose networks are deep already
            rows = [row.name for row in list_rows(study) if object in row.objects and row.name not in left_out]
            assert list(models) == rows
            assert {model.object for model in models.values()} <= {object}


def test_names_are_unique_and_starts_are_rows() -> None:
    assert len(ROWS) == len(MODELS) + len(UNTRAINED)
    assert {row.start for row in MODELS} <= {PRESET, *ROWS}
    others = {"cells", "fixes", "robustness", "rounds", "seeds"}
    assert {study for row in MODELS for study in row.studies} | {"sigma"} == {*STUDIES, *others}


def test_everything_that_a_figure_may_draw_has_a_colour_of_its_own() -> None:
    drawn = [row.colour for row in ROWS.values() if {"main", "hand_made", "chance"} & {*row.studies}]
    assert GREY not in drawn and len(set(drawn)) == len(drawn)
    assert (get_label("mmgsd_long"), get_label("mmgsd_long", short=True)) == ("MMGSD, 3 × the steps", "MMGSD, longer")
    assert (get_label("mine"), get_colour("mine"), get_label("sift", short=True)) == ("mine", GREY, "SIFT")


def test_methods_baselines_and_chance_have_rows() -> None:
    assert {row.name for row in list_rows("seeds")} == {*METHODS, "mmgsd_plain", "spcl_dense", "spcl_hidden"}
    assert tuple(row.name for row in list_rows("hand_made")) == BASELINES
    assert {row.name for row in list_rows("chance")} == set(CHANCE)


def test_a_row_differs_from_its_start_in_its_changes_alone() -> None:
    for object in OBJECTS:
        models = configure_study(PAPER, object, "main")
        for name, model in models.items():
            start = PAPER.train[object] if ROWS[name].start == PRESET else models[ROWS[name].start]
            differs = {key for key, value in dataclasses.asdict(model).items() if value != getattr(start, key)}
            assert differs <= set(ROWS[name].changes)


def test_values_may_follow_from_what_a_row_starts_from() -> None:
    models = configure_study(load_preset("quick"), "rope", "main")
    assert (models["mmgsd_long"].steps, models["spcl_reference"].steps) == (810, 236)
    assert models["mmgsd_muon"].input_px == 256
    models |= configure_study(load_preset("smoke"), "rope", "cells", cells.SHOWN)
    start, larger, largest = (models[name] for name in ("start", "mmgsd_larger", "mmgsd_largest"))
    assert (larger.trunk_weights, largest.trunk_weights) == (start.name, larger.name)
    assert (larger.steps, larger.learning_rate) == (start.steps // 4, start.learning_rate / 2)
    assert ROWS["mmgsd_long"].difference == "steps × 3" and ROWS["±45° only"].difference.endswith("rotation_deg 45.0")


def test_what_robustness_brings_is_added_one_by_one_at_the_equal_budget() -> None:
    models = configure_study(PAPER, "cloth", "robustness")
    assert [(m.also, m.clutter, m.heads) for m in models.values()] == [
        ("", False, False), ("workspace", False, False), ("workspace", True, False), ("workspace", True, True),
    ]  # fmt: skip
    assert {model.steps for model in models.values()} == {1000}
    assert models["mmgsd"] == configure_study(PAPER, "cloth", "budget")["mmgsd"]


def test_a_fix_has_images_of_its_own() -> None:
    changed = {row.name: row.scene for row in list_rows("fixes") if row.scene}
    assert changed == {"±45° only": {"rotation_deg": 45.0}, "ball at one end": {"ball": True}}


def test_models_that_need_other_images_are_run_where_they_are_asked_for() -> None:
    assert not any(model.also for model in [*list_runs(PAPER), *list_runs(PAPER, ["main"])])
    assert len(list_runs(PAPER, ["backbones"])) == 4 and STUDIES[: len(RUN)] == RUN


def test_an_unknown_model_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="method must .*got 'mmgsd_lang'"):
        configure_model(PAPER, "cloth", "mmgsd_lang")
