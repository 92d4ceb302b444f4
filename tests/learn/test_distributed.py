"""Two processes learn what one does."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from mmgsd.config import TrainConfig
from mmgsd.learn import training
from mmgsd.learn.checkpoints import CHECKPOINT
from mmgsd.learn.distributed import World, joined

CONFIG = TrainConfig(steps=3, batch=4, groups=2, pairs=4, queries=16, input_px=64, descriptor_dim=8)
SCRIPT = """
import json, psutil, sys
from pathlib import Path
from mmgsd.learn import distributed, training
from mmgsd.config import TrainConfig, from_dict

add, said = distributed.World.add, []

def tell(world, value):
    there = psutil.Process().net_connections("inet")
    said.append(sorted({c.laddr.ip for c in there if c.status == psutil.CONN_LISTEN}))
    if len(said) == 1:
        print("listens on", said[0], flush=True)
    return add(world, value)

distributed.World.add = tell
training.Run.finish = lambda run, weights: run.save()  # the optimiser's moments stay
config = from_dict(TrainConfig, json.loads(sys.argv[1]))
training.train_model(config, Path(sys.argv[2]), Path(sys.argv[3]), device="cpu", progress=False)
"""


def train_in_two(dataset: Path, folder: Path) -> str:
    """What the two processes print."""
    script = folder.parent / "train.py"
    script.write_text(SCRIPT)
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    env = {**os.environ, "PYTHONPATH": str(Path(training.__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    command = [*launch, str(script), json.dumps(dataclasses.asdict(CONFIG)), str(dataset), str(folder)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def read_run(folder: Path) -> tuple[np.ndarray, torch.Tensor]:
    """Losses of all steps, and the mean gradients that Adam keeps."""
    with safe_open(folder / CHECKPOINT, "pt") as file:
        names = sorted(name for name in file.keys() if name.endswith("/exp_avg"))  # noqa: SIM118
        moments = torch.cat([file.get_tensor(name).flatten() for name in names])
        return np.array([row["loss"] for row in json.loads(file.metadata()["numbers"])["log"]]), moments


def test_two_processes_have_the_losses_and_gradients_of_one_and_listen_on_loopback_alone(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = tiny_dataset()
    said = re.findall(r"\[[^]]*\]", train_in_two(dataset, tmp_path / "two"))  # written at once: lines may mix
    assert len(said) == 2 and set(said) <= {"['127.0.0.1']", "[]"}
    monkeypatch.setattr(training.Run, "finish", lambda run, weights: run.save())
    training.train_model(CONFIG, dataset, tmp_path / "one", device="cpu", progress=False)
    (losses, moments), (losses_of_two, moments_of_two) = (read_run(tmp_path / name) for name in ("one", "two"))
    np.testing.assert_allclose(losses_of_two, losses, rtol=1e-3)  # the decoder computes in bfloat16
    assert len(moments) > 1e6
    assert (moments_of_two - moments).norm() < 0.02 * moments.norm()


def test_groups_are_shared_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ValueError, match="groups must .*got 3"), joined(3, "cpu"):
        pass


def test_alone_a_process_has_all_groups() -> None:
    with joined(3, "cpu") as world:
        assert world == World(torch.device("cpu"), (0, 1, 2))
        assert world.add(1.5) == 1.5
