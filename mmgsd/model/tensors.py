"""Files of tensors, whole or not at all, and what trained ones say of themselves."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mmgsd.config import TrainConfig, from_dict
from mmgsd.files import DamagedFileError, write_bytes

WEIGHTS = "weights.safetensors"  # of a trained model, in its folder
REMEDY = "train it again (overwrite=True), or restore it where it was shipped"


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> Path:
    """Write a safetensors file whole or not at all; OSError names the path where the disk is full."""
    return write_bytes(path, save({name: value.contiguous() for name, value in tensors.items()}, dict(metadata)))


def read_tensors(path: Path | str, device: str = "cpu") -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and note of a safetensors file; DamagedFileError, which names it, where it is damaged or none."""
    with _open(path, device) as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118


@contextmanager
def _open(path: Path | str, device: str = "cpu") -> Iterator[Any]:
    try:
        with safe_open(path, "pt", device=device) as file:
            yield file
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError) as error:
        raise DamagedFileError(f"{path} is truncated or no safetensors file ({error}): {REMEDY}") from error


def load_metadata(weights: Path | str) -> dict[str, str]:
    """What a weights file says of itself: ``config``, ``seconds`` of training, ``hardware``, ``images``, …

    FileNotFoundError where there is none, DamagedFileError where it is damaged.
    """
    with _open(weights) as file:
        return file.metadata() or {}


def read_config(weights: Path | str) -> tuple[TrainConfig, dict[str, str]]:
    """The configuration that weights were trained with, and all that they say; DamagedFileError if they say none."""
    note = load_metadata(weights)
    try:
        return from_dict(TrainConfig, json.loads(note["config"])), note
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise DamagedFileError(f"{weights} names no configuration known here ({error}): {REMEDY}") from error


def describe_run(weights: Path | str) -> dict[str, int | float | str]:
    """Which model it is and what it cost: its name, steps, minutes, training images, seed, hardware."""
    config, note = read_config(weights)
    try:
        minutes, images, hardware = round(float(note["seconds"]) / 60, 2), int(note["images"]), note["hardware"]
    except (KeyError, ValueError) as error:
        raise DamagedFileError(f"{weights} does not say what it cost ({error}): {REMEDY}") from error
    run = {"model": config.name, "steps": config.steps, "minutes": minutes, "images": images}
    return {**run, "seed": config.seed, "hardware": hardware}
