"""Where files lie: a preset's below the repository's root, the shipped weights, and the root itself."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from mmgsd.checks import check_choice
from mmgsd.config import OBJECTS, TrainConfig

SAMPLES = {"cloth": ("test_000007_00.webp", "test_000002_00.webp"),
           "rope": ("test_000007_00.webp", "test_000006_00.webp")}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Paths:
    """Where a preset's files lie below the repository's root."""

    root: Path
    preset: str

    @property
    def generated(self) -> Path:
        """Large and reproducible, ignored by git."""
        return self.root / "data" / "generated" / self.preset

    def dataset(self, object: str) -> Path:
        """The rendered data set of one object."""
        return self.generated / object

    def model(self, config: TrainConfig) -> Path:
        """The folder of one trained model."""
        return self.generated / "models" / config.name

    def queries(self, name: str) -> Path:
        """The table of one method's answers, one row a query."""
        return self.generated / "queries" / f"{name}.parquet"

    @property
    def results(self) -> Path:
        """Small tables that figures, README and report read."""
        return self.root / "data" / "results" / self.preset

    @property
    def figures(self) -> Path:
        """The paper's figures as this preset draws them."""
        return self.root / "figures" / self.preset


def find_shipped() -> Path:
    """The folder of the shipped weights: within the package where it is installed, ``data/weights`` in a checkout."""
    return _find_folder("weights", "weights")


def find_samples(object: str = "cloth") -> tuple[Path, Path]:
    """Two image files of a ``cloth`` or a ``rope`` that no weights learnt from; ValueError for another object."""
    check_choice("object", object, OBJECTS)
    folder = _find_folder("samples", "sample") / object / "images"
    return tuple(folder / name for name in SAMPLES[object])


def find_sample_sets(object: str) -> list[Path]:
    """The sample's data sets of an object, the cluttered one last; [] of one that it does not show."""
    folder = _find_folder("samples", "sample")
    return [place for place in (folder / object, folder / "workspace" / object) if place.is_dir()]


def _find_folder(installed: str, checkout: str) -> Path:
    """A folder within the package where it is installed, or below ``data`` in a checkout."""
    package = Path(__file__).resolve().parent
    return package / installed if (package / installed).is_dir() else package.parent / "data" / checkout


def find_root(start: Path | None = None) -> Path:
    """The repository's root: the nearest folder upwards that holds ``environment.lock``, or MMGSD_ROOT.

    Raises FileNotFoundError where neither is found.
    """
    if "MMGSD_ROOT" in os.environ:
        return Path(os.environ["MMGSD_ROOT"])
    start = Path.cwd() if start is None else start
    for folder in (start, *start.parents, *Path(__file__).resolve().parents):
        if (folder / "environment.lock").is_file():
            return folder
    raise FileNotFoundError("no environment.lock in this folder or above it: set MMGSD_ROOT to the repository")
