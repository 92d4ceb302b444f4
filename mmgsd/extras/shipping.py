"""Weights that go with the repository: half precision, each with a card that says what it is.

python -m mmgsd.extras.shipping paper             data/generated/paper/models -> data/weights/cloth.safetensors, .md …
python -m mmgsd.extras.shipping paper --restore      and back: evaluation and figures then need no training
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import torch

from mmgsd.command import run_command
from mmgsd.config import OBJECTS, Paths, TrainConfig, find_root, load_preset
from mmgsd.experiments import configure_model
from mmgsd.files import DamagedFileError, ForeignFileError, locked, set_aside, write_bytes, write_text
from mmgsd.learn.checkpoints import WEIGHTS, load_metadata, read_config, read_tensors, write_tensors
from mmgsd.measure.evaluation import read_results
from mmgsd.parameters import check_made

SHIPPED = {"mmgsd": "", "spcl": "-spcl"}  # method: what its files' names end with
CARD = """# {title}

Descriptors of the method `{method}` for a {object}, symmetry group `{group}`; `mmgsd.load("{name}")`.

| | |
|---|---|
| data | preset `{preset}`, {images} training images of {width} x {height} px, seed {data_seed}, fingerprint `{data}` |
| training | {steps} steps of {batch} images at {input_px} px, seed {seed}, {minutes:.0f} minutes on {hardware} |
| RMSE | {rmse_mean:.1f} px mean, {median:.1f} px median, {queries:,} queries with a visible source |
| file | {megabytes:.1f} MB, safetensors, weights in half precision |

Known limits: rendered images only, one object wholly in view and seen from above. Matches that are
hidden in the image are guessed. The weights may have been asked before they were rounded to half precision, which does
not show in these numbers.
"""


def ship_model(weights: Path, out: Path, facts: dict) -> Path:
    """Write ``weights`` in half precision to ``out``, the card beside it; vectors (normalisation) stay as they are.

    A file that says the same already is left alone: the order of a safetensors header's entries is not kept.
    ``facts``: ``preset``, ``data_seed`` and the results ``rmse_mean``, ``median``, ``queries``.
    DamagedFileError for damaged weights, ForeignFileError where ``out`` or the card's place is another kind of file.
    """
    tensors, note = read_tensors(weights)
    state = {name: value.half() if value.ndim > 1 else value for name, value in tensors.items()}
    config, _ = read_config(weights)
    _check_replaceable(out)
    if not out.is_file() or not _holds(out, state, note):
        write_tensors(out, state, note)
    width, height = json.loads(note["size"])
    described = {
        **dataclasses.asdict(config), **note, **facts, "name": out.stem, "width": width, "height": height,
        "title": f"{out.stem}.safetensors", "minutes": float(note["seconds"]) / 60,
        "megabytes": out.stat().st_size / 1e6,
    }  # fmt: skip
    write_text(out.with_suffix(".md"), CARD.format(**described))
    return out


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
        set_aside(out)
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
        if not _is_whole(weights):
            write_bytes(weights, shipped.read_bytes())
    return weights


def _is_whole(weights: Path) -> bool:
    """Whether there are weights; damaged ones are set aside."""
    if not weights.is_file():
        return False
    try:
        read_tensors(weights)
    except DamagedFileError:
        set_aside(weights)
    return weights.is_file()


def _holds(file: Path, state: dict[str, torch.Tensor], note: dict[str, str]) -> bool:
    held, said = read_tensors(file)
    return (
        held.keys() == state.keys()
        and said == note
        and all(torch.equal(held[name], value) for name, value in state.items())
    )


def main() -> None:
    """Ship the models of a preset, those that are trained and evaluated; or take the shipped ones for trained."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.extras.shipping", description=__doc__.split("\n")[0])
    parser.add_argument("preset", nargs="?", default="paper")
    parser.add_argument("--restore", action="store_true", help="shipped models to where training would leave them")
    args = parser.parse_args()
    config, paths = load_preset(args.preset), Paths(find_root(), args.preset)
    models = {(name, method): configure_model(config, name, method) for name in OBJECTS for method in SHIPPED}
    shipped = {key: paths.root / "data" / "weights" / f"{key[0]}{SHIPPED[key[1]]}.safetensors" for key in models}
    if args.restore:
        for key, file in shipped.items():
            if file.is_file():
                print(restore_model(file, paths.model(models[key]), models[key]))
        return
    check_made(paths, "04_evaluate", [paths.results / "rmse.json"])
    results = read_results(paths.results / "rmse.json", depth=2)
    for (name, method), model in models.items():
        weights = paths.model(model) / WEIGHTS
        if not weights.is_file() or method not in results.get(name, {}):
            print(f"{name} {method}: not trained and evaluated yet")
            continue
        facts = {"preset": args.preset, "data_seed": config.render[name].seed, **results[name][method]}
        print(ship_model(weights, shipped[name, method], facts))


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    run_command(main)
