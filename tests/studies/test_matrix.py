"""The matrix of models: what is in it and in which order, here and on a Dask cluster."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from dask.distributed import LocalCluster

from mmgsd.__main__ import main
from mmgsd.config import OBJECTS, Preset, TrainConfig, load_preset
from mmgsd.measure.evaluation import write_results
from mmgsd.studies import matrix
from mmgsd.studies.matrix import choose_tasks, list_tasks, run_each, run_tasks, write_study_table, write_tables
from mmgsd.studies.models import configure_model, configure_study, list_rows, list_runs, vary_seed, vary_sigma

SMOKE = load_preset("smoke")


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> list[TrainConfig]:
    """What would be trained, of which one is said to be done."""
    tasks: list[TrainConfig] = []
    monkeypatch.setattr(matrix, "run_tasks", lambda asked, *_, **__: tasks.extend(asked) or iter([("one", 1.0)]))
    monkeypatch.setattr(matrix, "write_tables", lambda *_: None)
    return tasks


def test_the_models_that_matter_most_come_first() -> None:
    models = list_runs(load_preset("paper"))
    assert [(m.object, m.method) for m in models[:4]] == [
        ("cloth", "mmgsd"), ("rope", "mmgsd"), ("cloth", "spcl"), ("rope", "spcl")
    ]  # fmt: skip
    assert [m.group for m in models[4:7]] == ["v4", "c4", "d4"]  # the studies, then the rest of the main table
    steps = [m.steps for m in models]
    assert models[5] == configure_study(load_preset("paper"), "cloth", "budget")["mmgsd"]  # one model, two tables
    assert max(i for i, m in enumerate(models) if m.sigma_px == 16) == max(i for i, n in enumerate(steps) if n == 1000)
    assert set(steps[4:30]) == {1000} and set(steps[30:42]) == {4000} and len(models) == 50
    assert steps[42:50] == [12000] * 4 + [4000] * 2 + [3500] * 2
    assert not any(m.trunk_weights for m in models)  # each can be trained on its own
    assert len({m.name for m in models}) == len(models)
    assert {m.group for m in models if m.object == "cloth"} == {"c4", "v4", "d4"}
    assert sorted({m.sigma_px for m in models}) == [1.0, 2.0, 4.0, 8.0, 16.0]
    assert {m.seed for m in models} == {0}
    assert sum(m.method == "spcl" and m.dense_weight == 1.0 for m in models) == 8
    assert sum(m.hidden_matches for m in models) == 2
    assert sum(m.method == "mmgsd" and m.dense_weight == 0.0 for m in models) == 4


def test_seed_after_seed_the_same_models_are_repeated() -> None:
    preset = load_preset("paper")
    models = choose_tasks(preset, seeds=3)
    assert [m.seed for m in models] == [0] * 14 + [1] * 14 + [2] * 14
    assert models[:14] == [configure_model(preset, name, row.name) for row in list_rows("seeds") for name in OBJECTS]
    of_budget = {m.name for name in OBJECTS for m in configure_study(preset, name, "budget").values()}
    small = choose_tasks(preset, seeds=1, steps=1000)
    assert {m.name for m in small if not m.hidden_matches} <= of_budget and {m.steps for m in small} == {1000}


def test_errors_of_several_seeds_are_written(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    preset = make_tiny(tiny_dataset, tmp_path)
    monkeypatch.setattr(matrix, "load_preset", lambda _: preset)
    monkeypatch.setattr(matrix, "find_root", lambda: tmp_path)
    matrix.main("smoke", seeds=2, steps=1, only="cloth-uni")
    written = tmp_path / "data" / "results" / "smoke" / "seeds_1.json"
    table = json.loads(written.read_text())
    assert table.keys() == {"cloth"} and table["cloth"].keys() == {"unimodal-0", "unimodal-1"}
    assert [table["cloth"][f"unimodal-{seed}"]["run"]["seed"] for seed in (0, 1)] == [0, 1]
    assert len({row["rmse_mean"] for row in table["cloth"].values()}) == 2
    assert not (written.parent / "rmse.json").exists()
    for file in (tmp_path / "data" / "generated" / "smoke" / "queries").iterdir():  # as on another machine
        file.unlink()
    write_study_table(preset, tmp_path, "seeds", values=[0], steps=1)  # seed 1 stays, though only seed 0 is asked for
    assert json.loads(written.read_text()) == table
    model = configure_study(preset, "rope", "seeds", vary_seed([0]), steps=1)["pcl-0"].name
    of_budget = {"rmse_mean": 3.0, "run": {"model": model}}
    write_results({"rope": {"pcl": of_budget, "spcl": {"run": {"model": "another"}}}}, written.with_name("budget.json"))
    write_study_table(preset, tmp_path, "seeds", values=[0], steps=1)  # the same model is not trained twice
    assert json.loads(written.read_text()) == {**table, "rope": {"pcl-0": of_budget}}
    of_main = configure_study(preset, "rope", "seeds", vary_seed([0]), steps=1)["spcl-0"].name
    write_results({"rope": {"spcl": {"rmse_mean": 4.0}}}, written.with_name("rmse.json"))
    write_results({"rope-spcl": {"model": of_main}}, written.with_name("runs.json"))
    write_study_table(preset, tmp_path, "seeds", values=[0], steps=1)
    assert json.loads(written.read_text())["rope"]["spcl-0"] == {"rmse_mean": 4.0, "run": {"model": of_main}}
    trained: list[str] = []
    monkeypatch.setattr(matrix, "run_matrix", lambda _, tasks, **how: trained.extend(map(matrix.name_task, tasks)))
    matrix.main("smoke", seeds=2, steps=1, missing=True)
    every = [task.name for task in choose_tasks(preset, seeds=2, steps=1)]
    assert trained == [name for name in every if "unimodal" not in name or "rope" in name
                       if name not in (model, of_main)]  # fmt: skip


@pytest.mark.parametrize(
    "told", [{"seeds": -1}, {"steps": 10}, {"seeds": 2, "steps": -1}, {"study": "main", "steps": 9}]
)
def test_how_often_to_train_is_checked(told: dict) -> None:
    with pytest.raises(ValueError, match="--seeds and --steps must"):
        matrix.main("smoke", **told)


def test_baselines_come_before_the_studies() -> None:
    preset = load_preset("paper")
    tasks = list_tasks(preset)
    assert [task for task in tasks if not isinstance(task, tuple)] == list_runs(preset)
    assert tasks[4:8] == [("cloth", "random"), ("rope", "random"), ("cloth", "centre"), ("rope", "centre")]
    assert {method for _, method in tasks[4:12]} >= {"sift", "orb"}


def test_results_are_written_of_what_is_done(tiny_dataset: Callable[..., Path], tmp_path: Path) -> None:
    preset = make_tiny(tiny_dataset, tmp_path)
    cloth = dataclasses.replace(preset.train["cloth"], steps=1)
    preset = dataclasses.replace(preset, train={**preset.train, "cloth": cloth})
    small = dataclasses.replace(preset.ablation["cloth"], steps=1, seed=1)
    preset = dataclasses.replace(preset, ablation={**preset.ablation, "cloth": small})
    asked_by_hand = configure_study(preset, "cloth", "sigma", vary_sigma([3]))["3"]  # no σ of the preset
    pcl = configure_study(preset, "cloth", "budget")["pcl"]
    tasks = [configure_model(preset, "cloth", "spcl_dense"), ("cloth", "sift"), pcl]
    (_, rmse), (asked, of_sift), (_, of_pcl), (_, of_sigma) = run_tasks([*tasks, asked_by_hand], preset, tmp_path)
    results = tmp_path / "data" / "results" / "smoke"
    write_results({"cloth": {"3": {}, "5": {"run": {"model": "another"}}}}, results / "sigma.json")
    assert asked == "cloth-sift"
    table = read_results(preset, tmp_path)
    assert table["rope"] == {}
    assert table["cloth"]["spcl_dense"]["rmse_mean"] == pytest.approx(rmse, abs=1e-3)
    assert table["cloth"]["sift"]["rmse_mean"] == pytest.approx(of_sift, abs=1e-3)
    runs = json.loads((results / "runs.json").read_text())
    assert runs["cloth-spcl_dense"]["steps"] == 1
    budget, sigma = (json.loads((results / f"{name}.json").read_text()) for name in ("budget", "sigma"))
    assert budget["cloth"].keys() == {"pcl"} and budget["cloth"]["pcl"]["run"]["seed"] == 1
    assert budget["cloth"]["pcl"]["rmse_mean"] == pytest.approx(of_pcl, abs=1e-3)
    assert sigma.keys() == {"cloth"} and sigma["cloth"].keys() == {"3"}
    assert sigma["cloth"]["3"]["rmse_mean"] == pytest.approx(of_sigma, abs=1e-3)
    write_study_table(preset, tmp_path, "sigma", values=[3], steps=1)  # the models of the smaller budget
    write_study_table(preset, tmp_path, "sigma", values=[3], steps=2)
    assert json.loads((results / "sigma_1.json").read_text()) == sigma and not (results / "sigma_2.json").exists()
    made = tmp_path / "data" / "generated" / "smoke"
    for folder in ("models", "queries"):  # answers without their models, then neither, as on another machine
        shutil.rmtree(made / folder)
        assert read_results(preset, tmp_path) == table
    assert json.loads((results / "sigma.json").read_text()) == sigma
    assert json.loads((results / "budget.json").read_text()) == budget
    changed = dataclasses.replace(preset, train={**preset.train, "cloth": dataclasses.replace(cloth, steps=2)})
    assert read_results(changed, tmp_path)["cloth"].keys() == {"sift"}


def test_some_can_be_chosen_by_name(chosen: list[TrainConfig]) -> None:
    matrix.main("paper", only="rope-spcl")
    assert [(m.object, m.method) for m in chosen] == [("rope", "spcl")] * 8
    assert [m.steps for m in chosen] == [4000, 1000, 1000, 1000, 4000, 4000, 4000, 3500]
    with pytest.raises(ValueError, match="--only 'shirt'"):
        matrix.main("paper", only="shirt")


def read_results(preset: Preset, root: Path) -> dict[str, dict]:
    write_tables(preset, root)
    return json.loads((root / "data" / "results" / "smoke" / "rmse.json").read_text())


def make_tiny(tiny_dataset: Callable[..., Path], root: Path) -> Preset:
    for name in ("cloth", "rope"):
        target = root / "data" / "generated" / "smoke" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        tiny_dataset(object=name).rename(target)
    return dataclasses.replace(SMOKE, evaluate=dataclasses.replace(SMOKE.evaluate, pairs=1, points=4))


def test_a_cluster_gives_what_this_process_gives(tiny_dataset: Callable[..., Path], tmp_path: Path) -> None:
    preset, root = make_tiny(tiny_dataset, tmp_path), tmp_path
    models = [dataclasses.replace(configure_model(preset, name, "mmgsd"), steps=1) for name in ("cloth", "rope")]
    how = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**how, silence_logs="ERROR") as cluster:
        there = dict(run_tasks(models, preset, root, scheduler=cluster.scheduler_address))
    for model in models:  # made by the cluster, so taken as they are
        assert (root / "data" / "generated" / "smoke" / "models" / model.name / "weights.safetensors").is_file()
    assert dict(run_tasks(models, preset, root)) == there
    assert set(there) == {model.name for model in models}


@pytest.mark.parametrize(("study", "names"), [
    ("budget", [row.name for row in matrix.list_rows("budget")]),
    ("backbones", ["light", "dinov2s"]),
])  # fmt: skip
def test_a_study_can_be_run_alone(study: str, names: list[str], chosen: list[TrainConfig]) -> None:
    paper = load_preset("paper")
    matrix.main("paper", study=study, only="cloth")
    assert chosen == list(configure_study(paper, "cloth", study).values())
    assert list(configure_study(paper, "cloth", study)) == names


def test_a_study_can_be_run_at_a_smaller_budget(
    chosen: list[TrainConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []
    monkeypatch.setattr(matrix.evaluation, "write_results", lambda rows, path: written.append(path))
    monkeypatch.setattr(matrix, "_find_row", lambda *_: ({"rmse_mean": 1.0}, {}))
    matrix.main("quick", study="backbones", steps=7)
    assert [model.steps for model in chosen] == [7] * 4 and [path.name for path in written] == ["backbones_7.json"]
    assert {model.also for model in chosen} == {"workspace_quick"}


@pytest.mark.parametrize("words", ["--study fixes", "--study backbones --seeds 2"])
def test_a_study_that_is_another_list_is_refused(words: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main(["run", "models", "paper", *words.split()])
    assert "--study" in capsys.readouterr().err


def tell(task: str, *, progress: bool) -> tuple[str, bool, int, int]:
    return task, progress, os.getpid(), torch.get_num_threads()


@pytest.mark.parametrize(("threads", "processes"), [(1, 1), (4, 2)])
def test_tasks_share_the_threads_between_processes_or_run_here_one_after_another(threads, processes):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        told = dict(run_each(tell, {(k,): f"task {k}" for k in range(2)}, desc="tasks"))
    finally:
        torch.set_num_threads(before)
    assert {name: row[0] for name, row in told.items()} == {(k,): f"task {k}" for k in range(2)}
    assert all(row[1] == (processes == 1) and (row[2] == os.getpid()) == (processes == 1) for row in told.values())
    assert {row[3] for row in told.values()} == {threads // processes}
