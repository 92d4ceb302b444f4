"""Measures of the heads: a network that knows scores one, one without heads says so, and finished ones are kept."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mmgsd.config import EvaluateConfig, TrainConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.matcher import Matcher
from mmgsd.measure import heads
from mmgsd.measure.heads import MEASURES, evaluate_heads, measure_heads
from mmgsd.model.heads import Outputs
from mmgsd.model.network import build_network
from mmgsd.model.tensors import write_tensors

CONFIG = EvaluateConfig(pairs=2, points=5)


def write_weights(folder: Path, *, with_heads: bool = True) -> Path:
    torch.manual_seed(0)
    config = TrainConfig(input_px=64, descriptor_dim=4, heads=with_heads)
    network = build_network("lite0", 4, heads=with_heads, pretrained=False)
    metadata = {"format": "mmgsd-1", "config": json.dumps(dataclasses.asdict(config)), "size": "[485, 485]"}
    return write_tensors(folder / "w.safetensors", network.state_dict(), metadata | {"modes": "4"})


def measure(weights: Path, dataset: Path, out: Path, **how: bool) -> dict:
    return json.loads(evaluate_heads(weights, dataset, CONFIG, out, progress=False, **how).read_text())


def test_untrained_heads_are_measured(cloth_dataset: Path, tmp_path: Path) -> None:
    found = measure(write_weights(tmp_path), cloth_dataset, tmp_path / "heads.json")
    assert found["heads"] is True and found["images"] == 4
    assert 0 <= found["mask_iou"] <= 1 and 0 <= found["auroc_on_object"] <= 1
    assert found["auroc_visible"] is None and found["auroc_absent"] is None  # all is seen, in all images


def test_weights_without_heads_say_so(cloth_dataset: Path, tmp_path: Path) -> None:
    found = measure(write_weights(tmp_path, with_heads=False), cloth_dataset, tmp_path / "heads.json")
    assert found["heads"] is False and all(found[name] is None for name in MEASURES)


def test_finished_measures_are_left_alone(cloth_dataset: Path, tmp_path: Path) -> None:
    weights, out = write_weights(tmp_path), tmp_path / "heads.json"
    before = measure(weights, cloth_dataset, out)
    out.write_text(json.dumps(before | {"images": 77}))
    assert measure(weights, cloth_dataset, out)["images"] == 77
    assert measure(weights, cloth_dataset, out, overwrite=True) == before
    out.write_text("damaged")
    assert measure(weights, cloth_dataset, out) == before


@pytest.fixture
def partly_absent(cloth_dataset: Path) -> Dataset:
    """Every fifth point is hidden, the last image shows another textile, and the one before it a mug."""
    data = load_dataset(cloth_dataset)
    labels = data.labels.assign(present=[True] * 4 + [False] * 2, things=["mug"] * 5 + ["textile"])
    data = dataclasses.replace(data, labels=labels)
    data.__dict__["visible"] = np.tile(np.arange(625) % 5 != 1, (6, 1))
    return data


def test_a_network_that_knows_has_no_error(partly_absent: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    data = partly_absent
    network = build_network("lite0", 4, heads=True, pretrained=False)
    config = TrainConfig(input_px=64, descriptor_dim=4, heads=True)
    matcher = Matcher(network, config, modes=4, size=(485, 485), device="cpu")

    def describe(matcher: Matcher, data: Dataset, indices: np.ndarray) -> dict[int, Outputs]:
        masks = [torch.from_numpy(20.0 * data.load_mask(i) - 10) for i in indices]
        return {int(i): Outputs(torch.full((1, 2, 2), float(i)), mask, None, torch.tensor(float(data.present[i])))
                for i, mask in zip(indices, masks, strict=True)}  # fmt: skip

    def read_modes(_: Matcher, first: Outputs, second: Outputs, xy: torch.Tensor, *__: object) -> tuple:
        source = data.xy[int(first.descriptors.flatten()[0])]
        points = [int(np.linalg.norm(source - pixel, axis=1).argmin()) for pixel in xy.numpy()]
        orbits = data.group("c4").permutations[:, points].T[:, ::-1].copy()
        return SimpleNamespace(modes=torch.from_numpy(data.xy[int(second.descriptors.flatten()[0])][orbits])), None

    def see(_: Outputs, second: Outputs, xy: torch.Tensor, modes: torch.Tensor, __: object) -> torch.Tensor:
        true = data.xy[int(second.descriptors.flatten()[0])]
        return torch.from_numpy(np.array([[float(np.linalg.norm(true - m, axis=1).argmin() % 5 != 1) for m in row]
                                          for row in modes.numpy()]))  # fmt: skip

    monkeypatch.setattr(heads, "describe", describe)
    monkeypatch.setattr(heads, "read_modes", read_modes)
    monkeypatch.setattr(matcher, "compute_visible", see)
    found = measure_heads(matcher, data, CONFIG)
    assert 0.95 < found.pop("auroc_on_object") < 1  # a pixel just beside the object counts as on it
    assert found == dict.fromkeys(set(MEASURES) - {"auroc_on_object"}, 1.0)
