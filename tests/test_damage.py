"""Whatever is damaged on disk is named, with what to do about it, or made again: never a bare error, never a hang."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file

from mmgsd.config import EvaluateConfig, TrainConfig, load_preset
from mmgsd.dataset import check_dataset
from mmgsd.dataset_format import DATASET_FILES
from mmgsd.extras import shipping
from mmgsd.files import DamagedFileError
from mmgsd.learn import training
from mmgsd.learn.checkpoints import CHECKPOINT
from mmgsd.learn.training import train_model
from mmgsd.match.match import Match
from mmgsd.measure.evaluation import evaluate_baseline, load_queries, write_results
from mmgsd.measure.metrics import ErrorSummary
from mmgsd.model.tensors import WEIGHTS, describe_run
from mmgsd.report import latex as report
from mmgsd.report import tables
from mmgsd.studies import matrix
from mmgsd.studies.figure_data import FigureData, load_figure_data, save_figure_data

CONFIG = TrainConfig(steps=1, batch=4, pairs=6, queries=16, input_px=64, descriptor_dim=8)
ASKED = EvaluateConfig(pairs=1, points=3)
RESULTS = {"cloth": {"mmgsd": {"rmse_mean": 1.0, "median": 1.0, "pck@20px": 1.0}}, "rope": {}}


def flip(data: bytes) -> bytes:
    """One bit of the middle is another."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]


def drop_key(data: bytes) -> bytes:
    """JSON without its first key; of other files, without the first half."""
    try:
        values = json.loads(data)
        return json.dumps(dict(list(values.items())[1:])).encode()
    except (ValueError, AttributeError):
        return data[len(data) // 2 :]


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda data: data[: len(data) // 3],
    "empty": lambda data: b"",
    "bit flipped": flip,
    "wrong type": lambda data: b"[1, 2, 3]",
    "binary": lambda data: b"\xff\xfe\x00" * 50,
    "lacks a part": drop_key,
}


@pytest.fixture(scope="module")
def trained(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with finished weights, and the checkpoint of the same step: read it only."""
    folder = tmp_path_factory.mktemp("trained")
    kept = folder / "kept"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training.Run, "finish", lambda run, weights: run.save())
        train_model(CONFIG, cloth_dataset, folder / "model", device="cpu", progress=False)
        kept.write_bytes((folder / "model" / CHECKPOINT).read_bytes())
    train_model(CONFIG, cloth_dataset, folder / "model", device="cpu", progress=False)
    kept.rename(folder / "model" / CHECKPOINT)
    return folder / "model"


def of_data_set(name: str) -> Callable[..., None]:
    def use(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
        copy = shutil.copytree(dataset, folder / "cloth")
        info = json.loads((copy / DATASET_FILES[0]).read_text())
        digest = hashlib.sha256((copy / DATASET_FILES[1]).read_bytes()).hexdigest()
        (copy / DATASET_FILES[0]).write_text(json.dumps({**info, "labels_sha256": digest}))
        path = copy / name
        path.write_bytes(damage(path.read_bytes()))
        check_dataset(copy)

    return use


def use_weights(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
    weights = folder / WEIGHTS
    weights.write_bytes(damage((model / WEIGHTS).read_bytes()))
    describe_run(weights)


def use_checkpoint(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
    (folder / CHECKPOINT).write_bytes(damage((model / CHECKPOINT).read_bytes()))
    with pytest.warns(UserWarning, match=f"{CHECKPOINT} is damaged"):
        weights = train_model(CONFIG, dataset, folder, device="cpu", progress=False)
    ours, theirs = load_file(weights), load_file(model / WEIGHTS)
    assert all(torch.equal(ours[name], value) for name, value in theirs.items())


def use_table_of_answers(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
    out = evaluate_baseline("centre", dataset, ASKED, folder / "centre.parquet", progress=False)
    whole = load_queries(out)
    out.write_bytes(damage(out.read_bytes()))
    warned = pytest.warns(UserWarning, match="centre.parquet is damaged")
    with nullcontext() if damage is flip else warned:  # a flipped bit may be in statistics that nobody reads
        evaluate_baseline("centre", dataset, ASKED, out, progress=False)
    pd.testing.assert_frame_equal(load_queries(out), whole)


def of_results(use: Callable[[Path], object]) -> Callable[..., None]:
    def read(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
        path = write_results(RESULTS, folder / "data" / "results" / "smoke" / "rmse.json")
        path.write_bytes(damage(path.read_bytes()))
        before = path.read_bytes()
        try:
            use(folder)
        except DamagedFileError:
            assert path.read_bytes() == before
            raise

    return read


def fill_table(folder: Path) -> None:
    document = folder / "README.md"
    document.write_text(f"{tables.BEGIN}\n\n{tables.END}\n".replace("NAME", "quick"))
    path = folder / "data" / "results"
    shutil.copytree(path / "smoke", path / "quick")
    tables.update_tables(document, path)


def use_figure_data(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
    image, xy = np.zeros((48, 48, 3), np.uint8), np.zeros((1, 2))
    answer = Match(image, image, xy, np.ones((1, 4, 2)), np.ones((1, 4)), np.ones((1, 4, 2, 2)), np.zeros(1),
                   np.zeros(1), np.ones((1, 5, 5), np.float32))  # fmt: skip
    errors = ErrorSummary(np.ones(3), np.ones(3), np.ones(4))
    path = save_figure_data(FigureData({"mmgsd": errors}, 1.0, {"mmgsd": answer}, [xy]), folder / "figures.safetensors")
    path.write_bytes(damage(path.read_bytes()))
    load_figure_data(path)


def use_shipped(folder: Path, damage: Callable[[bytes], bytes], dataset: Path, model: Path) -> None:
    (folder / "cloth.safetensors").write_bytes(damage((model / WEIGHTS).read_bytes()))
    shipping.restore_model(folder / "cloth.safetensors", folder / "model", CONFIG)


REFUSED = {
    "description": (of_data_set("dataset.json"), "dataset.json"),
    "labels": (of_data_set("labels.parquet"), "labels.parquet"),
    "image": (of_data_set("images/00000.webp"), "images/00000.webp"),
    "mask": (of_data_set("masks/00000.png"), "masks/00000.png"),
    "weights": (use_weights, WEIGHTS),
    "shipped weights": (use_shipped, "cloth.safetensors"),
    "results that are written again": (
        of_results(lambda root: matrix.write_tables(load_preset("smoke"), root)), "rmse.json",
    ),
    "results for the report": (of_results(lambda root: report.write_report("smoke", root)), "rmse.json|results"),
    "results for the README": (of_results(fill_table), "rmse.json"),
    "data of figures": (use_figure_data, "figures.safetensors"),
}  # fmt: skip
MAY_STAY_VALID = ("bit flipped", "lacks a part")  # as another number of a JSON file


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize("use", [use_checkpoint, use_table_of_answers])
def test_a_damaged_intermediate_is_made_again(cloth_dataset: Path, trained: Path, tmp_path: Path, use, how) -> None:
    use(tmp_path, DAMAGES[how], cloth_dataset, trained)


@pytest.mark.parametrize("how", DAMAGES)
@pytest.mark.parametrize("kind", REFUSED)
def test_a_damaged_file_is_named(cloth_dataset: Path, trained: Path, tmp_path: Path, kind: str, how: str) -> None:
    use, name = REFUSED[kind]
    try:
        use(tmp_path, DAMAGES[how], cloth_dataset, trained)
    except DamagedFileError as error:
        assert re.search(name, str(error))
    else:
        assert how in MAY_STAY_VALID
