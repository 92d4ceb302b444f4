"""What a step of training minimises beside the method's own loss."""

from __future__ import annotations

import torch
from torch import Tensor

from mmgsd.augmentation import Batch
from mmgsd.heads import (
    ELSEWHERE,
    JITTER_PX,
    SHARES,
    Heads,
    Outputs,
    compute_judge_loss,
    compute_mask_loss,
    compute_present_loss,
)
from mmgsd.network import sample_descriptors

JUDGED = 24  # source points of each image that are judged in another


def compute_head_loss(
    heads: Heads, said: Outputs, batch: Batch, permutations: Tensor, size: tuple[int, int], generator: torch.Generator
) -> Tensor:
    """Weighted sum of the heads' losses on a batch of B images; ``permutations`` (G, P), ``size`` (width, height) px.

    Every image's points are judged in the next image of the batch, at their true matches, moved a little, and at random
    places. The descriptors are given to the judge as they are: its gradients do not reach them.
    """
    losses = {
        "mask": compute_mask_loss(said.mask, batch.mask.float()),
        "present": compute_present_loss(said.present, batch.mask.flatten(1).any(1) | batch.inside.any(1)),
        "judge": _compute_judge_loss(heads, said, batch, permutations, size, generator),
    }
    return sum(SHARES[name] * loss for name, loss in losses.items())


def _compute_judge_loss(
    heads: Heads, said: Outputs, batch: Batch, permutations: Tensor, size: tuple[int, int], generator: torch.Generator
) -> Tensor:
    images, dim = len(batch.image), said.descriptors.shape[1] // heads.roles
    points = torch.multinomial(batch.askable.float() + 1e-9, JUDGED, True, generator=generator)  # (B, Q)
    rows = torch.arange(images, device=points.device)
    known = batch.askable[rows[:, None], points]  # (B, Q)
    asked = sample_descriptors(said.descriptors.detach(), batch.xy[rows[:, None], points], size)[..., :dim]
    target = rows.roll(1)  # image whose places are judged, of each source
    orbit = permutations[:, points].permute(1, 2, 0)  # (B, Q, G)
    modes, other = batch.xy[target[:, None, None], orbit], batch.askable[target[:, None, None], orbit]
    seen = torch.cat([other, other.new_zeros(*other.shape[:2], ELSEWHERE)], -1)
    valid = torch.cat([batch.inside[target[:, None, None], orbit], other.new_ones(*other.shape[:2], ELSEWHERE)], -1)
    places = _draw_places(modes, size, generator)  # (B, Q, G + ELSEWHERE, 2)
    there = torch.cat([said.descriptors.detach(), said.surface], 1)[target]
    there = sample_descriptors(there, places.flatten(1, 2), size).view(*places.shape[:3], -1)
    channels = said.descriptors.shape[1]
    logits = heads.judge(asked[:, :, None], there[..., :channels], there[..., channels:])
    return compute_judge_loss(logits, seen, valid & known[..., None])


def _draw_places(modes: Tensor, size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """(B, Q, G, 2) px of matches, moved a little, and then places anywhere in the image."""
    moved = modes + JITTER_PX * torch.randn(modes.shape, generator=generator, device=modes.device)
    shape = (*modes.shape[:2], ELSEWHERE, 2)
    anywhere = torch.rand(shape, generator=generator, device=modes.device) * modes.new_tensor(size) - 0.5
    return torch.cat([moved, anywhere], 2)
