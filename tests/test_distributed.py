"""Two processes learn what one does."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file

from mmgsd import training
from mmgsd.config import TrainConfig
from mmgsd.distributed import Team, joined
from mmgsd.training import LOG, WEIGHTS, train_model

CONFIG = TrainConfig(steps=3, batch=4, groups=2, pairs=4, queries=16, input_px=64, descriptor_dim=8)
SCRIPT = """
import json, sys
from pathlib import Path
from mmgsd.config import TrainConfig, from_dict
from mmgsd.training import train_model

config = from_dict(TrainConfig, json.loads(sys.argv[1]))
train_model(config, Path(sys.argv[2]), Path(sys.argv[3]), device="cpu", progress=False)
"""


def train_by_two(config: TrainConfig, dataset: Path, folder: Path) -> subprocess.CompletedProcess:
    script = folder.parent / "train.py"
    script.write_text(SCRIPT)
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(script)]
    env = {**os.environ, "PYTHONPATH": str(Path(training.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    command = [*launch, json.dumps(dataclasses.asdict(config)), str(dataset), str(folder)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)


def test_two_processes_have_the_losses_and_gradients_of_one(
    tiny_dataset: Callable[..., Path], tmp_path: Path
) -> None:
    dataset = tiny_dataset()
    one = train_model(CONFIG, dataset, tmp_path / "one", device="cpu", progress=False)
    done = train_by_two(CONFIG, dataset, tmp_path / "two")
    assert done.returncode == 0, done.stderr[-2000:]
    losses = [pd.read_csv(tmp_path / name / LOG).loss.to_numpy() for name in ("one", "two")]
    np.testing.assert_allclose(losses[1], losses[0], rtol=1e-4)
    states = [load_file(path) for path in (one, tmp_path / "two" / WEIGHTS)]
    learnt = [name for name in states[0] if "running" not in name and "batches" not in name]
    for name in learnt:  # equal gradients: Adam would make a sign of any difference
        torch.testing.assert_close(states[1][name], states[0][name], rtol=1e-3, atol=1e-4)


def test_groups_are_shared_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ValueError, match="groups must be a multiple of the 2 processes, got 3"), joined(3, "cpu"):
        pass


def test_alone_a_process_has_all_groups() -> None:
    with joined(3, "cpu") as team:
        assert team == Team(torch.device("cpu"), (0, 1, 2))
        assert team.add(1.5) == 1.5
