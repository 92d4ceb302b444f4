"""A preset's results files, read for the documents, and what the paper itself reports."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import find_peaks

from mmgsd.config import N_POINTS, OBJECTS
from mmgsd.files import DamagedFileError, read_json
from mmgsd.measure.regions import MAP, measure_rings

REMEDY = "restore it (it may be in git), or run its notebook again with run=True"
FILES = (
    "rmse", "runs", "budget", "sigma", "uncertainty", "symmetry", "broken_symmetry", "errors", "seeds_1000", "entropy",
    "continuity", "grasp",
)  # fmt: skip
PEAK = 0.05  # of a density's greatest value, by which a peak must stand out
ENDS = 0.1  # of a rope's length at each end, its extremities; the middle is the fifth around its centre


def read_table(path: Path) -> dict[str, Any]:
    """The content of a results file; FileNotFoundError, or DamagedFileError where it is no dictionary."""
    values = read_json(path, remedy=REMEDY)
    if not isinstance(values, dict):
        raise DamagedFileError(f"{path} holds no table of results: {REMEDY}")
    return values


@contextmanager
def told_where(path: Path) -> Iterator[None]:
    """Name the file, or the folder, in which a number is missing, or is none."""
    try:
        yield
    except (LookupError, TypeError, AttributeError) as error:
        raise DamagedFileError(f"{path} lacks a number, or has one that is none ({error!r}): {REMEDY}") from error


def load_results(folder: Path) -> dict[str, Any]:
    """{name: content} of the results files that are there; ``folding`` in short; ``places``, ``peaks`` of figures.

    The symmetry study's maps, which are for its figure, come as ``rings``.
    """
    files = {name: folder / f"{name}.json" for name in FILES}
    results = {name: read_table(path) for name, path in files.items() if path.is_file()}
    with told_where(files["symmetry"]):
        for row in results.get("symmetry", {}).values():
            if MAP in row:
                row["rings"] = measure_rings(row.pop(MAP))
    drawn = {name: folder / f"figures_{name}.safetensors" for name in OBJECTS}
    drawn = {name: path for name, path in drawn.items() if path.is_file()}
    places = {name: measure_places(path, name) for name, path in drawn.items()}
    peaks = {name: count_peaks(path) for name, path in drawn.items()}
    rollouts = folder / "folding.json"
    folding = {"folding": read_folding(rollouts)} if rollouts.is_file() else {}
    return results | folding | ({"places": places, "peaks": peaks} if drawn else {})


def read_folding(path: Path) -> dict[str, dict[str, Any]]:
    """{object: {policy: its ``error``, ``success`` and ``overlap`` where rollouts count, and ``beyond`` MMGSD's}}."""
    with told_where(path):
        return {object: {name: {**row["reachable"], "beyond": row["beyond"]}
                         for name, row in policies.items() if "reachable" in row and "beyond" in row}
                for object, policies in read_table(path)["policies"].items()}  # fmt: skip


def count_peaks(path: Path) -> int:
    """How many peaks the distribution of MMGSD's error has, as it is drawn (`mmgsd.studies.main.plot_rmse_pdf`)."""
    from mmgsd.measure.metrics import BIN_PX
    from mmgsd.studies.figure_data import load_figure_data
    from mmgsd.studies.main import compute_density  # with matplotlib: only where it is needed

    data = load_figure_data(path)
    _, density = compute_density(data.errors["mmgsd"].histogram, 100 * BIN_PX / data.object_size_px)
    return len(find_peaks(np.pad(density, 1), prominence=PEAK * density.max())[0])


def measure_places(path: Path, name: str) -> dict[str, float]:
    """MMGSD's mean error (px) by place on the object: ``corner``, ``edge``, ``interior``, or ``end``, ``middle``."""
    from mmgsd.measure.regions import find_regions
    from mmgsd.studies.figure_data import load_figure_data  # with torch: only where it is needed

    errors = load_figure_data(path).errors["mmgsd"]
    if name == "cloth":
        places = find_regions()
    else:
        from_middle = np.abs(np.arange(N_POINTS) / (N_POINTS - 1) - 0.5)
        places = {"end": from_middle > 0.5 - ENDS, "middle": from_middle < ENDS}
    mean, asked = np.nan_to_num(errors.mean_px), errors.asked
    return {place: float(np.average(mean[p], weights=asked[p])) for place, p in places.items() if asked[p].any()}
