"""The command line: ``python -m mmgsd match``, ``python -m mmgsd export``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import mmgsd

EXAMPLE = "example: python -m mmgsd match towel1.jpg towel2.jpg --xy 212,148 --weights FILE --out match.png"


def main(arguments: list[str] | None = None) -> None:
    """Run a command; exits with 1 where a file does not do, and with 2 for a wrong argument."""
    parser = make_parser()
    asked = parser.parse_args(arguments)
    try:
        {"match": _match, "export": _export}[asked.command](asked)
    except (ValueError, OSError, RuntimeError) as error:
        parser.exit(1, f"error: {error}\n")


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
    images = [mmgsd.read_image(path) for path in (asked.image0, asked.image1)]
    answer = mmgsd.load(asked.weights).match(*images, asked.xy, n=asked.n)
    described = describe_answer(answer)
    print(json.dumps(described) if asked.json else "\n".join(map(_format_query, described)))
    if asked.out:
        _draw(answer, asked.out)


def _export(asked: argparse.Namespace) -> None:
    from mmgsd.exporting import export_onnx

    difference = export_onnx(mmgsd.load(asked.weights), asked.out)
    print(f"{asked.out}: descriptors differ from torch's by {difference:.1e} at most")


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
    """All queries, one below the other."""
    import matplotlib

    matplotlib.use("Agg")
    from mmgsd.plots import plot_teaser

    path.parent.mkdir(parents=True, exist_ok=True)
    figure = answer.plot() if len(answer.xy) == 1 else plot_teaser({"": [answer[k] for k in range(len(answer.xy))]})
    figure.savefig(path)


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
    if text == "auto" or (text.isdigit() and int(text) > 0):
        return text if text == "auto" else int(text)
    raise argparse.ArgumentTypeError(f"must be a number from 1 on, or auto, got {text!r}")


if __name__ == "__main__":
    main()
