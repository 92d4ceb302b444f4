"""What the commands are told: how words are read, and the parameters that several of them have."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from mmgsd.command import Option
from mmgsd.config import MAX_MODES
from mmgsd.match.camera import read_intrinsics

PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg")


def parse_image(text: str) -> Path:
    """The path of an image, - for what is piped in."""
    return Path("/dev/stdin" if text == "-" else text)


def parse_pixel(text: str) -> tuple[float, float]:
    """(column, row)."""
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"must be column,row such as 212,148, got {text!r}")
    try:
        return float(parts[0]), float(parts[1])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be two numbers such as 212,148, got {text!r}") from error


def parse_place(text: str) -> Any:
    """A name, the number of a point, a fraction, or two of these."""
    if re.fullmatch(r"[A-Za-z_]+", text):
        return text
    try:
        parts = tuple(map(float, text.split(",")))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be a name, a number or U,V, got {text!r}") from error
    return int(text) if text.isdecimal() else parts[0] if len(parts) == 1 else parts


def parse_picture(text: str) -> Path:
    """The path of a picture to draw."""
    if Path(text).suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(f"must end with .png, .jpg, .pdf or .svg, got {text!r}")
    return Path(text)


def parse_intrinsics(text: str) -> np.ndarray:
    """The camera's matrix."""
    try:
        return read_intrinsics([float(number) for number in text.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be FX,FY,CX,CY, or nine numbers: {error}") from error


def parse_number(text: str) -> int | str:
    """A number of modes, or auto."""
    if text == "auto" or (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= MAX_MODES):
        return text if text == "auto" else int(text)
    raise argparse.ArgumentTypeError(f"must be a number from 1 to {MAX_MODES}, or auto, got {text!r}")


Weights = Annotated[str, Option("a trained model (safetensors), or a name in data/weights, like cloth", metavar="FILE")]
Trained = Annotated[Path, Option("a trained model (safetensors)")]
Image = Annotated[Path, Option(type=parse_image)]
Mask = Annotated[Path, Option(type=parse_image, metavar="FILE")]
Picture = Annotated[Path, Option("draw the answer (png, jpg, pdf or svg)", type=parse_picture, metavar="FILE")]
Printed = Annotated[bool, Option("print the answer as JSON")]
Folder = Annotated[Path, Option(metavar="FOLDER")]
