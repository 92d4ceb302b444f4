"""What a step of training minimises: the method's own loss, and that of the heads where there are any."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from mmgsd.config import CONTRASTIVE, TrainConfig
from mmgsd.learn import losses
from mmgsd.learn.augmentation import Batch
from mmgsd.model.heads import Heads, Outputs
from mmgsd.model.network import compute_cell_centres, compute_squared_distances, sample_descriptors

SHARES = {"mask": 1.0, "visibility": 0.5, "presence": 0.2}  # of the heads' losses
JITTER_PX = 6.0  # std by which true matches are moved before their visibility is learnt: modes are never exact
ELSEWHERE = 2  # further places a query that are no match, and so not seen there
VISIBILITY_POINTS = 24  # source points of each image that are looked for in another


def compute_sigma(config: TrainConfig, step: int) -> float:
    """Std of the target at a step in px: geometric from ``sigma_start_px`` to ``sigma_px`` over two thirds."""
    progress = min(1.0, step / max(1.0, config.steps * 2 / 3))
    start = max(config.sigma_start_px, config.sigma_px)
    return start * (config.sigma_px / start) ** progress


def compute_loss(
    config: TrainConfig, descriptors: Tensor, batch: Batch, permutations: Tensor, size: tuple[int, int], step: int,
    group: int = 0,
) -> Tensor:  # fmt: skip
    """The configured method's loss of a group of a batch: every image is a source and a target of others in it.

    ``descriptors`` (B, C, h, w), a source's D first, a target's last; ``permutations`` (G, P) of the matches the method
    knows. Randomness comes from seed, step and the group's number.
    """
    seed = (config.seed * 1_000_003 + step) * config.groups + group
    generator = torch.Generator(descriptors.device).manual_seed(seed)
    pairs = config.pairs // config.groups
    pair = _sample_batch_pairs(len(descriptors), pairs, generator, descriptors.device)  # (2, K)
    points = torch.multinomial(batch.askable[pair[0]].float() + 1e-9, config.queries, True, generator=generator)
    orbit = permutations[:, points].permute(1, 2, 0)  # (K, Q, G)
    target = descriptors[:, -config.descriptor_dim :]  # (B, D, h, w)
    sampled = sample_descriptors(descriptors, batch.xy, size)  # (B, P, C)
    source = sampled[pair[0][:, None], points, : config.descriptor_dim]  # (K, Q, D)
    modes = batch.xy[pair[1][:, None, None], orbit]  # (K, Q, G, 2)
    valid = batch.inside[pair[1][:, None, None], orbit] & batch.askable[pair[0][:, None], points][..., None]
    if config.method in CONTRASTIVE:
        if not config.hidden_matches:  # as in Dense Object Nets: seen in both images
            valid = valid & batch.askable[pair[1][:, None, None], orbit]
        there = sampled[pair[1][:, None, None], orbit, -config.descriptor_dim :]  # (K, Q, G, D)
        match = (source[:, :, None] - there).square().sum(-1)
        distance2, is_non_match = _sample_non_matches(config, target, batch, pair, source, modes, size, generator)
        distances = (match + 1e-12).sqrt(), valid, (distance2 + 1e-12).sqrt(), is_non_match
        return losses.pcl(*distances, margin=config.margin)
    return _compute_mixture_loss(source, target[pair[1]], modes, valid, size, compute_sigma(config, step))


def compute_place_loss(
    config: TrainConfig, descriptors: Tensor, batch: Batch, places: Tensor, permutations: Tensor,
    size: tuple[int, int], step: int,
) -> Tensor:  # fmt: skip
    """The distributional loss of what `Matcher.find` asks: ``places`` (P, D) are the sources, each image a target.

    ``permutations`` (G, P) are of the first P points of the batch; a point counts where it is seen in the image.
    """
    generator = torch.Generator(descriptors.device).manual_seed(config.seed * 1_000_003 + step)
    seen = batch.askable[:, : len(places)]  # (B, P)
    points = torch.multinomial(seen.float() + 1e-9, config.queries, True, generator=generator)  # (B, Q)
    rows, orbit = torch.arange(len(points), device=points.device), permutations[:, points].permute(1, 2, 0)
    modes = batch.xy[rows[:, None, None], orbit]  # (B, Q, G, 2)
    valid = batch.inside[rows[:, None, None], orbit] & seen[rows[:, None], points][..., None]
    target = descriptors[:, -config.descriptor_dim :]  # (B, D, h, w)
    return _compute_mixture_loss(places[points], target, modes, valid, size, compute_sigma(config, step))


def _compute_mixture_loss(
    source: Tensor, target: Tensor, modes: Tensor, valid: Tensor, size: tuple[int, int], sigma_px: float
) -> Tensor:
    """Of sources (K, Q, D) in images with ``target`` (K, D, h, w), whose true matches are ``modes`` (K, Q, G, 2)."""
    xs, ys = (c.to(target.device) for c in compute_cell_centres(size, target.shape[-2:]))
    wanted = losses.compute_target(modes, valid, xs, ys, sigma_px)
    return losses.mmgsd(compute_squared_distances(source, target.flatten(2).mT), wanted)


def compute_head_loss(
    heads: Heads, outputs: Outputs, batch: Batch, permutations: Tensor, size: tuple[int, int],
    generator: torch.Generator,
) -> Tensor:  # fmt: skip
    """Weighted sum of the heads' losses on a batch of B images; ``permutations`` (G, P), ``size`` (width, height) px.

    Every image's points are looked for in the next image of the batch, at their true matches, moved a little, and at
    random places. The descriptors are given to the visibility head as they are: its gradients do not reach them.
    """
    mask = losses.compute_mask_loss(outputs.mask, batch.mask.float())
    presence = losses.compute_presence_loss(outputs.presence, batch.mask.flatten(1).any(1) | batch.inside.any(1))
    visibility = _compute_visibility_loss(heads, outputs, batch, permutations, size, generator)
    return SHARES["mask"] * mask + SHARES["presence"] * presence + SHARES["visibility"] * visibility


def _compute_visibility_loss(
    heads: Heads, outputs: Outputs, batch: Batch, permutations: Tensor, size: tuple[int, int],
    generator: torch.Generator,
) -> Tensor:  # fmt: skip
    images, dim = len(batch.image), outputs.descriptors.shape[1] // heads.roles
    points = torch.multinomial(batch.askable.float() + 1e-9, VISIBILITY_POINTS, True, generator=generator)  # (B, Q)
    rows = torch.arange(images, device=points.device)
    askable = batch.askable[rows[:, None], points]  # (B, Q)
    source = sample_descriptors(outputs.descriptors.detach(), batch.xy[rows[:, None], points], size)[..., :dim]
    target = rows.roll(1)  # image whose places are looked at, of each source
    orbit = permutations[:, points].permute(1, 2, 0)  # (B, Q, G)
    modes, other = batch.xy[target[:, None, None], orbit], batch.askable[target[:, None, None], orbit]
    seen = torch.cat([other, other.new_zeros(*other.shape[:2], ELSEWHERE)], -1)
    valid = torch.cat([batch.inside[target[:, None, None], orbit], other.new_ones(*other.shape[:2], ELSEWHERE)], -1)
    places = _draw_places(modes, size, generator)  # (B, Q, G + ELSEWHERE, 2)
    there = torch.cat([outputs.descriptors.detach(), outputs.surface], 1)[target]
    there = sample_descriptors(there, places.flatten(1, 2), size).view(*places.shape[:3], -1)
    channels = outputs.descriptors.shape[1]
    logits = heads.visibility(source[:, :, None], there[..., :channels], there[..., channels:])
    return losses.compute_visibility_loss(logits, seen, valid & askable[..., None])


def _draw_places(modes: Tensor, size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """(B, Q, G, 2) px of matches, moved a little, and then places anywhere in the image."""
    moved = modes + JITTER_PX * torch.randn(modes.shape, generator=generator, device=modes.device, dtype=modes.dtype)
    shape = (*modes.shape[:2], ELSEWHERE, 2)
    anywhere = torch.rand(shape, generator=generator, device=modes.device, dtype=modes.dtype)
    return torch.cat([moved, anywhere * modes.new_tensor(size) - 0.5], 2)


def _sample_batch_pairs(images: int, pairs: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """(2, K) different images, all ordered pairs where no more are asked for."""
    ordered = (~torch.eye(images, dtype=torch.bool, device=device)).nonzero()  # (B (B - 1), 2)
    picked = torch.randperm(len(ordered), generator=generator, device=device)[:pairs]
    return ordered[picked].T


def _sample_non_matches(
    config: TrainConfig, target: Tensor, batch: Batch, pair: Tensor, source: Tensor, modes: Tensor,
    size: tuple[int, int], generator: torch.Generator,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Squared distances (K, Q, N) to random places, half on the object and half off it, and which are no match.

    Places, not the centres of cells: a match lies between cells, and an interpolated descriptor is the mean of four,
    nearer to any other. Were only the matches interpolated, a network would learn that instead: a chequered grid.
    """
    (k, q, _), (height, width) = source.shape, target.shape[-2:]
    on_object = F.adaptive_avg_pool2d(batch.mask.float()[:, None], (height, width))[pair[1], 0].flatten(1)  # (K, C)
    half = config.non_matches // 2
    drawn = [
        torch.multinomial(weight + 1e-6, q * count, True, generator=generator).view(k, q, count)
        for weight, count in ((on_object, half), (1 - on_object, config.non_matches - half))
    ]
    cell = torch.cat(drawn, -1)  # (K, Q, N)
    corner = torch.stack([cell % width, cell // width], -1)  # (K, Q, N, 2)
    cells = torch.tensor([width, height], device=cell.device)
    pixels = modes.new_tensor(size) / cells  # of a cell
    within = torch.rand(corner.shape, generator=generator, device=cell.device, dtype=modes.dtype)
    position = (corner + within) * pixels - 0.5  # (K, Q, N, 2)
    picked = sample_descriptors(target[pair[1]], position.flatten(1, 2), size).view(k, q, -1, config.descriptor_dim)
    gap = (position[:, :, :, None] - modes[:, :, None]).square().sum(-1).amin(-1)  # (K, Q, N)
    return (picked - source[:, :, None]).square().sum(-1), gap > (1.5 * float(pixels[0])) ** 2
