"""The width of a target where cells are fine: what goes on from what, that a killed run goes on, what is concluded."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from mmgsd.config import OBJECTS, load_preset
from mmgsd.learn.training import train_model
from mmgsd.measure.evaluation import read_results
from mmgsd.paths import Paths
from mmgsd.studies import cells, matrix
from mmgsd.studies.claims import HELD, IN_PART, NOT_HELD, NOT_MEASURED
from mmgsd.studies.models import ITS_OWN
from mmgsd.studies.table import to_markdown


@pytest.mark.parametrize("name", OBJECTS)
def test_images_grow_and_all_widths_go_on_from_the_largest(name: str) -> None:
    models = cells.list_models("paper", name)
    start, coarse, larger, largest, *fine = models.values()
    assert [model.trunk_weights for model in (coarse, larger, largest)] == [start.name, start.name, larger.name]
    assert {model.trunk_weights for model in fine} == {largest.name}
    longer = max(load_preset("paper").render[name].size)
    widths = [longer / (model.input_px / 4) for model in (coarse, larger, largest, *fine)]  # px of a cell
    assert 14 < widths[0] < 17 and 7 < widths[1] < 9 and all(4 <= width < 4.1 for width in widths[2:])
    assert [model.sigma_px for model in fine] == list(cells.WIDTHS_PX) and coarse.sigma_px == 1
    assert {coarse.steps} == {larger.steps + largest.steps + one.steps for one in fine}
    assert len({(m.batch, m.pairs, m.prototype_weight) for m in (coarse, larger, largest, *fine)}) == 1


def test_run_goes_on_from_the_start_asks_all_and_keeps_what_is_stored(
    tmp_path: Path, tiny_dataset: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matrix, "PROCESSES", 1)  # other processes would not see what is replaced here
    small = dataclasses.replace(cells.ROWS["mmgsd_largest"], changes={"trunk_weights": ITS_OWN, "input_px": 96})
    monkeypatch.setitem(cells.ROWS, "mmgsd_largest", small)
    monkeypatch.setattr(cells, "SHOWN", (*cells.SHOWN[:3], small, cells.SHOWN[4]))
    paths = Paths(tmp_path, "smoke")
    with pytest.raises(ValueError, match="run 01_render_data"):
        cells.check(paths, objects="cloth")
    data = tiny_dataset(object="cloth", n_train=6, n_test=4)
    paths.dataset("cloth").parent.mkdir(parents=True)
    data.rename(paths.dataset("cloth"))
    with pytest.raises(FileNotFoundError, match="cloth-mmgsd"):
        cells.check(paths, objects="cloth")
    start = cells.list_models("smoke", "cloth")["start"]
    train_model(start, paths.dataset("cloth"), paths.model(start), progress=False)
    cells.check(paths, objects="cloth")
    file = cells.run(paths, objects="cloth")
    rows = read_results(file, depth=2)["cloth"]
    assert list(rows) == ["start", "coarse", "mmgsd_larger", "mmgsd_largest", "1"]
    assert rows["start"]["run"]["steps"] == start.steps and rows["1"]["width_px"] > 0
    monkeypatch.setattr(cells, "_train", lambda *_, **__: pytest.fail("trained again"))
    cells.run(paths, objects="cloth")


def make_results(**errors: float) -> dict:
    rows = {key: {"rmse_mean": error} for key, error in errors.items()}
    return {"cells": {name: {key.removeprefix("w"): row for key, row in rows.items()} for name in OBJECTS}}


@pytest.mark.parametrize(("errors", "verdict"), [
    ({"w1": 10.0, "w2": 12.0, "w4": 14.0, "w8": 16.0}, HELD),
    ({"w1": 10.0, "w2": 10.2, "w4": 14.0, "w8": 16.0}, IN_PART),
    ({"w1": 10.0, "w2": 10.0, "w4": 9.0, "w8": 9.0}, NOT_HELD),
    ({}, NOT_MEASURED),
])  # fmt: skip
def test_the_least_width_has_to_be_better_than_each_wider_one(errors: dict, verdict: str) -> None:
    assert cells.judge_cells(make_results(**errors)).verdict == verdict


def test_the_table_has_a_line_for_each_that_was_measured() -> None:
    row = {"rmse_mean": 20.0, "median": 12.0, "pck@5px": 0.3, "width_px": 6.0}
    lines = to_markdown(cells.describe_cells({"cloth": {"start": row, "1": row}})).splitlines()
    assert "| then σ = 1 px | 20.0 | 12.0 | 30 % | 6.0 | – | – | – | – |" in lines
    assert len([line for line in lines if "20.0" in line]) == 2
