"""All models of a preset and its baselines as independent tasks, the most important first: here, or on a Dask cluster.

    python -m mmgsd.matrix paper                                    trains and asks each model; a killed call goes on
    python -m mmgsd.matrix paper --scheduler tcp://host:8786        each worker one model at a time, on its own GPU

Notebooks find the models and their tables of answers where they would have put them.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path

from dask.distributed import Client, as_completed
from tqdm.auto import tqdm

from mmgsd.config import OBJECTS, Paths, Preset, TrainConfig, find_root, load_preset
from mmgsd.evaluation import (
    BASELINES,
    CHANCE,
    evaluate_baseline,
    evaluate_model,
    load_queries,
    summarise,
    write_results,
)
from mmgsd.training import WEIGHTS, describe_run, train_model

FIRST, LATER = ("mmgsd", "spcl"), ("unimodal", "pcl", "spcl_dense")  # of the main table: before the studies, and after
GROUPS = ("c4", "v4", "d4")
VALIDATIONS = 8  # RMSE on held-out simulations, in a model's log

Task = TrainConfig | tuple[str, str]  # a model to train and ask, or an object and a baseline to ask


def list_models(preset: Preset, *, seeds: int = 1) -> list[TrainConfig]:
    """MMGSD and SPCL, the symmetry study, the σ ablation, the rest of the main table, and further seeds."""
    first, later = ([preset.main_table(name)[m] for m in methods for name in OBJECTS] for methods in (FIRST, LATER))
    groups = [dataclasses.replace(preset.ablation["cloth"], group=group) for group in GROUPS]
    sigmas = [dataclasses.replace(preset.ablation[name], sigma_px=s) for s in preset.sigmas_px for name in OBJECTS]
    repeated = [dataclasses.replace(config, seed=seed) for seed in range(1, seeds) for config in first]
    return list(dict.fromkeys([*first, *groups, *sigmas, *later, *repeated]))


def list_tasks(preset: Preset, *, seeds: int = 1) -> list[Task]:
    """MMGSD and SPCL, then chance and the hand-made descriptors, then the other models (`list_models`)."""
    models, count = list_models(preset, seeds=seeds), len(FIRST) * len(OBJECTS)
    return [*models[:count], *((name, method) for method in (*CHANCE, *BASELINES) for name in OBJECTS), *models[count:]]


def run_task(task: Task, preset: Preset, root: Path, *, progress: bool = False) -> tuple[str, float]:
    """Train a model and ask it the preset's questions, or ask a baseline, unless that is done; name and RMSE (px)."""
    paths = Paths(root, preset.name)
    if isinstance(task, TrainConfig):
        name, data, every = task.name, paths.dataset(task.object), max(1, task.steps // VALIDATIONS)
        weights = train_model(task, data, paths.model(task), progress=progress, validate_every=every)
        how = {"group": task.group, "progress": progress}
        out = evaluate_model(weights, data, preset.evaluate, paths.queries(name), **how)
    else:
        name, data = "-".join(task), paths.dataset(task[0])
        out = evaluate_baseline(task[1], data, preset.evaluate, paths.queries(name), progress=progress)
    queries = load_queries(out)
    return name, float(queries.rmse_px[queries.visible].mean())


def run_tasks(tasks: list[Task], preset: Preset, root: Path, *, scheduler: str = "") -> Iterator[tuple]:
    """`run_task` of each, as they are done; on the workers of the Dask cluster at ``scheduler`` if one is given.

    These need the same folder ``root``, and one thread each: a worker trains one model at a time.
    """
    if not scheduler:
        yield from (run_task(task, preset, root, progress=True) for task in tasks)
        return
    with Client(scheduler) as client:
        futures = [client.submit(run_task, task, preset, root, pure=False, priority=-i)
                   for i, task in enumerate(tasks)]  # fmt: skip
        yield from (future.result() for future in as_completed(futures))


def write_main_table(preset: Preset, root: Path) -> Path:
    """Write rmse.json and runs.json of what is trained and asked so far, as `04_evaluate` does when all is."""
    paths = Paths(root, preset.name)
    tables, runs = {}, {}
    for name in OBJECTS:
        models = {m: c for m, c in preset.main_table(name).items() if paths.queries(c.name).is_file()}
        files = {m: paths.queries(c.name) for m, c in models.items()}
        others = {m: paths.queries(f"{name}-{m}") for m in (*BASELINES, *CHANCE)}
        tables[name] = summarise(files | {m: path for m, path in others.items() if path.is_file()})
        runs |= {f"{name}-{m}": describe_run(paths.model(c) / WEIGHTS) for m, c in models.items()}
    write_results(runs, paths.results / "runs.json")
    return write_results(tables, paths.results / "rmse.json")


def main() -> None:
    """Run the models and baselines of a preset, a line each."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.matrix", description=__doc__.split("\n")[0])
    parser.add_argument("preset")
    parser.add_argument("--seeds", type=int, default=1, help="of mmgsd and spcl (default %(default)s)")
    parser.add_argument("--scheduler", default="", help="address of a Dask scheduler; none: this process")
    asked = parser.parse_args()
    preset = load_preset(asked.preset)
    tasks = list_tasks(preset, seeds=asked.seeds)
    done = run_tasks(tasks, preset, find_root(), scheduler=asked.scheduler)
    for name, rmse in tqdm(done, total=len(tasks), desc="models and baselines"):
        tqdm.write(f"{name}: {rmse:.1f} px")
        write_main_table(preset, find_root())


if __name__ == "__main__":
    main()
