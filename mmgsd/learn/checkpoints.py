"""What a training leaves in its folder: weights, checkpoint and log, for one run at a time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmgsd.dataset import Dataset, join_datasets, load_parts
from mmgsd.files import DamagedFileError, LockedError, locked, remove_leftovers
from mmgsd.learn.distributed import World
from mmgsd.model.tensors import WEIGHTS, load_metadata, read_tensors, write_tensors

CHECKPOINT, LOG = "checkpoint.safetensors", "log.csv"


def is_trained(weights: Path, dataset: Path, *, also: str = "") -> bool:
    """Whether the weights are there; ValueError where they are of other data than `load_parts` finds."""
    if not weights.is_file():
        return False
    if load_metadata(weights).get("data") != join_datasets(*load_parts(dataset, "test", also=also)).fingerprint:
        raise ValueError(f"{weights} was trained on another data set than {dataset}: use overwrite=True")
    return True


@contextmanager
def training_lock(folder: Path, world: World) -> Iterator[None]:
    """The folder, locked by the world's first process; LockedError in all of them where another run holds it."""
    with ExitStack() as stack:
        refused = None
        if world.rank == 0:
            try:
                stack.enter_context(locked(folder, "training"))
            except LockedError as error:
                refused = error
        if world.add(float(refused is not None)):
            raise refused or LockedError(f"{folder} is in use: the first process says by whom")
        yield


def remove_run(folder: Path) -> None:
    """Remove what a training writes, the weights last: without them a folder is not taken for finished."""
    for name in (CHECKPOINT, f"{CHECKPOINT}.tmp", f"{CHECKPOINT}.damaged", LOG, WEIGHTS):
        (folder / name).unlink(missing_ok=True)
        if folder.is_dir():
            remove_leftovers(folder, name)


def check_enough(data: Dataset, held_out: Dataset) -> None:
    """ValueError before training, not after it, where calibration could make no pair of the images held out."""
    if held_out.present.sum() < 2:
        raise ValueError(
            f"{data.folder} must hold at least 2 training images of each simulation, or 30 simulations of one view "
            f"each, so that 2 can be held out: got {len(data)} images of {len(np.unique(data.episode))} simulations"
        )


def write_checkpoint(path: Path, tensors: Mapping[str, Tensor], config: str, numbers: dict[str, Any]) -> Path:
    """Write a training's state, with a checksum of all of it."""
    metadata = {"config": config, "numbers": json.dumps(numbers)}
    return write_tensors(path, tensors, {**metadata, "sha256": _hash(tensors, metadata)})


def read_checkpoint(path: Path, device: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """What `write_checkpoint` wrote; DamagedFileError where it is damaged."""
    tensors, metadata = read_tensors(path, device)
    if metadata.pop("sha256", "") != _hash(tensors, metadata):
        raise DamagedFileError(f"{path} is damaged: its checksum is another")
    return tensors, metadata


def _hash(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(tensors):
        value = tensors[name].detach().contiguous().reshape(-1).cpu()
        digest.update(f"{name} {tuple(tensors[name].shape)} {value.dtype}".encode())
        digest.update(value.view(torch.uint8).numpy().data)
    return digest.hexdigest()
