"""The words of the command line ``mmgsd``, or ``python -m mmgsd``. What its commands do is in `mmgsd.cli`."""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

import mmgsd
from mmgsd import cli
from mmgsd.command import describe_error, print_anywhere, wants_traceback
from mmgsd.config import MAX_MODES, OBJECTS
from mmgsd.match.camera import read_intrinsics

EXAMPLE = "example: %(prog)s towel1.jpg towel2.jpg --xy 212,148 --weights FILE --out match.png"
PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg")


def main(arguments: list[str] | None = None) -> None:
    """Run a command.

    Exits with 2 and one sentence for a wrong argument or a file that does not do, with 1 where the result cannot be
    written or one of many images could not be answered, and with 130 after Ctrl-C.
    """
    print_anywhere()
    parser = make_parser()
    args = parser.parse_args(_join_negative(sys.argv[1:] if arguments is None else arguments))
    os.environ["MPLBACKEND"] = "Agg"  # another environment's, such as a notebook's, may be missing in this one
    if wants_traceback():
        return args.run(args)
    try:
        args.run(args)
    except KeyboardInterrupt as stopped:
        parser.exit(130, f"stopped: {stopped or _say_kept(args)}\n")
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        parser.exit(2, f"error: {cli.say_error(error)}\n")
    except ModuleNotFoundError as error:
        parser.exit(2, f"error: {describe_error(error)}\n")
    except (OSError, RuntimeError, MemoryError) as error:
        parser.exit(1, f"error: {cli.say_error(error)}\n")


