"""Weights: what a file must hold to answer, and what is said of one that does not."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from heatmaps import SIZE
from safetensors.torch import save_file

from mmgsd.config import TrainConfig
from mmgsd.match.matcher import Matcher, load
from mmgsd.model.network import build_network
from mmgsd.paths import find_root

CONFIG = TrainConfig(input_px=64, descriptor_dim=8)


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    """An untrained network: what comes out means nothing, and has the promised form."""
    torch.manual_seed(0)
    return Matcher(build_network("lite0", 8, pretrained=False), CONFIG, modes=4, size=SIZE, device="cpu")


@pytest.fixture
def image(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)


def save_weights(path: Path, network: torch.nn.Module, **metadata: str | None) -> Path:
    stored = {"format": "mmgsd-1", "config": json.dumps(dataclasses.asdict(CONFIG)), "modes": "4", "size": "[485, 485]"}
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    save_file(tensors, path, {k: v for k, v in {**stored, **metadata}.items() if v is not None})
    return path


def test_saved_weights_give_the_same_answer(matcher: Matcher, image: np.ndarray, tmp_path: Path) -> None:
    loaded = Matcher.load(save_weights(tmp_path / "w.safetensors", matcher.network), device="cpu")
    one, two = (m.match(image, image[::-1], xy=[(50, 60)]).modes for m in (matcher, loaded))
    np.testing.assert_array_equal(one, two)
    assert (loaded.config, loaded.num_modes, loaded.size) == (CONFIG, 4, SIZE)


def test_missing_weights(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="none.safetensors does not exist"):
        Matcher.load(tmp_path / "none.safetensors")


@pytest.mark.parametrize("kept", [0, 5, 1000, -100])
def test_truncated_weights(matcher: Matcher, tmp_path: Path, kept: int) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match="w.safetensors is truncated"):
        Matcher.load(path)


def test_foreign_weights(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match="foreign.safetensors holds no"):
        Matcher.load(tmp_path / "foreign.safetensors")


@pytest.mark.parametrize("changed", [{"network": "resnet34"}, {"descriptor_dim": 9}])
def test_weights_of_another_network(matcher: Matcher, tmp_path: Path, changed: dict) -> None:
    config = json.dumps(dataclasses.asdict(dataclasses.replace(CONFIG, **changed)))
    path = save_weights(tmp_path / "w.safetensors", matcher.network, config=config)
    with pytest.raises(ValueError, match="w.safetensors does not fit the network"):
        Matcher.load(path)


def test_weights_carry_their_temperature(matcher: Matcher, image: np.ndarray, tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network, temperature="2.5")
    assert (Matcher.load(path, device="cpu").temperature, matcher.temperature) == (2.5, 1.0)
    calm, sure = (m.match(image, image[::-1], xy=[(50, 60)]) for m in (Matcher.load(path, device="cpu"), matcher))
    np.testing.assert_allclose(calm.cells, sure.cells**0.4 / (sure.cells**0.4).sum(), rtol=1e-3)


STORED = dataclasses.asdict(CONFIG)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("config", None, "lacks 'config', which must be a JSON object"),
        ("config", "{", "'config' of its metadata must be a JSON object, .*got '{'"),
        ("config", json.dumps({**STORED, "towel": 1}), "of 'config' in its metadata, a key of TrainConfig must be"),
        ("config", json.dumps({**STORED, "input_px": "x"}), "of 'config' in its metadata, input_px must be int"),
        ("config", json.dumps({**STORED, "input_px": 10**6}), "input_px must be at most 8192, got 1000000"),
        ("modes", None, "lacks 'modes', which must be an integer"),
        ("modes", "four", "'modes' of its metadata must be an integer from 1 on, got 'four'"),
        ("modes", "0", "of its metadata, modes must be an integer from 1 to 64, got 0"),
        ("size", None, r"lacks 'size', which must be \[width, height\] px"),
        ("size", "485", r"'size' of its metadata must be \[width, height\] px, got '485'"),
        ("size", "[485, -5]", "size must be .*, got .485, -5."),
        ("temperature", "warm", "'temperature' of its metadata must be a number greater than 0, got 'warm'"),
        ("temperature", "nan", "temperature must be finite and greater than 0, got nan"),
        ("power", "strong", "'power' of its metadata must be a number of at least 1, got 'strong'"),
        ("sharpness", "nan", "'sharpness' of its metadata must be a number of at least 1, got 'nan'"),
        ("shrinkage", "1.5", "'shrinkage' of its metadata must be a number from 0 to 1, got '1.5'"),
        ("shrinkage", "nan", "'shrinkage' of its metadata must be a number from 0 to 1, got 'nan'"),
        ("bandwidth", "-0.5", "bandwidth must be finite and greater than 0, got -0.5"),
        ("calibration", "{}", "'calibration' of its metadata must be what .*calibrate"),
        ("format", None, "holds no mmgsd weights: its metadata says format None"),
    ],
)
def test_damaged_metadata_are_named(
    matcher: Matcher, tmp_path: Path, key: str, value: str | None, message: str
) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network, **{key: value})
    with pytest.raises(ValueError, match=rf"w\.safetensors.*{message}"):
        Matcher.load(path)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_weights_that_are_not_finite(matcher: Matcher, tmp_path: Path, bad: float) -> None:
    network = build_network("lite0", 8, pretrained=False)
    network.head.bias.data[3] = bad
    path = save_weights(tmp_path / "w.safetensors", network)
    with pytest.raises(ValueError, match=r"w\.safetensors is damaged"):
        Matcher.load(path)


def test_a_pickle_is_no_safetensors(matcher: Matcher, tmp_path: Path) -> None:
    torch.save(matcher.network.state_dict(), tmp_path / "w.pth")
    with pytest.raises(ValueError, match=r"w\.pth is a pickle, as PyTorch writes"):
        Matcher.load(tmp_path / "w.pth")


@pytest.mark.parametrize("read", [load, Matcher.load])
def test_a_folder_is_no_file(tmp_path: Path, read: object) -> None:
    with pytest.raises(ValueError, match=f"{tmp_path.name} is a folder"):
        read(tmp_path)


def test_a_name_that_cannot_be_read_is_not_called_damage(matcher: Matcher, tmp_path: Path) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network)
    with pytest.raises(ValueError, match="must have a name in UTF-8"):
        load(path.rename(tmp_path / os.fsdecode(b"caf\xe9.safetensors")))


def test_a_pipe_is_no_file_of_weights(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # to be opened, it would wait for who writes into it
    with pytest.raises(ValueError, match="pipe is no"):
        load(tmp_path / "pipe")


def test_a_file_that_may_not_be_read(matcher: Matcher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_weights(tmp_path / "w.safetensors", matcher.network)

    def refuse(file: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(file))

    monkeypatch.setattr("builtins.open", refuse)
    with pytest.raises(PermissionError, match=r"w\.safetensors"):
        Matcher.load(path)


@pytest.mark.parametrize("name", ["cloth", "rope", "cloth-paper", "rope-paper", "cloth-spcl", "rope-spcl"])
def test_the_shipped_weights_load(name: str) -> None:
    matcher = load(name, device="cpu")
    assert matcher.object == matcher.config.object == name.split("-")[0]
    assert (find_root() / "data" / "weights" / f"{name}.safetensors").is_file()


def test_a_header_that_begins_as_a_pickle_does_is_no_pickle(matcher: Matcher, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    for spare in range(0, 512, 8):  # the header's length, of whose bytes the first is the file's first
        save_weights(path, matcher.network, spare="x" * spare)
        if path.read_bytes()[0] == 0x80:
            break
    assert path.read_bytes()[0] == 0x80
    assert Matcher.load(path, device="cpu").num_modes == matcher.num_modes
