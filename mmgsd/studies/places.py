"""Where on the objects MMGSD's errors lie, and how they are spread: extremities beside interiors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import find_peaks

from mmgsd.config import N_POINTS, OBJECTS
from mmgsd.measure.metrics import BIN_PX
from mmgsd.measure.regions import find_regions
from mmgsd.studies import main
from mmgsd.studies.claims import Claim, get, get_regions, hold_all, is_better, list_errors
from mmgsd.studies.figure_data import FigureData, load_figure_data
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Column, Table

PEAK = 0.05  # of a density's greatest value, by which a peak must stand out
ENDS = 0.1  # of a rope's length at each end, its extremities; the middle is the fifth around its centre
COMMAND = "`04_evaluate`, `07_figures`"


def measure_all(folder: Path, results: Results | None = None) -> dict[str, Any]:
    """``places``, ``peaks`` {object: `measure_places`, `count_peaks`} of a preset's data of figures, where it is."""
    files = {name: path for name, path in main.list_drawn(folder).items() if path.is_file()}
    drawn = {name: load_figure_data(path, answers=False) for name, path in files.items()}
    places = {name: measure_places(data, name) for name, data in drawn.items()}
    return {"places": places, "peaks": {name: count_peaks(data) for name, data in drawn.items()}} if drawn else {}


def count_peaks(data: FigureData) -> int:
    """How many peaks the distribution of MMGSD's error has, as it is drawn (`mmgsd.studies.main.plot_rmse_pdf`)."""
    _, density = main.compute_density(data.errors["mmgsd"].histogram, 100 * BIN_PX / data.object_size_px)
    return len(find_peaks(np.pad(density, 1), prominence=PEAK * density.max())[0])


def measure_places(data: FigureData, name: str) -> dict[str, float]:
    """MMGSD's mean error (px) by place on the object: ``corner``, ``edge``, ``interior``, or ``end``, ``middle``."""
    errors, from_middle = data.errors["mmgsd"], np.abs(np.arange(N_POINTS) / (N_POINTS - 1) - 0.5)
    along = {"end": from_middle > 0.5 - ENDS, "middle": from_middle < ENDS}
    places = find_regions() if name == "cloth" else along
    mean, counts = np.nan_to_num(errors.mean_px), errors.asked
    return {place: float(np.average(mean[p], weights=counts[p])) for place, p in places.items() if counts[p].any()}


def describe_places(results: Results) -> Table:
    """MMGSD's mean error by place on the object, a row a place."""
    rows = {f"{name}: {place}": {"": {"error": error}}
            for name, row in results["places"].items() for place, error in row.items()}  # fmt: skip
    return Table("place", {"": [Column("error", "RMSE", "RMSE px")]}, rows)


def judge_interior(results: Results) -> Claim:
    """Where on the objects the errors lie; for the cloth, where not measured by place, the study's model of c4."""
    cloth = get(results, "places", "cloth") or get_regions(results, "c4", "rmse_px")
    rope = get(results, "places", "rope") or {}
    lower = [is_better(cloth.get(place), cloth.get("interior")) for place in ("corner", "edge")]
    parts = (hold_all(lower), is_better(rope.get("end"), rope.get("middle")))
    return Claim(
        "interior", "Errors are highest in the object's interior and low at its extremities.",
        "MMGSD's error inside is larger than at corners and edges (cloth), or than at the ends (rope); a part each.",
        f"cloth: {list_errors(cloth)}; rope: {list_errors(rope)}; one seed", parts, COMMAND, ("mmgsd",),
    )  # fmt: skip


def judge_bimodal(results: Results) -> Claim:
    """The shape of the error's distribution."""
    peaks = {name: get(results, "peaks", name) for name in OBJECTS}
    return Claim(
        "bimodal", "The distribution of MMGSD's error has two peaks: exteriors, then interiors.",
        f"Two peaks stand out by {100 * PEAK:.0f} % of the highest value; a part each object.",
        "peaks: " + ", ".join(f"{name} {count or '–'}" for name, count in peaks.items()),
        tuple(None if count is None else count == 2 for count in peaks.values()), COMMAND, ("mmgsd",),
    )  # fmt: skip


STUDY = Study(
    "places", 50, main.run, main.check, "04_evaluate", derive=measure_all,
    shows=lambda paths, **_: list(main.list_drawn(paths.results).values()),
    tables={"places": Shown("paper", describe_places)}, claims=(judge_interior, judge_bimodal),
)  # fmt: skip
