"""A file of trained weights, read and checked: what it holds must be able to answer."""

from __future__ import annotations

import json
import os
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


def _at_least_one(text: str) -> float:
    if not float(text) >= 1:
        raise ValueError("too small")
    return float(text)


def _share(text: str) -> float:
    if not 0 <= float(text) <= 1:
        raise ValueError("no share")
    return float(text)


def _parse_json(text: str, kind: type) -> Any:
    values = json.loads(text)
    if not isinstance(values, kind):
        raise ValueError(f"no {kind.__name__}")
    return values


METADATA = {  # what reads a value of it, and what it must be
    "config": (lambda text: _parse_json(text, dict), "a JSON object, the training's configuration"),
    "modes": (int, "an integer from 1 on"),
    "size": (lambda text: tuple(_parse_json(text, list)), "[width, height] px"),
    "bandwidth": (float, "a number greater than 0"),
    "temperature": (float, "a number greater than 0"),
    "power": (_at_least_one, "a number of at least 1"),
    "sharpness": (_at_least_one, "a number of at least 1"),
    "shrinkage": (_share, "a number from 0 to 1"),
    "calibration": (parse_calibration, "what `python -m mmgsd calibrate` writes, tables of numbers that ascend"),
}
NEEDED = ("config", "modes", "size")  # others not every file has


def read_weights(path: Path | str) -> tuple[torch.nn.Module, TrainConfig, dict[str, Any], str]:
    """The network, configuration, settings and object's name ("" where it does not say) of a file of a training.

    The settings are what the file has of `METADATA` besides the configuration, and places. FileNotFoundError,
    PermissionError, or ValueError, which names the file and the part of it that is wrong.
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
    config, names_object = _read_config(path, metadata)
    there = [key for key in METADATA if key != "config" and key in (*NEEDED, *metadata)]
    settings = {key: _read(path, metadata, key) for key in there}
    if PLACES in state:
        settings["places"] = _check_places(path, state.pop(PLACES), config)
    return _make_network(path, config, state), config, settings, config.object if names_object else ""


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


def _read(path: Path, metadata: dict[str, str], key: str) -> Any:
    """One value of the metadata; ValueError names the file, the key, what it says and what is accepted."""
    parse, accepted = METADATA[key]
    if key not in metadata:
        raise ValueError(f"{path}: its metadata lacks {key!r}, which must be {accepted}: get the file anew")
    try:
        return parse(metadata[key])
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: {key!r} of its metadata must be {accepted}, got {metadata[key]!r:.80}: "
                         "get the file anew") from error  # fmt: skip


def _read_config(path: Path, metadata: dict[str, str]) -> tuple[TrainConfig, bool]:
    """The training's configuration, and whether it names the object."""
    values = _read(path, metadata, "config")
    try:
        config = from_dict(TrainConfig, values)
        for name, largest in LARGEST.items():
            if getattr(config, name) > largest:
                raise ValueError(f"{name} must be at most {largest}, got {getattr(config, name)}")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: of 'config' in its metadata, {error}: get the file anew") from error
    return config, "object" in values


def _check_places(path: Path, values: Tensor, config: TrainConfig) -> Tensor:
    """Descriptors (P, D) as float32; ValueError for another shape or what is not finite."""
    dim = config.descriptor_dim
    if values.ndim != 2 or not len(values) or values.shape[1] != dim or not values.isfinite().all():
        raise ValueError(f"{path} is damaged: places must be finite, (P, {dim}), got {tuple(values.shape)}: "
                         "get the file anew")  # fmt: skip
    return values.to(torch.float32)


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
