"""What the rendered images show, before anything is trained: contact sheets, states, hues, and matches a point."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from mmgsd.config import N_POINTS, OBJECTS
from mmgsd.dataset import Dataset, load_dataset, measure_images
from mmgsd.figures.plots import plot_samples, plot_variety
from mmgsd.figures.style import save_figure
from mmgsd.paths import Paths
from mmgsd.studies.parameters import check_images
from mmgsd.studies.registry import Experiment, Study


def list_shown(paths: Paths, **_: Any) -> list[Path]:
    """The figure of how a preset's images differ."""
    return [paths.root / "figures" / "data" / f"{paths.preset}_variety.png"]


def check(paths: Paths, *, images: int = 48, split: str = "train") -> None:
    """ValueError where the images of the ``split`` are not rendered."""
    check_images(paths, OBJECTS, split=split)


def run(paths: Paths, *, images: int = 48, split: str = "train") -> Path:
    """Count a preset's images of a ``split``, and draw so many ``images`` on a contact sheet; the figure."""
    data, (file,) = {name: load_dataset(paths.dataset(name), split) for name in OBJECTS}, list_shown(paths)
    modes = {name: {g: [d.group(g).count_modes(p) for p in range(N_POINTS)] for g in d.info["symmetry"]}
             for name, d in data.items()}  # fmt: skip
    for name, d in data.items():
        save_figure(plot_sheet(d, images), file.with_name(f"{paths.preset}_{name}"), kinds=("jpg",))
    return save_figure(plot_variety({n: measure_folder(d.folder, split) for n, d in data.items()}, modes), file)[-1]


def find_folders(study: Experiment) -> dict[str, Path]:
    """{object: the preset's data set, or else the sample's}."""
    sample = study.paths.root / "data" / "sample"
    return {name: study.paths.dataset(name) if study.runs else sample / name for name in OBJECTS}


@cache
def measure_folder(folder: Path, split: str = "train") -> pd.DataFrame:
    """`mmgsd.dataset.measure_images` of a data set's images of a ``split``, once."""
    return measure_images(load_dataset(folder, split))


def plot_sheet(data: Dataset, count: int) -> Figure:
    """``count`` images, or all of fewer, spread evenly over the simulations."""
    chosen = [round(i * (len(data) - 1) / (count - 1)) for i in range(count)] if count > 1 else [0]
    return plot_samples([data.load_image(i) for i in sorted(set(chosen))], columns=8)


STUDY = Study("images", -10, run, check, "02_inspect_data", shows=list_shown)
