"""All models of a preset and its baselines as independent tasks, the most important first: here, or on a Dask cluster.

    python -m mmgsd run models paper                                  trains and asks each model; a killed call goes on
    python -m mmgsd run models paper --only cloth-spcl                those whose name holds that text
    python -m mmgsd run models paper --scheduler tcp://host:8786      each worker one model at a time, on its own GPU
    python -m mmgsd run models quick --seeds 3                        instead the seeds study, each model with three
    python -m mmgsd run models paper --seeds 3 --missing              of these, what no results hold yet
    python -m mmgsd run models paper --study backbones                instead the models of one study
    python -m mmgsd run models paper --study backbones --steps 1500   each of so many steps

Notebooks find the models and their tables of answers where they would have put them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch

from mmgsd.cluster import open_client, open_processes, wait_for_each
from mmgsd.cluster import run_tasks as run_on_workers
from mmgsd.command import Option
from mmgsd.config import OBJECTS, Preset, TrainConfig, load_preset
from mmgsd.files import DamagedFileError
from mmgsd.learn.training import train_model
from mmgsd.measure import evaluation
from mmgsd.model.network import find_device
from mmgsd.model.tensors import WEIGHTS, describe_run
from mmgsd.paths import Paths, find_root
from mmgsd.progress import ProgressBar
from mmgsd.studies.claims import get
from mmgsd.studies.models import RUN, STUDIES, configure_study, list_rows, list_runs, vary_seed, vary_sigma
from mmgsd.studies.parameters import read_scheduler

TABLES = ("budget", "backbones")  # studies with a file of their own, of models under their rows' names
ALL = "`.venv/bin/python -m mmgsd run models paper`"  # as documents say it
PROCESSES = 4  # side by side at most: each takes a gigabyte
VALIDATIONS = 8  # RMSE on held-out simulations, in a model's log

Task = TrainConfig | tuple[str, str]  # a model to train and ask, or an object and a baseline to ask


def list_tasks(preset: Preset, studies: Sequence[str] = RUN) -> list[Task]:
    """The models of some studies (`list_runs`), the first followed by chance and hand-made ones."""
    models, first = list_runs(preset, studies), list_runs(preset, studies[:1])
    if "main" not in studies:
        return list(models)
    untrained = [(name, row.name) for kind in ("chance", "hand_made") for row in list_rows(kind) for name in OBJECTS]
    return [*first, *untrained, *models[len(first) :]]


def name_task(task: Task) -> str:
    """What a model's folder is called, or "cloth-sift"."""
    return task.name if isinstance(task, TrainConfig) else "-".join(task)


