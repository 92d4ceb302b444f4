"""Weights that go with the repository: half precision, each with a card that says what it is.

    python -m mmgsd ship paper              data/generated/paper/models -> data/weights/cloth.safetensors, .md …
    python -m mmgsd ship paper --restore    and back: evaluation and figures then need no training
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import torch

from mmgsd.command import Option
from mmgsd.config import OBJECTS, TrainConfig, load_preset
from mmgsd.files import DamagedFileError, ForeignFileError, is_kept, locked, quarantine, write_bytes, write_text
from mmgsd.measure.calibration import calibrate_weights
from mmgsd.measure.evaluation import read_results
from mmgsd.model.tensors import WEIGHTS, load_metadata, read_config, read_tensors, write_tensors
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import SHIPPED, configure_model
from mmgsd.studies.parameters import check_made
from mmgsd.studies.sample import PAPER_SIZE

CARD = """# {title}

Descriptors of the method `{method}` for a {object}, symmetry group `{group}`; `mmgsd.load("{name}")`.

| | |
|---|---|
| data | {presets}, {images} training images of {width} x {height} px, seed {data_seed}, fingerprint `{data}` |
| training | {steps} steps of {batch} images at {input_px} px, seed {seed}, {minutes:.0f} minutes on {hardware} |
{errors}
| file | {megabytes:.1f} MB, safetensors, weights in half precision |

{limits}
"""
ERRORS = (
    "| RMSE, {where} | {rmse_mean:.1f} px mean, {median:.1f} px median, {queries:,} queries with a visible source |"
)
AVERAGED = "| weights | {which} {names} |"
NOT_MEASURED = "| RMSE | not measured yet |"
PHOTOGRAPHS = "| photographs | of {photographs}, {found:.0f} % of the marked places found within 5 % of the size |"
LIMITS = """\
Known limits: learnt from rendered images only, of one object wholly in view and seen from above. Matches that are
hidden in the image are guessed. The weights may have been asked before they were rounded to half precision, which does
not show in these numbers."""
CLUTTER_LIMITS = """\
Known limits: learnt from rendered images only, of one object in each, also among other things and seen obliquely; of
photographs nothing was learnt. `Match.visible`, `on_object` and `absent` say what is hidden or not there."""


def ship_model(weights: Path, out: Path, facts: dict) -> Path:
    """Write ``weights`` in half precision to ``out``, the card beside it; vectors (normalisation) stay as they are.

    A file that says the same already is left alone: the order of a safetensors header's entries is not kept.
    ``facts``: ``preset``, ``data_seed``, and ``measured``, {which test images: ``rmse_mean``, ``median``, ``queries``}
    and under "photographs" `mmgsd.measure.photographs.measure_photographs`; what else the card says of several
    trainings after one another: ``presets``, ``images``, ``steps``, ``seed`` and ``minutes``.
    DamagedFileError for damaged weights, ForeignFileError where ``out`` or the card's place is another kind of file.
    """
    tensors, note = read_tensors(weights)
    state = {name: value.half() if value.ndim > 1 else value for name, value in tensors.items()}
    config, _ = read_config(weights)
    _check_replaceable(out)
    if not out.is_file() or not _holds(out, state, note):
        write_tensors(out, state, note)
    width, height = json.loads(note["size"])
    presets = "preset " + " and ".join(f"`{name}`" for name in (facts["preset"], config.also) if name)
    described = {
        **dataclasses.asdict(config), **note, "name": out.stem, "width": width, "height": height,
        "title": f"{out.stem}.safetensors", "minutes": float(note["seconds"]) / 60, "presets": presets,
        "megabytes": out.stat().st_size / 1e6, "errors": _describe_errors(facts["measured"]),
        "limits": CLUTTER_LIMITS if config.clutter else LIMITS, **facts,
    }  # fmt: skip
    if averaged := json.loads(note.get("averaged", "[]")):
        which, names = "the average of" if len(averaged) > 1 else "those of", ", ".join(f"`{n}`" for n in averaged)
        described["errors"] = AVERAGED.format(which=which, names=names) + "\n" + described["errors"]
    write_text(out.with_suffix(".md"), CARD.format(**described))
    return out


def _describe_errors(measured: dict[str, dict]) -> str:
    """Rows of the card's table."""
    lines = [ERRORS.format(where=where, **row) for where, row in measured.items() if where != "photographs"]
    if photographs := measured.get("photographs"):
        percent = 100 * photographs["found@5%"]
        lines.append(PHOTOGRAPHS.format(photographs=photographs["photographs"], found=percent))
    return "\n".join(lines) or NOT_MEASURED


