"""What pasting costs a step of training: ``python tests/bench/bench_clutter.py``, written to data/results/clutter.json.

The first round of the shipped models' training, on the images of `make smoke`, with and without `TrainConfig.clutter`
in turn.
"""

from __future__ import annotations

import dataclasses
import statistics

import torch
from bench_learning import measure_pace

from mmgsd.command import run_command
from mmgsd.config import OBJECTS, load_preset
from mmgsd.files import write_json
from mmgsd.model.network import name_hardware
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import configure_study
from mmgsd.studies.parameters import check_images

ROUNDS = 2


def main() -> None:
    """Measure both objects, print and store."""
    results, root = {}, find_root()
    check_images(Paths(root, "smoke"), OBJECTS, split="train")
    for name in OBJECTS:
        config = dataclasses.replace(configure_study(load_preset("round1"), name, "rounds")["round1"], also="")
        seconds = {True: [], False: []}
        for clutter in (True, False) * ROUNDS:
            changed = dataclasses.replace(config, clutter=clutter)
            seconds[clutter].append(measure_pace(changed, Paths(root, "smoke").dataset(name)))
        pasted, plain = (statistics.mean(seconds[clutter]) for clutter in (True, False))
        results[name] = {"seconds": round(pasted, 3), "without": round(plain, 3), "share": round(1 - plain / pasted, 3),
                         "hardware": name_hardware(torch.device("cpu"))}  # fmt: skip
        print(name, results[name])
    write_json(root / "data" / "results" / "clutter.json", results)


if __name__ == "__main__":
    run_command(main)
