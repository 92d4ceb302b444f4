"""Prior work's ways to break the symmetry: a cloth that is never turned by more than ±45°, a ball at a rope's end.

PCL, told one match, is trained and asked on images with and without each.

    python -m mmgsd run broken_symmetry --preset paper --set steps=4000 --set objects=rope   for longer
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mmgsd.checks import read_count
from mmgsd.config import DEFAULT_GROUP, N_POINTS, OBJECTS, load_preset
from mmgsd.learn.training import train_model
from mmgsd.measure.evaluation import evaluate_model, load_queries, read_results, summarise, write_results
from mmgsd.model.tensors import describe_run
from mmgsd.paths import Paths
from mmgsd.scene.stage import render_dataset
from mmgsd.studies.claims import Claim, get, is_at_least, list_errors, list_shares, say
from mmgsd.studies.models import Model, configure_study, list_rows
from mmgsd.studies.parameters import choose_objects
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import ERRORS, Column, Table
from mmgsd.symmetry import load_group

SURE = 0.95  # a symmetry is broken where an answer is the right one of all matches so often
CHOSEN = 0.6  # two matches are told apart where an answer is the right one so often; by chance it is in half
LONGER = "broken_symmetry_4000"  # as many steps as the main table's, of ropes
AGAIN = "`.venv/bin/python -m mmgsd run broken_symmetry --preset paper --set steps=4000 --set objects=rope`"
END = 0.03  # of a rope's length, from its first end: about as far as the ball reaches
TOLD, RIGHT_PX = "identity", 1e-3  # the group of one match; two distances that differ by less are one


def list_fixes() -> list[tuple[str, Model]]:
    """The object and row of each model."""
    return [(name, row) for name in OBJECTS for row in list_rows("fixes") if name in row.objects]


def describe_models(preset: str) -> pd.DataFrame:
    """What each model starts from and differs in, and its steps."""
    config = load_preset(preset)
    rows = {(name, row.name): [row.start, row.difference, configure_study(config, name, "fixes")[row.name].steps]
            for name, row in list_fixes()}  # fmt: skip
    return pd.DataFrame(rows, ["starts from", "differs in", "steps"]).T


def check(paths: Paths, *, steps: int = 0, objects: str | Sequence[str] = OBJECTS, **_: Any) -> None:
    """ValueError for a number of steps that is none, and for other objects."""
    read_count("steps", steps)
    choose_objects(objects)


def run(
    paths: Paths, *, overwrite: bool = False, images: str = "", steps: int = 0, objects: str | Sequence[str] = OBJECTS
) -> Path:  # fmt: skip
    """Render what is not there, train, and ask for the one match and for all; broken_symmetry.json.

    ``images`` is the preset whose images and questions are used, "" is the same. With ``steps``, the studies' own
    where 0, it is broken_symmetry_4000.json, say. Rows of other ``objects`` stay.
    """
    file = list_shown(paths, steps=steps)[0]
    rows = {f"{name}, {row.name}": _measure(paths, name, row, images or paths.preset, steps, overwrite=overwrite)
            for name, row in list_fixes() if name in choose_objects(objects)}  # fmt: skip
    return write_results(read_results(file) | rows, file)


def list_shown(paths: Paths, *, steps: int = 0, **_: Any) -> list[Path]:
    """The results file of so many steps."""
    return [paths.results / (f"broken_symmetry_{steps}.json" if steps else "broken_symmetry.json")]


def _measure(paths: Paths, object: str, row: Model, images: str, steps: int, *, overwrite: bool) -> dict[str, Any]:
    """Errors of the most probable of as many modes as the symmetry has: a single one would lie between the matches."""
    config, place, how = load_preset(images), Paths(paths.root, images), {"overwrite": overwrite}
    model = configure_study(load_preset(paths.preset), object, "fixes", steps=steps)[row.name]
    suffix = "-broken" if row.scene else ""
    scene = dataclasses.replace(config.render[object], **row.scene)
    data = render_dataset(scene, place.dataset(f"{object}{suffix}"), **how)
    weights = train_model(model, data, place.generated / "models" / f"{model.name}{suffix}", **how)
    options = {"modes": load_group(object, DEFAULT_GROUP[object]).order, **how}
    files = [evaluate_model(weights, data, config.evaluate, place.queries(f"{model.name}{suffix}-{group}"), group=group,
                            **options) for group in (TOLD, DEFAULT_GROUP[object])]  # fmt: skip
    own, every = map(load_queries, files)
    return summarise({TOLD: files[0]})[TOLD] | _compare(own, every, object) | {
        "train_images": scene.train_images, "run": describe_run(weights),
    }  # fmt: skip


def _compare(own: pd.DataFrame, every: pd.DataFrame, object: str) -> dict[str, float]:
    """Of visible queries, asked for one match and for all: px to the nearest match, and shares that are right."""
    own, every = own[own.visible], every[own.visible]
    several = every.n > 1
    right = (own.rmse_px <= every.nearest_px + RIGHT_PX)[several]
    row = {"nearest_of_all": float(every.nearest_px.mean()), "right": float(right.mean())}
    if object == "rope":
        row["right_at_end"] = float(right[own.point[several] < END * N_POINTS].mean())
    return row


def describe_fixes(results: Results) -> Table:
    """PCL's errors with and without prior work's ways to break the symmetry."""
    columns = [
        *ERRORS, Column("nearest_of_all", "nearest", "nearest match px", optional=True),
        Column("right", "right", "the right one", ".0f", scale=100, optional=True),
        Column("train_images", "trained on", form=",d", optional=True),
    ]  # fmt: skip
    if any("right_at_end" in row for row in results.values()):
        columns.append(Column("right_at_end", page="at the first end", form=".0f", scale=100, optional=True))
    return Table("images", {"": columns}, {images: {"": row} for images, row in results.items()})


def judge_rotation_limit(results: Results) -> Claim:
    """The first fix of prior work; its errors are not kept by angle, so the cause stays open."""
    free, limited = (get(results, "broken_symmetry", f"cloth, {fix}") for fix in ("any rotation", "±45° only"))
    share, right = get(limited, "pck@20px"), get(limited, "right")
    suffers = None if right is None else right < SURE
    errors = {"any rotation": get(free, "rmse_mean"), "±45°": get(limited, "rmse_mean")}
    return Claim(
        "rotation-limit", "PCL still suffers where the cloth turns by no more than ±45°.",
        f"Limited, PCL takes the right one of four matches in fewer than {100 * SURE:.0f} % of its answers, a part; "
        "its errors gather at the range's ends, a part not measured.",
        f"{list_errors(errors)}; limited, {say(share, 'percent')} found within 20 px, right {say(right, 'percent')}",
        (suffers, None),
        runs="broken_symmetry",
    )  # fmt: skip


def judge_ball(results: Results) -> Claim:
    """The second fix of prior work, from the longer training where it is there."""
    file = LONGER if LONGER in results else "broken_symmetry"
    fixes = {"plain": "rope, plain", "with a ball": "rope, ball at one end"}
    rows = {name: get(results, file, key) for name, key in fixes.items() if get(results, file, key)}
    errors, right = ({name: get(row, key) for name, row in rows.items()} for key in ("rmse_mean", "right"))
    at_ball = get(rows, "with a ball", "right_at_end")
    return Claim(
        "ball", "A ball at one end of the rope breaks its symmetry.",
        f"PCL takes the right one of the two matches in {100 * CHOSEN:.0f} % of its answers or more.",
        f"{list_errors(errors)}; right {list_shares(right) or '–'}"
        + (f"; on the ball {say(at_ball, 'percent')}" if at_ball is not None else ""),
        (is_at_least(right.get("with a ball"), CHOSEN),), runs=file,
        command=AGAIN if file == LONGER else "",
    )  # fmt: skip


STUDY = Study(
    "broken_symmetry", 70, run, check, "11_broken_symmetry", ("broken_symmetry", LONGER), list_shown,
    tables={
        "fixes": Shown("paper/broken_symmetry.json", describe_fixes, "fixes_table"),
        "fixes_4000": Shown("paper/broken_symmetry_4000.json", describe_fixes),
    },
    claims=(judge_rotation_limit, judge_ball),
)  # fmt: skip
