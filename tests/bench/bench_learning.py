"""What a number of minutes of training buys: ``python tests/bench/bench_learning.py --minutes 3 12``.

For each budget one MMGSD model of the preset's data is trained from the start, in as many steps as fit (the pace is
measured first) or in ``--steps``, and validated on the training simulations that `hold_out` keeps apart: never on test
images. Settings of `TrainConfig` can be changed, before the options: ``input_px=160 batch=24 --minutes 12``. Every run
is a row of ``data/results/experiments.csv``; one that was interrupted goes on. Run it alone: a second busy process
slows torch down several times.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import datetime
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd

from mmgsd.command import run_command
from mmgsd.config import METHODS, OBJECTS, TrainConfig, load_preset
from mmgsd.dataset import hold_out, load_dataset
from mmgsd.learn.checkpoints import LOG
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import Matcher
from mmgsd.measure.questions import measure_rmse
from mmgsd.model.tensors import load_metadata
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import configure_model
from mmgsd.studies.parameters import check_images

PACE_STEPS = 20  # steps that the pace is measured on, after as many to warm up


def parse_changes(words: list[str]) -> dict[str, object]:
    """``name=value`` words as fields of `TrainConfig`, of their types."""
    kinds = {field.name: {"int": int, "float": float, "bool": bool}.get(str(field.type), str)
             for field in dataclasses.fields(TrainConfig)}  # fmt: skip
    changes = {}
    for word in words:
        name, _, value = word.partition("=")
        if name not in kinds:
            raise SystemExit(f"{name!r} is no setting: choose among {', '.join(kinds)}")
        changes[name] = value == "True" if kinds[name] is bool else kinds[name](value)
    return changes


def measure_pace(config: TrainConfig, dataset: Path) -> float:
    """Seconds a step."""
    with tempfile.TemporaryDirectory() as folder:
        train_model(dataclasses.replace(config, steps=2 * PACE_STEPS), dataset, Path(folder), progress=False)
        seconds = pd.read_csv(Path(folder) / LOG).seconds.diff()
    return float(seconds[PACE_STEPS:].median())


def plan_steps(minutes: list[float], pace: float) -> list[int]:
    """As many as fit, of two digits: an interrupted run is found again although the pace is never the same."""
    return [int(float(f"{max(1.0, 60 * budget / pace):.2g}")) for budget in minutes]


def record(row: dict[str, object], path: Path) -> None:
    """Append a row to the log of experiments, unless the same run is there already."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = list(csv.DictReader(path.read_text().splitlines())) if path.is_file() else []
    when = ("date", "commit")
    if any(all(old[name] == str(value) for name, value in row.items() if name not in when) for old in rows):
        return
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row)
        if not rows:
            writer.writeheader()
        writer.writerow(row)


def main() -> None:
    """Train, validate, print and record each budget; the last line is the one to compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--object", default="cloth", choices=OBJECTS)
    parser.add_argument("--method", default="mmgsd", choices=METHODS)
    budgets = parser.add_mutually_exclusive_group()
    budgets.add_argument("--minutes", type=float, nargs="+", default=[3.0, 12.0])
    budgets.add_argument("--steps", type=int, nargs="+", help="budgets in steps instead")
    parser.add_argument("changes", nargs="*", metavar="name=value", help="settings of TrainConfig")
    args = parser.parse_args()
    paths = Paths(find_root(), args.preset)
    config = configure_model(load_preset(args.preset), args.object, args.method)
    config, dataset = dataclasses.replace(config, **parse_changes(args.changes)), paths.dataset(args.object)
    check_images(paths, [args.object], split="train")
    held_out = hold_out(load_dataset(dataset, "train"))[1]
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True).stdout.strip()
    results = []
    for steps in args.steps or plan_steps(args.minutes, measure_pace(config, dataset)):
        run = dataclasses.replace(config, steps=steps)
        folder, how = paths.generated / "experiments" / run.name, {"progress": sys.stderr.isatty()}
        weights = train_model(run, dataset, folder, validate_every=max(1, steps // 4), **how)
        note, rmse = load_metadata(weights), measure_rmse(Matcher.load(weights), held_out)
        taken = float(note["seconds"]) / 60
        row = {
            "date": datetime.date.today().isoformat(), "commit": commit, "preset": args.preset, "object": args.object,
            "method": args.method, "setting": " ".join(args.changes), "steps": steps, "minutes": f"{taken:.1f}",
            "images_seen": steps * run.batch, "data": note["data"], "rmse_px": f"{rmse:.1f}",
            "hardware": note["hardware"],
        }  # fmt: skip
        record(row, paths.root / "data" / "results" / "experiments.csv")
        results.append(f"{rmse:.1f} px in {taken:.1f} min")
        print(", ".join(f"{name} {value}" for name, value in row.items() if value != ""), flush=True)
    print(f"{args.object}: " + ", ".join(results))


if __name__ == "__main__":
    run_command(main)