def _join_negative(words: list[str]) -> list[str]:
    """``--xy -0.4,3`` as ``--xy=-0.4,3``: argparse takes what begins with a minus for an option."""
    joined = []
    for word in words:
        if joined and joined[-1].startswith("--") and re.match(r"-\.?\d", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _say_kept(args: argparse.Namespace) -> str:
    written = [str(path) for path in (getattr(args, name, None) for name in ("out", "csv")) if path]
    if not written:
        return "there was nothing to keep"
    return f"{' and '.join(written)} {'is as it was' if len(written) == 1 else 'are as they were'} before"


def make_parser() -> argparse.ArgumentParser:
    """The commands and their options."""
    prog = "python -m mmgsd" if Path(sys.argv[0]).name == "__main__.py" else "mmgsd"
    parser = argparse.ArgumentParser(prog=prog, description=mmgsd.__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    _add_match(commands.add_parser("match", help="find all matches of pixels of an image in others", epilog=EXAMPLE))
    _add_find(commands.add_parser("find", help="find places of the object by name, without a first image"))
    _add_track(commands.add_parser("track", help="follow points of the first frame through a video, each as itself"))
    _add_segment(commands.add_parser("segment", help="write where an image shows the object"))
    _add_measure(commands.add_parser("measure", help="measure on photographs with marked corners or ends"))
    _add_adapt(commands.add_parser("adapt", help="go on from weights with photographs of yours"))
    _add_fold(commands.add_parser("fold", help="say where to pick and place in a picture, as a demonstration did"))
    _add_export(commands.add_parser("export", help="write a network as ONNX: image in, descriptors out"))
    _add_page(commands.add_parser("page", help="write a folder of static files that matches in a browser"))
    for name, command in commands.choices.items():
        default = {"default": "cloth"} if name in ("measure", "adapt", "page") else {"required": True}
        command.add_argument("--weights", metavar="FILE", **default,
                             help="a trained model (safetensors), or a name in data/weights, like cloth")  # fmt: skip
    _add_measures(commands)
    samples = commands.add_parser("samples", help="print the paths of two sample images")
    samples.add_argument("object", nargs="?", default="cloth", choices=OBJECTS)
    samples.set_defaults(run=cli.samples)
    return parser


def _add_measures(commands: argparse._SubParsersAction) -> None:
    """The commands that need a data set."""
    calibrate = commands.add_parser("calibrate", help="fit what ellipses, radii and confidences promise, and keep it")
    calibrate.add_argument("--overwrite", action="store_true", help="fit it anew where the weights have it")
    calibrate.set_defaults(run=cli.calibrate)
    heads = commands.add_parser("heads", help="measure the masks, hidden matches and absence that weights tell")
    heads.add_argument("--out", type=Path, required=True, metavar="FILE", help="the results to write (JSON)")
    heads.set_defaults(run=cli.heads)
    by = calibrate.add_mutually_exclusive_group(required=True)
    unseen = "data sets whose test images were not trained on: by them how modes are read is chosen, too"
    by.add_argument("--unseen", type=Path, nargs="+", metavar="FOLDER", help=unseen)
    for command, place in ((calibrate, by), (heads, heads)):
        command.add_argument("weights", type=Path, help="a trained model (safetensors)")
        required = {"required": True} if place is heads else {}
        place.add_argument("--data", type=Path, metavar="FOLDER", help="the data set trained on", **required)


def _add_match(match: argparse.ArgumentParser) -> None:
    match.add_argument("image0", type=_parse_image, help="the image that the pixels are in, - for what is piped in")
    match.add_argument("image1", type=_parse_image, help="the image to find them in, or a folder of such images")
    match.add_argument("--xy", type=_parse_pixel, action="append", required=True, metavar="X,Y",
                       help="column,row px in image0, the top left one is 0,0; may be given several times")  # fmt: skip
    match.add_argument("--n", type=_parse_number, metavar="N", help="modes, or auto; default: as many as its symmetry")
    order = match.add_mutually_exclusive_group()
    order.add_argument("--joint", action="store_true",
                       help="answer all pixels together: the modes of one number belong together")  # fmt: skip
    order.add_argument("--seen-first", action="store_true", help="list matches that are seen before hidden ones")
    for name in ("mask0", "mask1"):
        match.add_argument(f"--{name}", type=_parse_image, metavar="FILE",
                           help=f"an image as large as image{name[-1]}, brighter than half on the object")  # fmt: skip
    match.add_argument("--out", type=_parse_picture, metavar="FILE", help="draw the answer (png, jpg, pdf or svg)")
    match.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw the answer of each image of a folder")
    match.add_argument("--csv", type=Path, metavar="FILE", help="write a table, a row a mode")
    match.add_argument("--json", action="store_true", help="print the answer as JSON, of a folder a line an image")
    match.set_defaults(run=cli.match)


def _add_find(find: argparse.ArgumentParser) -> None:
    find.add_argument("image", type=_parse_image, help="the image to find them in")
    find.add_argument("places", nargs="+", type=_parse_place, metavar="PLACE",
                      help="corners, edges, centre or U,V in [0, 1] of a cloth; ends, middle or a fraction such as "
                      "0.25 of a rope; of any object the number of a material point")  # fmt: skip
    order = find.add_mutually_exclusive_group()
    order.add_argument("--joint", action="store_true", help="answer all places together")
    order.add_argument("--seen-first", action="store_true", help="list places that are seen before hidden ones")
    find.add_argument("--mask", type=_parse_image, metavar="FILE", help="brighter than half on the object")
    find.add_argument("--out", type=_parse_picture, metavar="FILE", help="draw the answer (png, jpg, pdf or svg)")
    find.add_argument("--json", action="store_true", help="print the answer as JSON")
    find.set_defaults(run=cli.find)


def _add_track(track: argparse.ArgumentParser) -> None:
    track.add_argument("video", type=Path, help="a video, an animated GIF or WebP, or a folder of frames")
    points = track.add_mutually_exclusive_group(required=True)
    points.add_argument("--xy", type=_parse_pixel, action="append", metavar="X,Y",
                        help="column,row px in the first frame; may be given several times")  # fmt: skip
    points.add_argument("--find", type=_parse_place, action="append", metavar="PLACE",
                        help="instead, places as the command find takes them, such as corners")  # fmt: skip
    track.add_argument("--mask0", type=Path, metavar="FILE", help="brighter than half on the first frame's object")
    track.add_argument("--out", type=Path, required=True, metavar="PLACE",
                       help="what to write: .csv, .json, .mp4, .webm or .avi, or a folder for several")  # fmt: skip
    track.set_defaults(run=cli.track)


def _add_fold(fold: argparse.ArgumentParser) -> None:
    fold.add_argument("demonstration", type=Path, metavar="DEMO.json", help="see docs/folding.md")
    fold.add_argument("image", type=_parse_image, help="a picture of the present state")
    fold.add_argument("--look", type=int, default=0, help="which of the demonstration's looks (default: 0, the first)")
    fold.add_argument("--chosen", default="agree", choices=("agree", "best", "joint"),
                      help="which like modes are taken: those that one motion agrees with (the default), each pixel's "
                      "surest, or the surest that belong together")  # fmt: skip
    fold.add_argument("--intrinsics", type=_parse_intrinsics, metavar="FX,FY,CX,CY",
                      help="px, or the nine numbers of the matrix; prints rays too")  # fmt: skip
    fold.add_argument("--out", type=_parse_picture, metavar="FILE", help="draw the moves (png, jpg, pdf or svg)")
    fold.add_argument("--json", action="store_true", help="print the answer as JSON")
    fold.set_defaults(run=cli.fold)


def _add_segment(segment: argparse.ArgumentParser) -> None:
    segment.add_argument("image", type=_parse_image, help="the image to look at")
    segment.add_argument("--out", type=Path, required=True, metavar="FILE",
                         help="the mask to write, .png: brighter than half on the object")  # fmt: skip
    segment.set_defaults(run=cli.segment)


def _add_measure(measure: argparse.ArgumentParser) -> None:
    measure.add_argument("place", type=Path, metavar="FOLDER",
                         help="with index.json, or such a file; its format: mmgsd/measure/photographs.py")  # fmt: skip
    measure.add_argument("--out", type=_parse_picture, metavar="FILE", help="draw an answer about each photograph")
    measure.add_argument("--store", metavar="NAME", help="write the numbers to data/results/photographs_NAME.json")
    measure.add_argument("--json", action="store_true", help="print the numbers as JSON")
    measure.set_defaults(run=cli.measure)


def _add_adapt(adapt: argparse.ArgumentParser) -> None:
    adapt.add_argument("folder", type=Path, metavar="FOLDER",
                       help="photographs, with marks in an index.json as measure reads it, or such a file")  # fmt: skip
    adapt.add_argument("--out", type=Path, required=True, metavar="FILE", help="the weights to write (safetensors)")
    adapt.add_argument("--renders", type=Path, metavar="FOLDER",
                       help="a data set of the object: it keeps what is known (default: the sample)")  # fmt: skip
    adapt.add_argument("--overwrite", action="store_true", help="replace weights that were made of anything else")
    adapt.set_defaults(run=cli.adapt)


def _add_export(export: argparse.ArgumentParser) -> None:
    export.add_argument("--out", type=Path, required=True, metavar="FILE", help="the file to write, .onnx")
    export.set_defaults(run=cli.export)


def _add_page(page: argparse.ArgumentParser) -> None:
    page.add_argument("out", type=Path, metavar="OUT", help="the folder to write; docs/page.md says how to host it")
    page.add_argument("--runtime", type=Path, metavar="FOLDER",
                      help="the npm package onnxruntime-web, unpacked; by default npm downloads it")  # fmt: skip
    page.set_defaults(run=cli.page)


def _parse_image(text: str) -> Path:
    return Path("/dev/stdin" if text == "-" else text)


def _parse_pixel(text: str) -> tuple[float, float]:
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"must be column,row such as 212,148, got {text!r}")
    try:
        return float(parts[0]), float(parts[1])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be two numbers such as 212,148, got {text!r}") from error


def _parse_place(text: str) -> Any:
    """A name, the number of a point, a fraction, or two of these."""
    if re.fullmatch(r"[A-Za-z_]+", text):
        return text
    try:
        parts = tuple(map(float, text.split(",")))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be a name, a number or U,V, got {text!r}") from error
    return int(text) if text.isdecimal() else parts[0] if len(parts) == 1 else parts


def _parse_picture(text: str) -> Path:
    if Path(text).suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(f"must end with .png, .jpg, .pdf or .svg, got {text!r}")
    return Path(text)


def _parse_intrinsics(text: str) -> np.ndarray:
    try:
        return read_intrinsics([float(number) for number in text.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be FX,FY,CX,CY, or nine numbers: {error}") from error


def _parse_number(text: str) -> int | str:
    if text == "auto" or (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= MAX_MODES):
        return text if text == "auto" else int(text)
    raise argparse.ArgumentTypeError(f"must be a number from 1 to {MAX_MODES}, or auto, got {text!r}")


if __name__ == "__main__":
    main()
