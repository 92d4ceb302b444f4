"""All models of a preset as independent tasks, the most important first: here in turn, or on a Dask cluster.

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
from mmgsd.evaluation import BASELINES, CHANCE, evaluate_model, load_queries, summarise, write_results
from mmgsd.training import WEIGHTS, describe_run, train_model

FIRST, LATER = ("mmgsd", "spcl"), ("unimodal", "pcl", "spcl_dense")  # of the main table: before the studies, and after
GROUPS = ("c4", "v4", "d4")
VALIDATIONS = 8  # RMSE on held-out simulations, in a model's log


def list_models(preset: Preset, *, seeds: int = 1) -> list[TrainConfig]:
    """MMGSD and SPCL, the symmetry study, the σ ablation, the rest of the main table, and further seeds."""
    first, later = ([preset.main_table(name)[m] for m in methods for name in OBJECTS] for methods in (FIRST, LATER))
    groups = [dataclasses.replace(preset.ablation["cloth"], group=group) for group in GROUPS]
    sigmas = [dataclasses.replace(preset.ablation[name], sigma_px=s) for s in preset.sigmas_px for name in OBJECTS]
    repeated = [dataclasses.replace(config, seed=seed) for seed in range(1, seeds) for config in first]
    return list(dict.fromkeys([*first, *groups, *sigmas, *later, *repeated]))


def run_model(config: TrainConfig, preset: Preset, root: Path, *, progress: bool = False) -> tuple[str, float]:
    """Train a model and ask it the preset's questions, unless that is done; its name and mean RMSE (px)."""
    paths = Paths(root, preset.name)
    data, out = paths.dataset(config.object), paths.queries(config.name)
    every = max(1, config.steps // VALIDATIONS)
    weights = train_model(config, data, paths.model(config), progress=progress, validate_every=every)
    queries = load_queries(evaluate_model(weights, data, preset.evaluate, out, group=config.group, progress=progress))
    return config.name, float(queries.rmse_px[queries.visible].mean())


def run_models(models: list[TrainConfig], preset: Preset, root: Path, *, scheduler: str = "") -> Iterator[tuple]:
    """`run_model` of each, as they are done; on the workers of the Dask cluster at ``scheduler`` if one is given.

    These need the same folder ``root``, and one thread each: a worker trains one model at a time.
    """
    if not scheduler:
        yield from (run_model(config, preset, root, progress=True) for config in models)
        return
    with Client(scheduler) as client:
        futures = [client.submit(run_model, config, preset, root, pure=False, priority=-i)
                   for i, config in enumerate(models)]  # fmt: skip
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
    """Run the models of a preset, a line each."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.matrix", description=__doc__.split("\n")[0])
    parser.add_argument("preset")
    parser.add_argument("--seeds", type=int, default=1, help="of mmgsd and spcl (default %(default)s)")
    parser.add_argument("--scheduler", default="", help="address of a Dask scheduler; none: this process")
    asked = parser.parse_args()
    preset = load_preset(asked.preset)
    models = list_models(preset, seeds=asked.seeds)
    done = run_models(models, preset, find_root(), scheduler=asked.scheduler)
    for name, rmse in tqdm(done, total=len(models), desc="models"):
        tqdm.write(f"{name}: {rmse:.1f} px")
        write_main_table(preset, find_root())


if __name__ == "__main__":
    main()
