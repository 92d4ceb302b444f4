"""Every bench runs, at its smallest size, and says what it needs where that is not there."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from synthetic import write_tiny_dataset

from mmgsd.config import OBJECTS, load_preset
from mmgsd.learn.training import train_model
from mmgsd.paths import Paths
from mmgsd.studies.models import configure_model

FOLDER = Path(__file__).parent / "bench"
BENCHES = sorted(path.stem.removeprefix("bench_") for path in FOLDER.glob("bench_*.py"))


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Paths:
    """Both objects' synthetic data, and a trained MMGSD of each."""
    paths = Paths(tmp_path_factory.mktemp("bench"), "smoke")
    for name in OBJECTS:
        data = write_tiny_dataset(paths.generated, object=name, n_train=8, n_test=4)
        config = configure_model(load_preset("smoke"), name, "mmgsd")
        train_model(config, data, paths.model(config), device="cpu", progress=False)
    return paths


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> Callable[..., str]:
    """Runs a bench below a root with some arguments and other constants; what it printed last."""

    def run_bench(name: str, root: Path, *arguments: str, **constants: object) -> str:
        monkeypatch.syspath_prepend(FOLDER)
        monkeypatch.setenv("MMGSD_ROOT", str(root))
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        for key, value in constants.items():
            module = importlib.import_module("bench_learning" if key == "PACE_STEPS" else f"bench_{name}")
            assert hasattr(module, key)
            monkeypatch.setattr(module, key, value)
        importlib.import_module(f"bench_{name}").main()
        return capsys.readouterr().out.splitlines()[-1]

    return run_bench


@pytest.mark.parametrize(("name", "arguments", "constants", "said"), [
    ("clutter", (), {"ROUNDS": 1, "PACE_STEPS": 1, "OBJECTS": ("rope",)}, "'share'"),
    ("learning", ("--preset", "smoke", "--minutes", "0.0001", "--", "batch=2"), {"PACE_STEPS": 1}, "cloth: "),
    ("matching", ("2", "smoke"), {"PLAIN": 2, "DRAWN": 500}, "x arg-min"),
    ("rendering", ("2", "1"), {"EPISODES": 1, "OBJECTS": ("rope",)}, "rope "),
])  # fmt: skip
def test_a_bench_runs(run: Callable, smoke: Paths, name: str, arguments: tuple, constants: dict, said: str) -> None:
    assert said in run(name, smoke.root, *arguments, **constants)


def test_every_bench_is_run() -> None:
    (table,) = (mark for mark in test_a_bench_runs.pytestmark if mark.name == "parametrize")
    elsewhere = ["explorer"]  # in extras/test_browser.py, on the page that is open there
    assert sorted([row[0] for row in table.args[1]] + elsewhere) == BENCHES


@pytest.mark.parametrize(("name", "missing"), [
    ("clutter", "smoke/cloth/dataset.json"), ("learning", "paper/cloth/dataset.json"),
    ("matching", "quick/cloth/dataset.json"),
])  # fmt: skip
def test_a_bench_says_which_data_it_lacks(run: Callable, tmp_path: Path, name: str, missing: str) -> None:
    with pytest.raises(ValueError, match=f"there is no data/generated/{missing} yet: run 01_render_data"):
        run(name, tmp_path)


def test_a_bench_lacks_something_in_one_sentence(tmp_path: Path) -> None:
    environment = {"MMGSD_ROOT": str(tmp_path), "PATH": ""}
    command = [sys.executable, str(FOLDER / "bench_matching.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_a_bench_says_which_model_it_lacks(run: Callable, smoke: Paths, tmp_path: Path) -> None:
    for object in OBJECTS:
        shutil.copytree(smoke.dataset(object), Paths(tmp_path, "smoke").dataset(object))
    with pytest.raises(ValueError, match="there is no data/.*model.* yet: run"):
        run("matching", tmp_path, "2", "smoke")
