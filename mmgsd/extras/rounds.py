"""The shipped models' training, in rounds that a laptop's evening holds: each on new images, from the round before.

    python -m mmgsd rounds cloth           every round that is missing, one after another
    python -m mmgsd rounds cloth --last 2  up to the second
    python -m mmgsd rounds cloth --photographs FOLDER    instead: what the last one, or --last, finds in photographs
    python -m mmgsd rounds cloth --ship                  instead: calibrate the last ones' average and ship it
    python -m mmgsd rounds cloth --card                  instead: write its card with what `run shipped cloth` found

A round renders its clean and its cluttered images, with seeds of its own, trains on them and leaves its weights as
``data/weights/cloth-round2.safetensors``, from which the next one goes on: of the rounds before nothing else is needed.
Its errors on simulations held out from it are kept in data/results/rounds.json. These are few: beside them stand the
errors on all of its images, of the weights ``before``, which never saw them, and of those ``after``, trained on them;
and, once the weights are shipped, on the same ``unseen`` images for all: each round ``alone``, and the ``averaged``
weights of it and those after it.

What is shipped as ``cloth`` is the average of the last rounds' weights (Wortsman et al., "Model soups", ICML 2022), of
as many of those that are there as err least on images of the preset ``unseen``, which no round has seen and no table is
made of; by them it is read and calibrated, too. Photographs choose nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd

from mmgsd.command import Option
from mmgsd.config import OBJECTS, ROUNDS, TrainConfig, load_preset
from mmgsd.dataset import Dataset, load_dataset, load_parts
from mmgsd.extras.shipping import ship_model
from mmgsd.files import write_json
from mmgsd.learn.checkpoints import LOG
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import load
from mmgsd.measure.calibration import calibrate_unseen
from mmgsd.measure.evaluation import read_results
from mmgsd.measure.photographs import measure_answers, read_photographs
from mmgsd.measure.questions import measure_rmse
from mmgsd.measure.shipped import SETS
from mmgsd.model.tensors import describe_run, load_metadata, read_tensors, write_tensors
from mmgsd.paths import Paths, find_root
from mmgsd.scene.stage import render_dataset
from mmgsd.studies.models import configure_study
from mmgsd.studies.shipped import RESULTS as SHIPPED_RESULTS

VALIDATIONS = 8  # of a round
UNSEEN = ("unseen", "unseen_workspace")  # presets
MOST = max(ROUNDS.values())
PAIRS, POINTS = 200, 60  # of all of a round's images, and material points asked about
RESULTS = "rounds.json"  # in data/results


def find_round(root: Path, object: str) -> int:
    """The last round of an object whose weights are there, 0 where none are."""
    done = [number for number in range(1, ROUNDS[object] + 1) if _find_file(root, object, number).is_file()]
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
    facts = {"preset": preset.name, "data_seed": preset.render[object].seed, "measured": {}}
    return ship_model(weights, _find_file(root, object, number), facts)


def _find_file(root: Path, object: str, number: int) -> Path:
    return root / "data" / "weights" / f"{object}-round{number}.safetensors"


def measure_images(weights: Path, data: Path, model: TrainConfig) -> dict[str, float]:
    """The error (px) of weights on all training images of a round, clean and cluttered ones."""
    return _measure_parts(weights, load_parts(data, "train", also=model.also))


def _measure_parts(weights: Path, parts: Sequence[Dataset]) -> dict[str, float]:
    matcher = load(weights)
    errors = [round(measure_rmse(matcher, part, pairs=PAIRS, points=POINTS), 2) for part in parts]
    return dict(zip(("clean", "cluttered"), errors, strict=False))


def _keep_curve(root: Path, object: str, number: int, weights: Path, errors: dict[str, dict[str, float]]) -> None:
    """Add a round's curve, its cost, and the ``errors`` before and after it to the results."""
    log = pd.read_csv(weights.with_name(LOG)).dropna(subset="rmse_px")
    curve = {str(step): rmse for step, rmse in zip(log.step, log.rmse_px, strict=True)}
    _keep(root, object, number, rmse_px=curve, run=describe_run(weights), **errors)


def _keep(root: Path, object: str, number: int, **results: Any) -> None:
    """Add results to the row of a round."""
    file = root / "data" / "results" / RESULTS
    rows: dict[str, Any] = read_results(file, depth=2)
    row = rows.setdefault(object, {}).get(str(number), {})
    rows[object][str(number)] = row | results
    write_json(file, {name: dict(sorted(rows[name].items())) for name in OBJECTS if name in rows})


def measure_round(root: Path, object: str, number: int, folder: Path) -> dict[str, Any]:
    """What a round finds in photographs (`measure_answers`), read as the shipped weights are; kept with it."""
    matcher = load(_find_file(root, object, number))
    matcher.readout = load(object).readout
    measured = measure_answers(matcher, read_photographs(folder, object))
    _keep(root, object, number, photographs=measured)
    return measured


