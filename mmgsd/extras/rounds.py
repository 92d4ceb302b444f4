"""The shipped models' training, in rounds that a laptop's evening holds: each on new images, from the round before.

    python -m mmgsd rounds cloth           every round that is missing, one after another
    python -m mmgsd rounds cloth --last 2  up to the second

A round renders its clean and its cluttered images, with seeds of its own, trains on them and leaves its weights as
``data/weights/cloth-round2.safetensors``, from which the next one goes on: of the rounds before nothing else is needed.
Its errors on simulations held out from it are kept in data/results/rounds.json. These are few: beside them stand the
errors on all of its images, of the weights ``before``, which never saw them, and of those ``after``, trained on them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import pandas as pd

from mmgsd.command import Option
from mmgsd.config import OBJECTS, ROUNDS, TrainConfig, load_preset
from mmgsd.dataset import load_parts
from mmgsd.extras.shipping import ship_model
from mmgsd.files import write_json
from mmgsd.learn.checkpoints import LOG
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import load
from mmgsd.measure.evaluation import read_results
from mmgsd.measure.questions import measure_rmse
from mmgsd.model.tensors import describe_run
from mmgsd.paths import Paths, find_root
from mmgsd.scene.stage import render_dataset
from mmgsd.studies.models import configure_study

VALIDATIONS = 8  # of a round
PAIRS, POINTS = 200, 60  # of all of a round's images, and material points asked about
RESULTS = "rounds.json"  # in data/results


def find_round(root: Path, object: str) -> int:
    """The last round of an object whose weights are there, 0 where none are."""
    done = [number for number in range(1, ROUNDS + 1) if _find_file(root, object, number).is_file()]
    return max(done, default=0)


def render_round(root: Path, object: str, number: int, *, workers: int = 0) -> Path:
    """Render a round's images, the cluttered ones first; the folder of the clean ones."""
    clean = load_preset(f"round{number}")
    for preset in (load_preset(clean.cluttered), clean):
        folder = render_dataset(preset.render[object], Paths(root, preset.name).dataset(object), workers=workers)
    return folder


def run_round(root: Path, object: str, number: int, *, workers: int = 0) -> Path:
    """Render, train and ship one round, what is done of it left as it is; returns its shipped weights."""
    preset = load_preset(f"round{number}")
    paths, model = Paths(root, preset.name), configure_study(preset, object, "rounds")[f"round{number}"]
    data = render_round(root, object, number, workers=workers)
    weights = train_model(model, data, paths.model(model), validate_every=model.steps // VALIDATIONS)
    files = {"before": _find_file(root, object, number - 1), "after": weights}
    errors = {name: measure_images(file, data, model) for name, file in files.items() if file.is_file()}
    _keep_curve(root, object, number, weights, errors)
    facts = {"preset": preset.name, "data_seed": number, "measured": {}}
    return ship_model(weights, _find_file(root, object, number), facts)


def _find_file(root: Path, object: str, number: int) -> Path:
    return root / "data" / "weights" / f"{object}-round{number}.safetensors"


def measure_images(weights: Path, data: Path, model: TrainConfig) -> dict[str, float]:
    """The error (px) of weights on all training images of a round, clean and cluttered ones."""
    matcher, parts = load(weights), load_parts(data, "train", also=model.also)
    errors = [round(measure_rmse(matcher, part, pairs=PAIRS, points=POINTS), 2) for part in parts]
    return dict(zip(("clean", "cluttered"), errors, strict=False))


def _keep_curve(root: Path, object: str, number: int, weights: Path, errors: dict[str, dict[str, float]]) -> None:
    """Add a round's curve, its cost, and the ``errors`` before and after it to the results."""
    file = root / "data" / "results" / RESULTS
    rows: dict[str, Any] = read_results(file, depth=2)
    log = pd.read_csv(weights.with_name(LOG)).dropna(subset="rmse_px")
    curve = {str(step): rmse for step, rmse in zip(log.step, log.rmse_px, strict=True)}
    rows.setdefault(object, {})[str(number)] = {"rmse_px": curve, "run": describe_run(weights), **errors}
    write_json(file, {name: dict(sorted(rows[name].items())) for name in OBJECTS if name in rows})


def main(
    object: Annotated[str, Option(choices=OBJECTS)],
    *,
    last: Annotated[int, Option("go on up to this round", choices=range(1, ROUNDS + 1))] = ROUNDS,
    render_only: Annotated[bool, Option("render the next round's images and stop")] = False,
    workers: Annotated[int, Option("processes that render (default: one a core)")] = 0,
) -> None:
    """Run the rounds of an object that are missing."""
    root = find_root()
    for number in range(find_round(root, object) + 1, last + 1):
        if render_only:
            print(render_round(root, object, number, workers=workers))
            return
        print(run_round(root, object, number, workers=workers))
