"""What a network returns beside its descriptors: where the object is, whether it is there at all, and whether a match
is seen at a place or hidden.

All of it is read from the descriptors' own features and learnt from labels that every data set has: masks, visibility
of the material points, and images without the object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

SURFACE = 16  # numbers that describe a place's surface to the visibility head: a fold, an edge, something in front?
HIDDEN = 64  # units of the visibility head
BESIDE = 1 / 64  # of an image's longer side: so near to the object a pixel is taken for one on it
LOOKED_UP = 128  # cells of the longer side that a mask is reduced to before
ELSEWHERE_WEIGHT = 0.02  # of a heatmap's mass off the object, where the network itself says what is off it


@dataclass(frozen=True)
class Outputs:
    """What a network returns for B images, or without the first axis for one; only ``descriptors`` without heads."""

    descriptors: Tensor  # (B, C, h, w)
    mask: Tensor | None = None  # (B, hm, wm) logits: is the object seen here?
    surface: Tensor | None = None  # (B, SURFACE, h, w) for `Heads.visibility`
    presence: Tensor | None = None  # (B,) logits: is the object in the image?

    def turn(self, quarters: int) -> Outputs:
        """The same of images turned by so many quarters."""
        planes = {name: getattr(self, name) for name in ("descriptors", "mask", "surface")}
        return replace(self, **{n: None if x is None else x.rot90(quarters, (-2, -1)) for n, x in planes.items()})

    def split(self) -> list[Outputs]:
        """Of each image by itself."""
        names = [field.name for field in fields(self) if getattr(self, field.name) is not None]
        parts = zip(*(getattr(self, name) for name in names), strict=True)
        return [Outputs(**dict(zip(names, part, strict=True))) for part in parts]

    @staticmethod
    def mean(several: Sequence[Outputs]) -> Outputs:
        """The mean over several outputs for the same images."""
        names = [field.name for field in fields(Outputs) if getattr(several[0], field.name) is not None]
        return Outputs(**{name: sum(getattr(one, name) for one in several) / len(several) for name in names})


class Heads(nn.Module):
    """Three light heads; ``widths`` are the channels of the finer features that sharpen the mask, coarsest first."""

    def __init__(self, width: int, descriptor_dim: int, roles: int, widths: Sequence[int] = ()) -> None:
        super().__init__()
        sizes = [width // 2, *widths]
        self.enter = nn.Conv2d(width, sizes[0], 1)
        self.sharpen = nn.ModuleList(conv_block(a, b) for a, b in zip(sizes, [*sizes[1:], sizes[-1]], strict=True))
        self.mask = nn.Conv2d(sizes[-1], 1, 1)
        self.surface = nn.Conv2d(width, SURFACE, 1)
        self.present = nn.Linear(2 * width, 1)
        self.roles, inputs = roles, roles * (descriptor_dim + 1) + SURFACE
        self.judge_layers = nn.Sequential(nn.Linear(inputs, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))

    def forward(self, features: Tensor, coarse: Tensor, finer: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Mask logits (B, hm, wm), surfaces (B, SURFACE, h, w) and presence logits (B,).

        From features (B, width, h, w), the pyramid's coarsest level ``coarse`` and ``finer`` features, finest last.
        """
        x = self.sharpen[0](self.enter(features))
        for block, finer_one in zip(self.sharpen[1:], finer, strict=True):
            x = block(F.interpolate(x, finer_one.shape[-2:], mode="bilinear", align_corners=False) + finer_one)
        pooled = torch.cat([coarse.mean((2, 3)), coarse.amax((2, 3))], 1)
        return self.mask(x)[:, 0].float(), self.surface(features).float(), self.present(pooled)[:, 0].float()

    def visibility(self, source: Tensor, there: Tensor, surface: Tensor) -> Tensor:
        """Logits (...) that the surface of the pixel asked about is seen at a place.

        ``source`` (..., D) is its descriptor, ``there`` (..., roles D) what the place has, ``surface``
        (..., SURFACE). A place shows what its own descriptor as a source says: it need not be what hides below it.
        """
        differences = [source - role for role in there.chunk(self.roles, -1)]
        near = [difference.square().sum(-1, keepdim=True).clamp(max=50) / 10 for difference in differences]
        return self.judge_layers(torch.cat([*differences, *near, surface], -1))[..., 0]


def weigh_cells(outputs: Outputs, shape: tuple[int, int], mask: Tensor | None = None) -> Tensor | None:
    """How much a match may lie in each cell (h, w) of a heatmap, in [0, 1]; None where nothing is known of the object.

    1 at the object and beside it, for masks are not exact and a hidden point may lie a little aside. Elsewhere nothing
    under a ``mask`` (H, W) bool of the caller's, and `ELSEWHERE_WEIGHT` under the network's own, which may be wrong.
    """
    if mask is None and outputs.mask is None:
        return None
    probability = outputs.mask.sigmoid() if mask is None else mask.to(outputs.descriptors.device).float()
    cells = F.adaptive_max_pool2d(probability[None, None], tuple(shape))
    cells = F.max_pool2d(cells, 3, 1, 1)[0, 0]
    return cells if mask is not None else cells.clamp(min=ELSEWHERE_WEIGHT)


def look_up(mask: np.ndarray | None, logits: Tensor | None, xy: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """How likely the object is seen at pixels ``xy`` (S, 2) of an image of ``size``, (S,) in [0, 1].

    By the caller's ``mask`` (H, W) bool or else mask ``logits`` (hm, wm); None without either. A corner lies on the
    object's border, and a click or a mark beside it: the likeliest place within `BESIDE` counts.
    """
    if mask is None and logits is None:
        return None
    probability = (logits.sigmoid() if mask is None else torch.from_numpy(mask).float())[None, None]
    coarse = [math.ceil(side * min(1, LOOKED_UP / max(probability.shape))) for side in probability.shape[2:]]
    reach = max(1, round(BESIDE * max(coarse)))
    probability = F.max_pool2d(F.adaptive_max_pool2d(probability, coarse), 2 * reach + 1, 1, reach)
    grid = (torch.from_numpy(xy).to(probability.device).float() + 0.5) / probability.new_tensor(size) * 2 - 1
    sampled = F.grid_sample(probability, grid[None, None], padding_mode="border", align_corners=False)
    return sampled[0, 0, 0].cpu().numpy()


def conv_block(inputs: int, outputs: int, *, stride: int = 1) -> nn.Sequential:
    """A 3 x 3 convolution with batch normalisation."""
    convolution = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