def _check_replaceable(out: Path) -> None:
    """Refuse to replace what is no shipped model, or no card of one; a damaged model is set aside."""
    card = out.with_suffix(".md")
    if card.is_file() and not card.read_text(errors="replace").startswith(f"# {out.name}\n"):
        raise ForeignFileError(f"{card} is no card of {out.name}: move it away, or choose another name")
    if not out.is_file():
        return
    try:
        note = load_metadata(out)
    except DamagedFileError:
        quarantine(out)
        return
    if note.get("format") != "mmgsd-1":
        raise ForeignFileError(f"{out} holds no weights of this project: move it away, or choose another name")


def restore_model(shipped: Path, folder: Path, config: TrainConfig) -> Path:
    """Copy a shipped model to where training would have left it; the path of its weights, which stay half precision.

    A model that is trained there is left as it is, unless it is damaged. ValueError where the shipped one has another
    configuration or is damaged, LockedError while one is trained there.
    """
    read_tensors(shipped)
    theirs, _ = read_config(shipped)
    if theirs != config:
        raise ValueError(f"{shipped} is {theirs.name}, and {config.name} was asked for: train that one")
    weights = folder / WEIGHTS
    with locked(folder, "restoring"):
        if not is_kept(weights, read_tensors):  # whole ones, whatever they hold, are kept
            write_bytes(weights, shipped.read_bytes())
    return weights


def _holds(file: Path, state: dict[str, torch.Tensor], note: dict[str, str]) -> bool:
    tensors, metadata = read_tensors(file)
    return (
        tensors.keys() == state.keys()
        and metadata == note
        and all(torch.equal(tensors[name], value) for name, value in state.items())
    )


@torch.no_grad()
def main(
    preset: str = "paper",
    *,
    restore: Annotated[bool, Option("shipped models to where training would leave them")] = False,
) -> None:
    """Ship the models of a preset, those that are trained and evaluated; or take the shipped ones for trained."""
    config, paths = load_preset(preset), Paths(find_root(), preset)
    models = {(name, method): configure_model(config, name, method) for name in OBJECTS for method in PAPER_SIZE}
    shipped = {key: paths.root / "data" / "weights" / f"{key[0]}{SHIPPED[key[1]]}.safetensors" for key in models}
    if restore:
        for key, file in shipped.items():
            if file.is_file():
                print(restore_model(file, paths.model(models[key]), models[key]))
        return
    check_made(paths, "04_evaluate with run=True", [paths.results / "rmse.json"])
    for (name, method), model in models.items():
        weights, measured = paths.model(model) / WEIGHTS, _find_measured(paths, name, method)
        if not (weights.is_file() and measured):
            print(f"{name} {method}: not trained and evaluated yet")
            continue
        if paths.dataset(name).is_dir():  # elsewhere trained weights are shipped as they came
            calibrate_weights(weights, paths.dataset(name))
        facts = {"preset": preset, "data_seed": config.render[name].seed, "measured": measured}
        print(ship_model(weights, shipped[name, method], facts))


def _find_measured(paths: Paths, object: str, method: str) -> dict[str, dict]:
    """What the results hold of a shipped model, {} where nothing is measured."""
    row = read_results(paths.results / "rmse.json", depth=2).get(object, {}).get(method)
    return {paths.preset: row} if row else {}
