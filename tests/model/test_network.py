"""Networks: the shapes they give, the names they bear, and how their grid of descriptors maps to pixels."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from mmgsd.config import DETAILED, NETWORKS
from mmgsd.model import network as networks
from mmgsd.model.network import (
    ResNet34Trunk,
    build_network,
    compute_cell_centres,
    compute_input_size,
    compute_squared_distances,
    fit_input_size,
    sample_descriptors,
)

BATCH_NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")


def list_resnet34_keys() -> set[str]:
    """torchvision's names for ResNet-34, without the classifier's two."""
    keys = {"conv1.weight"} | {f"bn1.{name}" for name in BATCH_NORM}
    for stage, blocks in enumerate((3, 4, 6, 3), start=1):
        for block in range(blocks):
            for layer in (1, 2):
                keys.add(f"layer{stage}.{block}.conv{layer}.weight")
                keys |= {f"layer{stage}.{block}.bn{layer}.{name}" for name in BATCH_NORM}
        if stage > 1:
            keys.add(f"layer{stage}.0.downsample.0.weight")
            keys |= {f"layer{stage}.0.downsample.1.{name}" for name in BATCH_NORM}
    return keys


def test_resnet34_has_torchvisions_names_and_shapes() -> None:
    state = ResNet34Trunk().state_dict()
    assert len(state) == 216 and set(state) == list_resnet34_keys()
    assert sum(v.numel() for k, v in state.items() if k.endswith((".weight", ".bias"))) == 21_797_672 - 513_000
    assert state["layer4.0.downsample.0.weight"].shape == (512, 256, 1, 1)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (64, 96), (61, 75)])
@pytest.mark.parametrize("roles", [1, 2])
@pytest.mark.parametrize("name", NETWORKS)
def test_output_shape(name: str, roles: int, height: int, width: int) -> None:
    network = build_network(name, 5, roles=roles, pretrained=False).eval()
    height, width = (side * (2 if name in DETAILED else 1) for side in (height, width))
    with torch.no_grad():
        descriptors = network(torch.rand(2, 3, height, width))
    assert descriptors.shape == (2, 5 * roles, height // network.stride, width // network.stride)
    assert descriptors.dtype == torch.float32


@pytest.mark.parametrize("name", NETWORKS)
def test_every_used_parameter_gets_a_gradient(name: str) -> None:
    network = build_network(name, 4, pretrained=False)
    network(torch.rand(2, 3, 64, 64)).square().sum().backward()
    assert [n for n, p in network.named_parameters() if p.grad is None] == []


@pytest.mark.parametrize(("old", "new"), [("lite0", "lite0x2"), ("lite0x2", "lite0x2fine"), ("lite0", "lite0x2fine")])
def test_what_is_put_onto_a_trained_network_hardly_changes_its_answers(old: str, new: str) -> None:
    torch.manual_seed(0)
    trained = build_network(old, 4, roles=2).eval()
    deeper = build_network(new, 4, roles=2, pretrained=False).eval()
    deeper.start_from(trained)
    image = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        before, after = trained(image), deeper(torch.nn.functional.interpolate(image, scale_factor=deeper.stride // 4))
    gap = (after - before).std() / before.std()
    assert 0 < gap < 0.2
    assert all(torch.equal(deeper.state_dict()[name], value) for name, value in trained.state_dict().items())


def test_detail_sees_what_the_trunk_cannot() -> None:
    torch.manual_seed(0)
    chequered = (torch.arange(64)[:, None] + torch.arange(64)) % 2 * torch.ones(1, 3, 1, 1)
    grey = torch.full((1, 3, 64, 64), 0.5)
    coarse, detailed = (build_network(name, 4, pretrained=False).eval() for name in ("lite0x2", "lite0x2fine"))
    with torch.no_grad():
        halves = [coarse(torch.nn.functional.avg_pool2d(image, 2)) for image in (chequered, grey)]
        wholes = [detailed(image) for image in (chequered, grey)]
    assert torch.equal(*halves) and not torch.allclose(*wholes, rtol=1e-3)


def write_torchvision_weights(path: Path) -> dict[str, Tensor]:
    """A file as torchvision's: the trunk, and a classifier that is not used."""
    torch.manual_seed(3)
    state = {**ResNet34Trunk().state_dict(), "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}
    save_file(state, path)
    return state


def test_imagenet_weights_load_from_a_file_and_the_classifier_is_left_out(tmp_path: Path) -> None:
    state = write_torchvision_weights(tmp_path / "resnet34.safetensors")
    network = build_network("resnet34", 3, trunk_weights=tmp_path / "resnet34.safetensors")
    assert all(torch.equal(value, state[name]) for name, value in network.trunk.state_dict().items())


def test_weights_of_something_else_are_named(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    with pytest.raises(FileNotFoundError, match=r"w\.safetensors does not exist"):
        build_network("resnet34", 3, trunk_weights=path)
    state = write_torchvision_weights(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ValueError, match="truncated or no safetensors"):
        build_network("resnet34", 3, trunk_weights=path)
    save_file({name: value for name, value in state.items() if "layer4" not in name}, path)
    with pytest.raises(ValueError, match="does not hold torchvision's ResNet-34"):
        build_network("resnet34", 3, trunk_weights=path)


def test_unknown_network() -> None:
    with pytest.raises(ValueError, match="network must .*got 'vgg'"):
        build_network("vgg", 3)


@pytest.mark.parametrize(
    ("size", "input_px", "expected"),
    [
        ((485, 485), 128, (128, 128)),
        ((640, 480), 160, (160, 120)),
        ((640, 480), 64, (64, 48)),
        ((900, 20), 64, (64, 16)),
    ],
)
def test_input_size(size: tuple[int, int], input_px: int, expected: tuple[int, int]) -> None:
    assert compute_input_size(size, input_px) == expected


@pytest.mark.parametrize(
    ("size", "trained", "expected"),
    [
        ((970, 970), (485, 485), (128, 128)),
        ((1280, 960), (640, 480), (128, 96)),
        ((485, 364), (485, 485), (144, 112)),
        ((364, 485), (485, 485), (112, 144)),
        ((480, 640), (640, 480), (96, 128)),
        ((4800, 300), (485, 485), (768, 48)),
        ((900, 20), (900, 20), (128, 16)),  # what was taught stays what it is
    ],
)
def test_an_input_has_the_images_own_aspect(
    size: tuple[int, int], trained: tuple[int, int], expected: tuple[int, int]
) -> None:
    assert fit_input_size(size, trained, 128) == expected


def test_cell_centres() -> None:
    xs, ys = compute_cell_centres((8, 6), (3, 4))  # cells of 2 x 2 px
    assert xs.tolist() == [0.5, 2.5, 4.5, 6.5]
    assert ys.tolist() == [0.5, 2.5, 4.5]


def test_descriptors_at_cell_centres_are_the_cells() -> None:
    grid = torch.arange(12.0).view(1, 1, 3, 4)
    xs, ys = compute_cell_centres((485, 300), (3, 4))
    xy = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).view(1, -1, 2)
    torch.testing.assert_close(sample_descriptors(grid, xy, (485, 300)), grid.view(1, 12, 1), rtol=0, atol=1e-4)


def test_descriptors_between_cells_are_bilinear() -> None:
    grid = torch.tensor([[[[0.0, 4.0], [8.0, 16.0]]]])  # cells of 2 x 2 px, centres at 0.5 and 2.5
    xy = torch.tensor([[[1.0, 1.5], [1.5, 1.5], [0.5, 2.0]]])
    # (1, 1.5): a quarter across, half down: 0.5 * (0.75 * 0 + 0.25 * 4) + 0.5 * (0.75 * 8 + 0.25 * 16) = 5.5
    torch.testing.assert_close(sample_descriptors(grid, xy, (4, 4)), torch.tensor([[[5.5], [7.0], [6.0]]]))


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_squared_distances_are_cdists(generator: torch.Generator) -> None:
    source, target = (torch.randn(3, n, 8, generator=generator, dtype=torch.float64) for n in (5, 7))
    torch.testing.assert_close(compute_squared_distances(source, target), torch.cdist(source, target) ** 2)


def test_squared_distances_are_never_negative(generator: torch.Generator) -> None:
    same = 100 + torch.randn(1, 50, 16, generator=generator)
    assert compute_squared_distances(same, same).min() >= 0


def test_squared_distances_gradient(generator: torch.Generator) -> None:
    given = [torch.randn(2, n, 3, generator=generator, dtype=torch.float64, requires_grad=True) for n in (3, 4)]
    assert torch.autograd.gradcheck(compute_squared_distances, given)


def pretend_bfloat16(monkeypatch: pytest.MonkeyPatch, *, there: bool) -> None:
    """A CPU with instructions for bfloat16, or without."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: there)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)


@pytest.mark.parametrize(
    ("threads", "bfloat16", "said"),
    [(8, True, "CPU, 8 cores"), (1, True, "CPU, 1 of 8 cores"), (1, False, "CPU without bfloat16, 1 of 8 cores")],
)
def test_the_hardware_is_what_was_used_of_it(
    monkeypatch: pytest.MonkeyPatch, threads: int, bfloat16: bool, said: str
) -> None:
    monkeypatch.setattr(networks.os, "cpu_count", lambda: 8)
    monkeypatch.setattr(networks.torch, "get_num_threads", lambda: threads)
    pretend_bfloat16(monkeypatch, there=bfloat16)
    assert networks.name_hardware(torch.device("cpu")) == said


def test_a_cpu_without_bfloat16_computes_in_float32(
    monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    network, image = networks.PyramidNetwork(4, pretrained=False).eval(), torch.rand(1, 3, 64, 64, generator=generator)

    def describe(*, there: bool, reduced: bool) -> torch.Tensor:
        """Descriptors on a CPU with bfloat16 or without, where the network may take it or not."""
        pretend_bfloat16(monkeypatch, there=there)
        network.reduced_precision = reduced
        return network(image)

    exact = describe(there=True, reduced=False)
    assert torch.equal(exact, describe(there=False, reduced=True))
    assert not torch.equal(exact, describe(there=True, reduced=True))


@pytest.mark.parametrize("ampere", [False, True])
def test_a_gpu_that_emulates_bfloat16_has_none(monkeypatch: pytest.MonkeyPatch, ampere: bool) -> None:
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation or ampere)
    assert networks.has_bfloat16(torch.device("cuda", 1)) == ampere
    assert not networks.has_bfloat16(torch.device("mps"))  # nothing is known of it
