"""The commands that measure weights, go on from them, and hand them to other programs."""

from __future__ import annotations

import sys
from json import dumps
from pathlib import Path
from typing import Annotated

import mmgsd
from mmgsd.cli.arguments import Folder, Picture, Trained, Weights
from mmgsd.cli.outputs import save_picture
from mmgsd.command import Option


def measure(
    place: Annotated[Folder, Option("with index.json, or such a file; its format: mmgsd/measure/photographs.py")],
    *,
    weights: Weights = "cloth",
    out: Annotated[Picture, Option("draw an answer about each photograph")] | None = None,
    store: Annotated[str, Option("write the numbers to data/results/photographs_NAME.json", metavar="NAME")] = "",
    json: Annotated[bool, Option("print the numbers as JSON")] = False,
) -> None:
    """Measure on photographs with marked corners or ends."""
    from mmgsd.measure.photographs import check_name, make_photographs_table, measure_photographs, store_photographs

    if store:
        check_name(store)
    if out and out.exists() and out.resolve().is_relative_to(place.resolve()):
        raise ValueError(f"--out must not replace a file among the photographs, got {out}")
    from mmgsd.figures.photographs import ContactSheet  # last: its hint would name the extra of pictures alone

    sheet = ContactSheet()
    looking = {"seen": sheet.add} if out else {}
    results = measure_photographs(weights, place, progress=sys.stderr.isatty(), **looking)
    if out:
        save_picture(sheet.plot(), out)
    if store:
        store_photographs(results, store)
    print(dumps(results) if json else make_photographs_table(results), flush=True)


def adapt(
    folder: Annotated[Folder, Option("photographs, with marks in an index.json as measure reads it, or such a file")],
    *,
    weights: Weights = "cloth",
    out: Annotated[Path, Option("the weights to write (safetensors)", metavar="FILE")],
    renders: Annotated[Folder, Option("a data set of the object: it keeps what is known (default: the sample)")]
    | None = None,
    overwrite: Annotated[bool, Option("replace weights that were made of anything else")] = False,
) -> None:
    """Go on from weights with photographs, and print the card of what that did."""
    written = mmgsd.adapt(folder, weights, out, renders=renders, overwrite=overwrite)
    print(written.with_suffix(".md").read_text("utf-8"), end="")


def export(*, out: Annotated[Path, Option("the file to write, .onnx", metavar="FILE")], weights: Weights) -> None:
    """Write a network as ONNX: image in, descriptors out."""
    from mmgsd.extras.exporting import export_onnx

    difference = export_onnx(mmgsd.load(weights), out)
    print(f"{out}: images in, what Matcher.describe says of them out, the mean over quarter turns included; it "
          f"differs from torch's single precision by {difference:.1e} at most, and from Matcher.describe, which takes "
          "bfloat16 for some layers on a CPU that has it, by up to 1e-2")  # fmt: skip


def page(
    out: Annotated[Path, Option("the folder to write; docs/page.md says how to host it", metavar="OUT")],
    *,
    weights: Weights = "cloth",
    runtime: Annotated[Folder, Option("the npm package onnxruntime-web, unpacked; by default npm downloads it")]
    | None = None,
) -> None:
    """Write a page that matches in a browser."""
    from mmgsd.extras.page import make_page

    folder = make_page(mmgsd.load(weights), out, name=Path(weights).stem, runtime=runtime)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {size / 1e6:.0f} MB; to try it: python -m http.server --directory {folder}")


def calibrate(
    weights: Trained,
    *,
    data: Annotated[Folder, Option("the data set trained on")] | None = None,
    unseen: Annotated[list[Path], Option("data sets whose test images were not trained on: by them how modes are read "
                                         "is chosen, too", nargs="+", metavar="FOLDER")] | None = None,
    overwrite: Annotated[bool, Option("fit it anew where the weights have it")] = False,
) -> None:  # fmt: skip
    """Fit what ellipses, radii and confidences promise, by either --data or --unseen, and keep it in the weights."""
    if bool(data) == bool(unseen):
        raise ValueError(f"one of --data and --unseen must be given, got {'both' if data else 'neither'}")
    from mmgsd.measure.calibration import calibrate_unseen, calibrate_weights

    calibrated = calibrate_weights if data else calibrate_unseen
    matcher = mmgsd.load(calibrated(weights, data or unseen, overwrite=overwrite))
    calibration, readout = matcher.calibration, matcher.readout
    print(f"{weights}: modes read with power {readout.exponent:g} and sharpness {readout.mean_exponent:g}, "
          f"sources with shrinkage {matcher.shrinkage:g}; "
          f"calibrated on {calibration.pairs} pairs of held-out simulations; each half by the other: ECE "
          f"{calibration.ece_ellipse:.3f} of ellipses, {calibration.ece_confidence:.3f} of confidences")  # fmt: skip


def heads(
    weights: Trained,
    *,
    data: Annotated[Folder, Option("the data set trained on")],
    out: Annotated[Path, Option("the results to write (JSON)", metavar="FILE")],
) -> None:
    """Measure the masks, hidden matches and absence that weights tell beside their matches, and store it."""
    from mmgsd.config import EvaluateConfig
    from mmgsd.files import read_json
    from mmgsd.match.matcher import find_weights
    from mmgsd.measure.heads import evaluate_heads

    print(dumps(read_json(evaluate_heads(find_weights(weights), data, EvaluateConfig(pairs=100), out))))