def ship_rounds(root: Path, object: str, *, workers: int = 0) -> Path:
    """Average, calibrate and ship the rounds whose weights are there as those of the object; returns the file."""
    unseen = [render_dataset(load_preset(name).render[object], Paths(root, name).dataset(object), only_test=True,
                             workers=workers) for name in UNSEEN]  # fmt: skip
    parts = [load_dataset(folder, "test") for folder in unseen]
    place = root / "data" / "generated" / "rounds" / object
    errors, used = {}, []
    for number in range(find_round(root, object), 0, -1):
        file = _find_file(root, object, number)
        if file.is_file():
            used.append(file)
            averaged = average_weights(used, place / f"{len(used)}.safetensors")
            errors[averaged] = _measure_parts(averaged, parts)
            alone = _measure_parts(file, parts) if len(used) > 1 else errors[averaged]
            _keep(root, object, number, unseen={"alone": alone, "averaged": errors[averaged]})
    chosen = min(errors, key=lambda file: sum(errors[file].values()))
    calibrate_unseen(chosen, unseen)
    return ship_model(chosen, _find_shipped(root, object), _describe_rounds(root, object, chosen))


def write_card(root: Path, object: str) -> Path:
    """Write the card of the shipped weights anew, with what was measured of these; the weights' path."""
    weights, results = _find_shipped(root, object), root / "data" / "results" / SHIPPED_RESULTS
    row = read_results(results).get(object, {})
    if row.get("sha256") != hashlib.sha256(weights.read_bytes()).hexdigest():
        raise ValueError(f"object must be measured first, {results} has nothing of {weights}: "
                         f"python -m mmgsd run shipped {object}")  # fmt: skip
    measured = {name: row[name] for name in (*SETS, "photographs") if name in row}
    return ship_model(weights, weights, _describe_rounds(root, object, weights) | {"measured": measured})


def _find_shipped(root: Path, object: str) -> Path:
    return root / "data" / "weights" / f"{object}.safetensors"


def _describe_rounds(root: Path, object: str, weights: Path) -> dict[str, Any]:
    """What the card says of all rounds together, up to the last one that the averaged ``weights`` are of."""
    rows = read_results(root / "data" / "results" / RESULTS, depth=2).get(object, {})
    number = max(int(name.rpartition("round")[2]) for name in json.loads(load_metadata(weights)["averaged"]))
    runs = [row["run"] for name, row in rows.items() if int(name) <= number]
    total = {name: sum(run[name] for run in runs) for name in ("images", "steps", "minutes")}
    presets = f"presets `round1` to `round{number}` and their cluttered ones"
    seeds = ", ".join(str(load_preset(f"round{k}").render[object].seed) for k in range(1, number + 1))
    return {**total, "preset": f"round{number}", "presets": presets, "seed": f"1 to {number}", "data_seed": seeds,
            "measured": {}}  # fmt: skip


def average_weights(files: Sequence[Path], out: Path) -> Path:
    """Write the mean of several files' tensors, with the first one's metadata and what was ``averaged``, to ``out``."""
    read = [read_tensors(file) for file in files]
    mean = {name: (sum(tensors[name].float() for tensors, _ in read) / len(read)).to(value.dtype)
            for name, value in read[0][0].items()}  # fmt: skip
    return write_tensors(out, mean, {**read[0][1], "averaged": json.dumps([file.stem for file in files])})


def main(
    object: Annotated[str, Option(choices=OBJECTS)],
    *,
    last: Annotated[int, Option("go on up to this round, or measure it", choices=range(1, MOST + 1))] = MOST,
    render_only: Annotated[bool, Option("render the next round's images and stop")] = False,
    photographs: Annotated[Path, Option("instead measure the last round on these, with marks")] | None = None,
    ship: Annotated[bool, Option("instead calibrate the last rounds' average and ship it")] = False,
    card: Annotated[bool, Option("instead write its card with what it was measured to do")] = False,
    workers: Annotated[int, Option("processes that render (default: one a core)")] = 0,
) -> None:
    """Run the rounds of an object that are missing; or measure, or ship, those that are there."""
    root = find_root()
    if card:
        print(write_card(root, object))
        return
    if ship or photographs:
        if not find_round(root, object):
            raise ValueError(f"object must have a round trained first, {object!r} has none in data/weights")
        if photographs:
            print(json.dumps(measure_round(root, object, min(last, find_round(root, object)), photographs)))
        if ship:
            print(ship_rounds(root, object, workers=workers))
        return
    for number in range(find_round(root, object) + 1, min(last, ROUNDS[object]) + 1):
        if render_only:
            print(render_round(root, object, number, workers=workers))
            return
        print(run_round(root, object, number, workers=workers))
