"""One look of a rollout as a file: how the object lies, what the camera sees of it, and how it came to that."""

from __future__ import annotations

import dataclasses
import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.files import DamagedFileError, atomic_write
from mmgsd.scene.geometry import Camera

UNREADABLE = (OSError, EOFError, ValueError, TypeError, KeyError, zipfile.BadZipFile, zlib.error)
ABOUT = {"object", "task", "start", "ground", "seed", "fault", "look", "mark", "thickness"}


@dataclass(frozen=True, eq=False)
class State:
    """What is known of one look; P = 625 material points, the centre of the top-left pixel is (0, 0).

    Of a film (`mmgsd.fold.jobs.film_job`) each array but ``first`` and the camera's has an axis of frames before.
    """

    vertices: np.ndarray  # (V, 3) float32 m, world: of the simulated cloth, or of the rope's centre line
    points: np.ndarray  # (P, 3) float32 m
    image: np.ndarray  # (H, W, 3) uint8
    mask: np.ndarray  # (H, W) bool
    xy: np.ndarray  # (P, 2) float32 px
    visible: np.ndarray  # (P,) bool
    intrinsics: np.ndarray  # (3, 3) float64
    camera_pose: np.ndarray  # (4, 4) float64, camera to world, OpenCV axes
    first: np.ndarray  # (P, 3) float32 m, the points of the rollout's first look
    about: dict[str, Any]  # object, task, start, ground, seed, look, fault ("" or what physics spoilt), mark, thickness

    @property
    def camera(self) -> Camera:
        """What it was seen by; also of a film."""
        return Camera(self.intrinsics, self.camera_pose, self.mask.shape[:-3:-1])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of world points (N, 3) m."""
        return self.camera.project(points)


def write_state(path: Path, state: State) -> Path:
    """Write a state as a compressed ``.npz``, whole or not at all; equal states give equal bytes."""
    arrays = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    arrays["about"] = np.array(json.dumps(state.about, sort_keys=True))
    with atomic_write(path) as aside, open(aside, "wb") as file:
        np.savez_compressed(file, **arrays)
    return path


def read_state(path: Path | str) -> State:
    """Read a state's file; DamagedFileError, which names it, where it is truncated or none."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {field.name: stored[field.name] for field in dataclasses.fields(State)}
        about = json.loads(str(arrays.pop("about")))
        if not isinstance(about, dict) or not about.keys() >= ABOUT:
            raise ValueError(f"about must hold {', '.join(sorted(ABOUT))}")
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise DamagedFileError(f"{path} is damaged or no state ({error}): remove it to have it made again") from error
    return State(**arrays, about=about)
