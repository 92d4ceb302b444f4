"""A file of trained weights, read and checked: what it holds must be able to answer."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mmgsd.config import TrainConfig, from_dict
from mmgsd.files import DamagedFileError
from mmgsd.model.calibration import parse_calibration
from mmgsd.model.network import build_network
from mmgsd.model.tensors import read_tensors

FORMAT = "mmgsd-1"
PLACES = "places"  # beside the network's tensors: what its object's material points are described as
PICKLES = (b"PK\x03\x04", b"\x80")  # how PyTorch's own files begin
LARGEST = {"input_px": 8192, "descriptor_dim": 4096}  # of a configuration; more would not fit a memory
ACCEPTED = {  # what a value of the metadata must be
    "config": "a JSON object, the training's configuration",
    "modes": "an integer from 1 on",
    "size": "[width, height] px",
    "bandwidth": "a number greater than 0",
    "temperature": "a number greater than 0",
    "power": "a number of at least 1",
    "sharpness": "a number of at least 1",
    "calibration": "what `python -m mmgsd calibrate` writes, tables of numbers that ascend",
}


@dataclass(frozen=True)
class Weights:
    """What a file of weights holds."""

    network: torch.nn.Module
    config: TrainConfig
    settings: dict[str, Any]  # modes, size, and where they are stored `NUMBERS`, calibration and places
    object: str  # what was taught, "" where the file does not say


def read_weights(path: Path | str) -> Weights:
    """Read a safetensors file that a training wrote.

    FileNotFoundError, PermissionError, or ValueError, which names the file and the part of it that is wrong.
    """
    path = Path(path)
    _check_file(path)
    try:
        state, metadata = read_tensors(path)
    except (DamagedFileError, FileNotFoundError) as error:  # the latter for a name that is no UTF-8
        raise ValueError(_describe_damage(path, error.__cause__ or error)) from error
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path} holds no mmgsd weights: its metadata says format {metadata.get('format')!r}, "
                         f"not {FORMAT!r}")  # fmt: skip
    config, known = _read_config(path, metadata)
    settings = {"modes": _read(path, metadata, "modes", int), "size": _read(path, metadata, "size", _parse_size)}
    settings |= {name: _read(path, metadata, name, parse) for name, parse in NUMBERS.items() if name in metadata}
    if "calibration" in metadata:
        settings["calibration"] = _read(path, metadata, "calibration", parse_calibration)
    if PLACES in state:
        settings["places"] = _read_places(path, state.pop(PLACES), config)
    return Weights(_make_network(path, config, state), config, settings, config.object if known else "")


def _check_file(path: Path) -> None:
    """What can be said before the file is taken for safetensors."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder: give the path of a safetensors file in it")
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: train a model, or give the path of its weights")
    if not path.is_file():  # a pipe would be read up in being looked at
        raise ValueError(f"{path} is no regular file: give the path of a safetensors file")
    open(path, "rb").close()  # PermissionError names the file


def _describe_damage(path: Path, error: BaseException) -> str:
    """Why it is no safetensors file; asked only once it is known to be none, for one may begin with the same bytes."""
    if str(path).encode(errors="replace") != os.fsencode(path):
        return f"{path} must have a name in UTF-8, its folders' names, too: rename it"
    with open(path, "rb") as file:
        start = file.read(4)
    if start.startswith(PICKLES):
        return (f"{path} is a pickle, as PyTorch writes .pt and .pth, or an archive: give the safetensors file that a "
                "training of mmgsd wrote")  # fmt: skip
    return f"{path} is truncated or no safetensors file ({error}): get it anew"


def _read(path: Path, metadata: dict[str, str], key: str, parse: Any) -> Any:
    """One value of the metadata; ValueError names the file, the key, what it says and what is accepted."""
    if key not in metadata:
        raise ValueError(f"{path}: its metadata lacks {key!r}, which must be {ACCEPTED[key]}: get the file anew")
    try:
        return parse(metadata[key])
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: {key!r} of its metadata must be {ACCEPTED[key]}, got {metadata[key]!r:.80}: "
                         "get the file anew") from error  # fmt: skip


def _at_least_one(text: str) -> float:
    if not float(text) >= 1:
        raise ValueError("too small")
    return float(text)


# settings that not every file has
NUMBERS = {"bandwidth": float, "temperature": float, "power": _at_least_one, "sharpness": _at_least_one}


def _parse_size(text: str) -> tuple[int, ...]:
    size = json.loads(text)
    if not isinstance(size, list):
        raise ValueError("no list")
    return tuple(size)


def _parse_object(text: str) -> dict[str, Any]:
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("no object")
    return values


def _read_config(path: Path, metadata: dict[str, str]) -> tuple[TrainConfig, bool]:
    """The training's configuration, and whether it names the object."""
    values = _read(path, metadata, "config", _parse_object)
    try:
        config = from_dict(TrainConfig, values)
        for name, largest in LARGEST.items():
            if getattr(config, name) > largest:
                raise ValueError(f"{name} must be at most {largest}, got {getattr(config, name)}")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: of 'config' in its metadata, {error}: get the file anew") from error
    return config, "object" in values


def check_places(values: Tensor, descriptor_dim: int) -> Tensor:
    """Descriptors (P, D) as float32; ValueError for another shape or what is not finite."""
    if values.ndim != 2 or not len(values) or values.shape[1] != descriptor_dim or not values.isfinite().all():
        raise ValueError(f"places must be finite, (P, {descriptor_dim}), got {tuple(values.shape)}")
    return values.to(torch.float32)


def _read_places(path: Path, values: Tensor, config: TrainConfig) -> Tensor:
    try:
        return check_places(values, config.descriptor_dim)
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}: get the file anew") from error


def _make_network(path: Path, config: TrainConfig, state: dict[str, Tensor]) -> torch.nn.Module:
    """The configuration's network with the tensors of a file, which must fit it and be finite."""
    parts = {"roles": config.roles, "heads": config.heads}
    network = build_network(config.network, config.descriptor_dim, pretrained=False, **parts)
    wanted = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    got = {name: tuple(value.shape) for name, value in state.items()}
    for name in (*wanted, *got):
        if wanted.get(name) != got.get(name):
            raise ValueError(f"{path} does not fit the network {config.network!r}: {name} must be "
                             f"{wanted.get(name, 'absent')}, got {got.get(name, 'none')}")  # fmt: skip
    for name, value in state.items():
        if not value.isfinite().all():
            raise ValueError(f"{path} is damaged: {name} must be finite, it holds NaN or infinity: get the file anew")
    network.load_state_dict({name: value.float() for name, value in state.items()})
    return network
