"""What each part of the shipped models' training brings: what is trained and asked, its table, and what is refused."""

from __future__ import annotations

from functools import partial

import pytest

from mmgsd.config import OBJECTS, load_preset
from mmgsd.measure.evaluation import read_results
from mmgsd.paths import Paths
from mmgsd.studies import matrix, robustness
from mmgsd.studies.table import to_markdown

PARTS = ("mmgsd", "mmgsd_workspace", "mmgsd_clutter", "mmgsd_heads")


def make_results(**errors: float) -> dict:
    """Two seeds of some rows of the cloth, 2 px apart, twice the error on cluttered images."""
    return {"cloth": {
        f"{name}-{seed}": {"clean": {"rmse_mean": px + 2 * seed}, "cluttered": {"rmse_mean": 2 * px + 2 * seed},
                           "run": {"steps": 600, "seed": seed}}
        for name, px in errors.items() for seed in range(2)
    }}  # fmt: skip


def test_each_row_adds_a_part_with_every_seed() -> None:
    for object in OBJECTS:
        models = robustness.list_models("quick", object, 2, 7)
        assert list(models) == [f"{part}-{seed}" for part in PARTS for seed in (0, 1)]
        added = {(m.also, m.clutter, m.heads): (key, m.steps, m.seed) for key, m in models.items()}
        assert len(added) == len(PARTS) and {m.steps for m in models.values()} == {7}
        assert len({model.name for model in models.values()}) == len(models)


def test_a_row_is_tested_against_the_one_above_it() -> None:
    lines = to_markdown(robustness.describe_parts(make_results(mmgsd=40.0, mmgsd_workspace=90.0, mmgsd_heads=91.0)))
    cells = [line.split(" | ") for line in lines.splitlines()[2:]]
    assert [cell[0] for cell in cells][:2] == ["| cloth, **MMGSD** (ours)", "| cloth, MMGSD, workspace renders too"]
    assert cells[0][1] == "41.0 ± 1.4 (2)" and cells[1][1].startswith("91.0 ± 1.4 (2)") and cells[1][1][-1] in "*†"
    assert cells[2][1] == "–" and cells[3][1] == "92.0 ± 1.4 (2)"  # the row above the last was not trained
    assert cells[1][2].startswith("181.0")


def test_the_budget_is_said() -> None:
    said = "Preset `quick`: 600 steps each, from 300 images of a kind; 50 test images of each; 2 seeds."
    assert robustness.make_budget_sentence(make_results(mmgsd=40.0)) == said


@pytest.mark.parametrize(("name", "value"), [("steps", 0), ("steps", 1.5), ("seeds", 0), ("objects", "towel")])
def test_options_are_checked_before_anything_is_rendered(tmp_path, name, value) -> None:
    with pytest.raises(ValueError, match=name):
        robustness.check(Paths(tmp_path, "smoke"), **{name: value})


def test_run_trains_each_row_asks_about_both_kinds_and_goes_on(tmp_path, tiny_dataset, monkeypatch) -> None:
    rendered, trained, data = [], [], tiny_dataset(object="cloth", n_train=6, n_test=4)

    def render(config, folder):
        rendered.append(folder)
        return data

    def train(actual, model, images, folder, *, progress):
        trained.append(folder)
        return actual(model, images, folder, progress=False)

    monkeypatch.setattr(robustness, "render_dataset", render)
    first = [row for row in matrix.list_rows("robustness") if not row.changes]
    monkeypatch.setattr(robustness, "list_rows", lambda study: first)
    monkeypatch.setattr(matrix, "train_model", partial(train, matrix.train_model))
    monkeypatch.setattr(matrix, "PROCESSES", 1)  # other processes would not see what is replaced here
    paths, how = Paths(tmp_path, "smoke"), {"seeds": 2, "steps": 2, "objects": "cloth"}
    rows = read_results(robustness.run(paths, **how), depth=2)["cloth"]
    there = dict.fromkeys(("mmgsd-0", "mmgsd-1"), {*robustness.WHERE, "run"})
    assert {key: set(row) for key, row in rows.items()} == there
    cluttered = Paths(tmp_path, load_preset("smoke").cluttered)
    assert rendered == [paths.dataset("cloth"), cluttered.dataset("cloth")] and len(set(trained)) == 2
    trained.clear()
    robustness.run(paths, **how)
    assert not trained
