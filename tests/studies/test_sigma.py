"""The distributions of the errors by σ: counted of visible sources, added to the stored ones, drawn."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

from mmgsd.config import TrainConfig
from mmgsd.measure.evaluation import write_results
from mmgsd.paths import Paths
from mmgsd.studies.sigma import BIN_PX, count_errors, draw_densities


def test_errors_are_counted_of_visible_sources_and_others_stay(tmp_path: Path) -> None:
    paths, file = Paths(tmp_path, "smoke"), tmp_path / "errors_by_sigma.json"
    models = [TrainConfig(object="cloth", sigma_px=sigma) for sigma in (1.0, 16.0)]
    for model in models:
        table = paths.queries(model.name)
        table.parent.mkdir(parents=True, exist_ok=True)
        errors = [0.5, BIN_PX + 0.1, BIN_PX * model.sigma_px + 0.5, 1000.0]
        pd.DataFrame({"visible": [True, True, True, False], "rmse_px": errors}).to_parquet(table)
    write_results({"rope": {"1": [7]}, "cloth": {"4": [3]}}, file)
    count_errors(paths, models, file)
    counts = json.loads(file.read_text())
    assert counts["rope"] == {"1": [7]} and counts["cloth"]["4"] == [3]
    assert counts["cloth"]["1"] == [1, 2] and counts["cloth"]["16"] == [1, 1, *[0] * 14, 1]


def test_a_line_a_width_and_no_figure_without_counts(tmp_path: Path) -> None:
    assert draw_densities(tmp_path) is None
    rows = {"1": [5, 9, 4, 1], "16": [1, 4, 9, 5]}
    write_results({"cloth": rows, "rope": rows}, tmp_path / "errors_by_sigma.json")
    figure = draw_densities(tmp_path)
    cloth, rope = figure.axes
    assert [line.get_label() for line in cloth.lines] == ["σ = 1 px", "σ = 16 px"] and len(rope.lines) == 2
    plt.close(figure)
