"""What a network says beside its descriptors, and the losses that teach it: where the object is, whether it is there at
all, and whether a match is seen at a place or hidden.

All of it is read from the descriptors' own features and learnt from labels that every data set has: masks, visibility
of the material points, and images without the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SURFACE = 16  # numbers that describe a place's surface to the judge: is it a fold, an edge, something in front?
HIDDEN = 64  # units of the judge
JITTER_PX = 6.0  # std by which true matches are moved before they are judged: modes are never exact
ELSEWHERE = 2  # further places a query that are no match, and so not seen there
SHARES = {"mask": 1.0, "judge": 0.5, "present": 0.2}  # of the losses


@dataclass(frozen=True)
class Outputs:
    """What a network says of B images; only ``descriptors`` of one without heads."""

    descriptors: Tensor  # (B, C, h, w)
    mask: Tensor | None = None  # (B, hm, wm) logits: is the object seen here?
    surface: Tensor | None = None  # (B, SURFACE, h, w) for `Heads.judge`
    present: Tensor | None = None  # (B,) logits: is the object in the image?


class Heads(nn.Module):
    """Three light heads; ``widths`` are the channels of the finer features that sharpen the mask, coarsest first."""

    def __init__(self, width: int, descriptor_dim: int, roles: int, widths: Sequence[int] = ()) -> None:
        super().__init__()
        sizes = [width // 2, *widths]
        self.enter = nn.Conv2d(width, sizes[0], 1)
        self.sharpen = nn.ModuleList(_conv_block(a, b) for a, b in zip(sizes, [*sizes[1:], sizes[-1]], strict=True))
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

    def judge(self, asked: Tensor, there: Tensor, surface: Tensor) -> Tensor:
        """Logits (...) that the surface of the pixel asked about is seen at a place.

        ``asked`` (..., D) is its descriptor as a source, ``there`` (..., roles D) what the place has, ``surface``
        (..., SURFACE). A place shows what its own descriptor as a source says: it need not be what hides below it.
        """
        apart = [asked - role for role in there.chunk(self.roles, -1)]
        near = [difference.square().sum(-1, keepdim=True).clamp(max=50) / 10 for difference in apart]
        return self.judge_layers(torch.cat([*apart, *near, surface], -1))[..., 0]


def compute_mask_loss(logits: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy of mask logits (B, hm, wm) with masks (B, h, w) in [0, 1], averaged over the logits' cells."""
    target = F.interpolate(mask[:, None], logits.shape[-2:], mode="area")[:, 0]
    return F.binary_cross_entropy_with_logits(logits, target)


def compute_present_loss(logits: Tensor, present: Tensor) -> Tensor:
    """Cross-entropy of presence logits (B,) with (B,) bool; the few images without the object count ten times."""
    weight = torch.where(present, 1.0, 10.0)
    return F.binary_cross_entropy_with_logits(logits, present.float(), weight)


def compute_judge_loss(logits: Tensor, seen: Tensor, counted: Tensor) -> Tensor:
    """Cross-entropy of the judge's logits (...) with ``seen`` (...) bool, over those ``counted`` (...) bool.

    Seen and unseen places weigh as much as each other.
    """
    loss = F.binary_cross_entropy_with_logits(logits, seen.float(), reduction="none")
    parts = [loss[counted & (seen == truth)] for truth in (True, False)]
    return sum(part.mean() for part in parts if part.numel()) / 2 + 0 * logits.sum()


def _conv_block(inputs: int, outputs: int) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
