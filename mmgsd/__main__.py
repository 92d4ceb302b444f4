"""The command line: ``python -m mmgsd match``, ``python -m mmgsd export``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

import mmgsd
from mmgsd.command import describe_error
from mmgsd.config import MAX_MODES

EXAMPLE = "example: python -m mmgsd match towel1.jpg towel2.jpg --xy 212,148 --weights FILE --out match.png"
DPI = 150  # of a picture


def main(arguments: list[str] | None = None) -> None:
    """Run a command.

    Exits with 2 and one sentence for a wrong argument or a file that does not do, with 1 where the result cannot be
    written, and with 130 after Ctrl-C.
    """
    parser = make_parser()
    asked = parser.parse_args(arguments)
    try:
        {"match": _match, "export": _export}[asked.command](asked)
    except KeyboardInterrupt:
        kept = f"{asked.out} is as it was before" if asked.out else "there was nothing to keep"
        parser.exit(130, f"stopped: {kept}\n")
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        parser.exit(2, f"error: {_say(error)}\n")
    except ModuleNotFoundError as error:
        parser.exit(2, f"error: {describe_error(error)}\n")
    except (OSError, RuntimeError, MemoryError) as error:
        parser.exit(1, f"error: {_say(error)}\n")


def _say(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def make_parser() -> argparse.ArgumentParser:
    """The commands and their options."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd", description=mmgsd.__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    match = commands.add_parser("match", help="find all matches of pixels between two image files", epilog=EXAMPLE)
    match.add_argument("image0", type=Path, help="the image that the pixels are in")
    match.add_argument("image1", type=Path, help="the image to find them in")
    match.add_argument("--xy", type=_parse_pixel, action="append", required=True, metavar="X,Y",
                       help="column,row px in image0, the top left one is 0,0; may be given several times")  # fmt: skip
    match.add_argument("--n", type=_parse_number, metavar="N", help="modes, or auto; default: as many as its symmetry")
    match.add_argument("--out", type=_parse_picture, metavar="FILE", help="draw the answer (png, jpg, pdf or svg)")
    match.add_argument("--json", action="store_true", help="print the answer as JSON")
    export = commands.add_parser("export", help="write a network as ONNX: image in, descriptors out")
    export.add_argument("out", type=Path, help="the file to write, .onnx")
    for command in (match, export):
        command.add_argument("--weights", required=True, metavar="FILE",
                             help="a trained model (safetensors), or a name in data/weights, like cloth")  # fmt: skip
    return parser


def _match(asked: argparse.Namespace) -> None:
    _check_out(asked)
    images = [mmgsd.read_image(path) for path in (asked.image0, asked.image1)]
    answer = mmgsd.load(asked.weights).match(*images, asked.xy, n=asked.n)
    described = describe_answer(answer)
    if asked.out:
        _draw(answer, asked.out)
    print(json.dumps(described) if asked.json else "\n".join(map(_format_query, described)), flush=True)


def _check_out(asked: argparse.Namespace) -> None:
    """ValueError for a picture that would replace an image, or hold more queries than a page does."""
    if not asked.out:
        return
    from mmgsd.figures.plots import PAGE_QUERIES

    if asked.out.resolve() in (asked.image0.resolve(), asked.image1.resolve()):
        raise ValueError(f"--out must not be one of the images, got {asked.out}")
    if len(asked.xy) > PAGE_QUERIES:
        raise ValueError(f"--xy must be given at most {PAGE_QUERIES} times with --out, got {len(asked.xy)}")


def _export(asked: argparse.Namespace) -> None:
    from mmgsd.extras.exporting import export_onnx

    difference = export_onnx(mmgsd.load(asked.weights), asked.out)
    print(f"{asked.out}: images of any size in, descriptors as of Matcher.describe out, the mean over quarter turns "
          f"included; they differ from torch's by {difference:.1e} at most")  # fmt: skip


def describe_answer(answer: Any) -> list[dict[str, Any]]:
    """A `Match` as plain values, a dictionary a query: px, shares, nats."""
    confidence, described = answer.confidence(), []
    for query, xy in enumerate(answer.xy):
        present = np.flatnonzero(answer.weights[query] > 0)
        modes = [
            {
                "xy": answer.modes[query, k].round(2).tolist(),
                "weight": round(float(answer.weights[query, k]), 4),
                "spread_px": round(float(answer.spread_px[query, k]), 2),
                "confidence": round(float(confidence[query, k]), 4),
            }
            for k in present
        ]
        scalars = {name: round(float(getattr(answer, name)[query]), 4) for name in ("entropy", "outside")}
        described.append({"xy": xy.round(2).tolist(), "modes": modes, **scalars})
    return described


def _format_query(query: dict[str, Any]) -> str:
    x, y = query["xy"]
    modes = ", ".join("{:.1f},{:.1f} (±{:.0f} px)".format(*m["xy"], m["spread_px"]) for m in query["modes"])
    return f"{x:g},{y:g} -> {modes}"


def _draw(answer: Any, path: Path) -> None:
    """One query as two large panels, several as a page."""
    import matplotlib

    matplotlib.use("Agg")
    from mmgsd.figures.plots import plot_page
    from mmgsd.files import writing

    figure = answer.plot() if len(answer) == 1 else plot_page(answer)
    with writing(path) as aside:
        figure.savefig(aside, format=path.suffix[1:].lower(), dpi=DPI)


def _parse_pixel(text: str) -> tuple[float, float]:
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"must be column,row such as 212,148, got {text!r}")
    try:
        return float(parts[0]), float(parts[1])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be two numbers such as 212,148, got {text!r}") from error


def _parse_picture(text: str) -> Path:
    if Path(text).suffix.lower() not in (".png", ".jpg", ".jpeg", ".pdf", ".svg"):
        raise argparse.ArgumentTypeError(f"must end with .png, .jpg, .pdf or .svg, got {text!r}")
    return Path(text)


def _parse_number(text: str) -> int | str:
    if text == "auto" or (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= MAX_MODES):
        return text if text == "auto" else int(text)
    raise argparse.ArgumentTypeError(f"must be a number from 1 to {MAX_MODES}, or auto, got {text!r}")


if __name__ == "__main__":
    main()