def run_task(task: Task, preset: Preset, root: Path, *, progress: bool = False) -> tuple[str, float]:
    """Train a model and ask it the preset's questions, or ask a baseline, unless that is done; name and RMSE (px)."""
    paths, name = Paths(root, preset.name), name_task(task)
    if isinstance(task, TrainConfig):
        data = paths.dataset(task.object)
        every = max(1, task.steps // VALIDATIONS)
        weights = train_model(task, data, paths.model(task), progress=progress, validate_every=every)
        how = {"group": task.group, "progress": progress}
        out = evaluation.evaluate_model(weights, data, preset.evaluate, paths.queries(name), **how)
    else:
        data, out = paths.dataset(task[0]), paths.queries(name)
        evaluation.evaluate_baseline(task[1], data, preset.evaluate, out, progress=progress)
    queries = evaluation.load_queries(out)
    return name, float(queries.rmse_px[queries.visible].mean())


def run_tasks(tasks: list[Task], preset: Preset, root: Path, *, scheduler: str = "") -> Iterator[tuple]:
    """`run_task` of each, as they are done; on the workers of the Dask cluster at ``scheduler`` if one is given.

    These need the same folder ``root``, and one thread each: a worker trains one model at a time.
    """
    if not scheduler:
        yield from (run_task(task, preset, root, progress=True) for task in tasks)
        return
    with open_client(scheduler) as client:
        futures = [client.submit(run_task, task, preset, root, pure=False, priority=-i) for i, task in enumerate(tasks)]
        yield from (future.result() for future in wait_for_each(client, futures))


def train_and_ask(
    model: TrainConfig, paths: Paths, *, group: str = "", overwrite: bool = False, progress: bool = True
) -> tuple[Path, Path]:
    """Train a model and ask it the preset's questions, unless that is done: its weights, and the table of answers."""
    data, config = paths.dataset(model.object), load_preset(paths.preset).evaluate
    weights = train_model(model, data, paths.model(model), overwrite=overwrite, progress=progress)
    how = {"group": group, "overwrite": overwrite, "progress": progress}
    return weights, evaluation.evaluate_model(weights, data, config, paths.queries(model.name), **how)


def list_missing(models: Mapping[str, TrainConfig], file: Path, place: Sequence[str]) -> dict[str, TrainConfig]:
    """Those whose row is not in a results file {…: {key: row}} at a ``place``, or is of another training."""
    there = get(evaluation.read_results(file, depth=len(place) + 1), *place) or {}
    return {key: model for key, model in models.items() if get(there, key, "run", "model") != model.name}


def measure_each(
    models: Mapping[str, TrainConfig], file: Path, place: Sequence[str], ask: Callable[..., dict[str, Any]], *,
    desc: str,
) -> None:  # fmt: skip
    """Put ``ask(model, progress=…)`` of every model into a results file {…: {key: row}} at a ``place``, one by one."""
    for key, row in run_each(ask, models, desc=desc):
        results = evaluation.read_results(file, depth=len(place) + 1)
        rows = results
        for name in place:
            rows = rows.setdefault(name, {})
        rows[key] = row
        evaluation.write_results(results, file)


def train_and_measure(
    model: TrainConfig, *, paths: Paths, place: Path, name: str, images: Path, asked: Mapping[str, Path], progress: bool
) -> dict[str, Any]:  # fmt: skip
    """{where: errors} of a model trained on some ``images``, for each data set it is ``asked`` about, and its "run".

    Weights and answers are kept in ``place``, under ``name``.
    """
    weights = train_model(model, images, place / "models" / name, progress=progress)
    questions, queries = load_preset(paths.preset).evaluate, place / "queries"
    tables = {where: evaluation.evaluate_model(weights, data, questions, queries / f"{name}-{where}.parquet",
                                               progress=progress) for where, data in asked.items()}  # fmt: skip
    return evaluation.summarise(tables) | {"run": describe_run(weights)}


def run_each(
    function: Callable[..., Any], tasks: Mapping[Any, Any], *, desc: str, device: str = ""
) -> Iterator[tuple[Any, Any]]:  # fmt: skip
    """(name, ``function(task, progress=…)``) of every task, as they are done.

    On a CPU they run side by side, for two processes do more there than two of torch's threads: up to `PROCESSES`,
    which share the threads. Where there is a single thread, and on a GPU, one after another in this process.
    """
    threads = torch.get_num_threads() if find_device(device) == "cpu" else 1
    processes = min(threads, len(tasks), PROCESSES)
    if processes < 2:
        bar = ProgressBar(tasks.items(), desc=desc, total=len(tasks))
        yield from ((name, function(task, progress=True)) for name, task in bar)
        return
    work = partial(_work_quietly, function, threads // processes)
    with open_processes(processes) as client, run_on_workers(client, work, tasks) as done:
        yield from ProgressBar(done, desc=desc, total=len(tasks))


def _work_quietly(function: Callable[..., Any], threads: int, task: Any) -> Any:
    torch.set_num_threads(threads)
    return function(task, progress=False)


def choose_tasks(preset: Preset, *, study: str = "", seeds: int = 0, steps: int = 0) -> list[Task]:
    """The models compared by ``seeds``, seed after seed; those of a ``study``, of other ``steps``; or all of `RUN`."""
    if seeds:
        rows = vary_seed(range(seeds))
        keyed = {object: configure_study(preset, object, "seeds", rows, steps=steps) for object in OBJECTS}
        models = [keyed[object][row.name] for row in rows for object in OBJECTS]
        return sorted(models, key=lambda model: model.seed)
    if steps:
        return [model for name in OBJECTS for model in configure_study(preset, name, study, steps=steps).values()]
    return list_tasks(preset, (study,) if study else RUN)


def run_matrix(
    paths: Paths, tasks: list[Task] | None = None, *, study: str = "", seeds: int = 0, steps: int = 0,
    scheduler: str = "",
) -> Path:  # fmt: skip
    """Train and ask what `choose_tasks` chooses, or some ``tasks`` of it; the results file, or the folder of all.

    Tables are written after each model.
    """
    preset, root = load_preset(paths.preset), paths.root
    tasks = choose_tasks(preset, study=study, seeds=seeds, steps=steps) if tasks is None else tasks
    done = run_tasks(tasks, preset, root, scheduler=scheduler)
    kind = "seeds" if seeds else study
    write = partial(write_tables, preset, root)
    if seeds or steps:
        write = partial(write_study_table, preset, root, kind, values=range(seeds), steps=steps)
    for name, rmse in ProgressBar(done, total=len(tasks), desc="models and baselines"):
        ProgressBar.write(f"{name}: {rmse:.1f} px")
        write()
    if not tasks:
        write()
    return paths.results / (f"{kind}_{steps}.json" if steps else f"{kind}.json") if kind else paths.results


def write_tables(preset: Preset, root: Path) -> None:
    """Write what is trained and asked so far: the main table, those of the studies at the equal budget, that of σ.

    Where the answers are not here, given on another machine, the row that is there is kept if it is of the same model.
    """
    write_main_table(preset, root)
    for study in (*TABLES, "sigma"):
        write_study_table(preset, root, study)


def write_study_table(
    preset: Preset, root: Path, study: str, *, values: Sequence[float] = (), steps: int = 0
) -> None:  # fmt: skip
    """Write {object: {row: errors, and under "run" the cost}} of a study where any is done, as `write_tables` does.

    ``values`` are σ (px), besides the preset's, or seeds, besides those that are there. The models of other ``steps``
    than the study's have a file of their own: backbones_1500.json. Of those compared by seeds that the main table or
    the study of the smaller budget has as well, their rows are taken where there are no others.
    """
    paths, file = Paths(root, preset.name), f"{study}_{steps}.json" if steps else f"{study}.json"
    stored, rows, varied = evaluation.read_results(paths.results / file, depth=2), {}, None
    if study == "sigma":
        varied = vary_sigma([*preset.sigmas_px, *values, *_read_keys(paths.results / file, stored, float)])
    elif study == "seeds":
        there = _read_keys(paths.results / file, stored, lambda key: int(key.rpartition("-")[2]))
        varied = vary_seed([*values, *there])
    named = _list_named(paths) if study == "seeds" else {}
    for name in OBJECTS:
        for key, model in configure_study(preset, name, study, varied, steps=steps).items():
            stored_row = get(stored, name, key) or named.get(model.name, {})
            row, run = _find_row(paths, "", model, stored_row, stored_row.get("run", {}))
            if row:
                rows.setdefault(name, {})[key] = {**row, "run": run}
    if rows or stored:
        evaluation.write_results(rows, paths.results / file)


def _list_named(paths: Paths) -> dict[str, dict[str, Any]]:
    """{name of a model: its row, with its cost under "run"} of the smaller budget and the main table."""
    named = {row["run"].get("model"): row for rows in evaluation.read_results(paths.results / "budget.json", depth=2)
             .values() for row in rows.values() if "run" in row}  # fmt: skip
    costs = evaluation.read_results(paths.results / "runs.json")
    for name, rows in evaluation.read_results(paths.results / "rmse.json", depth=2).items():
        runs = {method: costs.get(f"{name}-{method}", {}) for method in rows}
        named |= {run["model"]: {**rows[method], "run": run} for method, run in runs.items() if "model" in run}
    return named


def drop_done(tasks: Sequence[Task], paths: Paths, file: str) -> list[Task]:
    """Without the models whose rows a results file, the main table or that of the smaller budget holds already."""
    stored = evaluation.read_results(paths.results / file, depth=2)
    done = {get(row, "run", "model") for rows in stored.values() for row in rows.values()} | _list_named(paths).keys()
    return [task for task in tasks if name_task(task) not in done]


def _read_keys(path: Path, stored: dict[str, dict], convert: Callable[[str], float]) -> list[float]:
    """The numbers that a study's rows are called by; DamagedFileError where one is none."""
    try:
        return [convert(key) for rows in stored.values() for key in rows]
    except ValueError as error:
        raise DamagedFileError(f"{path} has a row of another study ({error}): restore it, or remove the row") from error


def write_main_table(preset: Preset, root: Path) -> dict[str, dict[str, dict]]:
    """Write rmse.json and runs.json, by the rule of `write_tables`; returns the former, {object: {method: row}}."""
    paths = Paths(root, preset.name)
    errors = evaluation.read_results(paths.results / "rmse.json", depth=2)
    costs = evaluation.read_results(paths.results / "runs.json")
    tables, runs = {name: {} for name in OBJECTS}, {}
    for name in OBJECTS:
        models = configure_study(preset, name, "main")
        for method in (*models, *evaluation.BASELINES, *evaluation.CHANCE):
            key, stored = f"{name}-{method}", errors.get(name, {}).get(method, {})
            row, run = _find_row(paths, key, models.get(method), stored, costs.get(key, {}))
            tables[name] |= {method: row} if row else {}
            runs |= {key: run} if run else {}
    evaluation.write_results(runs, paths.results / "runs.json")
    evaluation.write_results(tables, paths.results / "rmse.json")
    return tables


def _find_row(paths: Paths, key: str, model: TrainConfig | None, row: dict, run: dict) -> tuple[dict, dict]:
    """Results and cost of a model, or of the baseline ``key``: of its answers and weights, or else what is stored."""
    out, weights = paths.queries(model.name if model else key), paths.model(model) / WEIGHTS if model else None
    if out.is_file() and (weights is None or weights.is_file()):  # answers alone do not say what they cost
        return evaluation.summarise({key: out})[key], describe_run(weights) if weights else {}
    return (row, run) if model is None or run.get("model") == model.name else ({}, {})


def main(
    preset: str,
    *,
    only: Annotated[str, Option("those whose name holds this text, like cloth or cloth-spcl")] = "",
    study: Annotated[str, Option("instead the models of one study", choices=STUDIES)] = "",
    seeds: Annotated[int, Option("instead the models compared by seeds, each with so many")] = 0,
    steps: Annotated[int, Option(f"of those, or of the study {' or '.join(TABLES)}")] = 0,
    missing: Annotated[bool, Option("of those with --seeds, what no results hold yet")] = False,
    scheduler: Annotated[str, Option("address of a Dask scheduler; none: this process")] = "",
) -> None:
    """Run the models and baselines of a preset, a line each."""
    if seeds < 0 or steps < 0 or (steps and not (seeds or study in TABLES)):
        studies = " or ".join(TABLES)
        raise ValueError(f"--seeds and --steps must be positive, and --steps needs --seeds or --study {studies}, "
                         f"got --seeds {seeds}, --steps {steps}, --study {study!r}")  # fmt: skip
    if study and seeds:
        raise ValueError(f"--study and --seeds are two different lists of models: give one, got {study!r} and {seeds}")
    config = load_preset(preset)
    tasks = [task for task in choose_tasks(config, study=study, seeds=seeds, steps=steps) if only in name_task(task)]
    if not tasks:
        raise ValueError(f"--only {only!r}: no model or baseline of the preset {config.name} has a name with that")
    if missing:
        if not seeds:
            raise ValueError("--missing must be given with --seeds")
        tasks = drop_done(tasks, Paths(find_root(), config.name), f"seeds_{steps}.json" if steps else "seeds.json")
    options = {"study": study, "seeds": seeds, "steps": steps}
    run_matrix(Paths(find_root(), config.name), tasks, **options, scheduler=read_scheduler("--scheduler", scheduler))
