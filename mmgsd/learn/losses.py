"""The training losses as pure functions of descriptors, positions and masks.

Shapes: K ordered pairs of images, Q source points a pair, G matches a point (the orbit's size), N non-matches a point,
C cells of the target's descriptor grid, D descriptor dimensions. Positions are in full-image px.

These start slowly, for both descriptors of a pair are unknown. In `compute_prototype_loss`, dense supervision from each
single image, the second image is the object: each visible point is classified among all material points by the distance
to their prototypes, which symmetric points share (continuous surface embeddings, Neverova et al. 2020). Matching never
uses the prototypes.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mmgsd.model.network import compute_squared_distances

IMAGES = 100  # images that the initial prototypes are computed from
SPREAD = 24.0  # mean squared distance of two initial prototypes: exp(-24) is no match
REACH = 0.12  # of the image's diagonal: points nearer than this in the mean are neighbours


def compute_target(modes: Tensor, valid: Tensor, xs: Tensor, ys: Tensor, sigma_px: float) -> Tensor:
    """The n-modal isotropic Gaussian mixture on a grid of cells (paper section "Symmetric Distributional Loss").

    ``modes`` (..., G, 2) px, ``valid`` (..., G) bool, ``xs`` (w,) and ``ys`` (h,) evenly spaced cell centres in px.
    Returns (..., h * w) summing to 1 where any mode is valid, else 0. Every Gaussian is integrated against the cells'
    linear interpolation functions, so a std far below a cell's size keeps its mean exactly.
    """
    across = _integrate_hats(modes[..., 0, None], xs, sigma_px)  # (..., G, w)
    down = _integrate_hats(modes[..., 1, None], ys, sigma_px)  # (..., G, h)
    density = torch.einsum("...gh,...gw->...hw", down * valid[..., None], across).flatten(-2)  # (..., h * w)
    return density / density.sum(-1, keepdim=True).clamp(min=1e-12)


def mmgsd(squared_distances: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy of p = softmax(-distance²) with the mixture ``target``, both (..., C); mean over the queries.

    Queries whose target is 0 (no match in the image) do not count. Paper section "Symmetric Distributional Loss",
    with the sign of its exponent corrected. With one mode in ``target`` it is the unimodal loss (Florence 2020).
    """
    matched = target.sum(-1) > 0
    loss = -(target * torch.log_softmax(-squared_distances, -1)).sum(-1)
    return (loss * matched).sum() / matched.sum().clamp(min=1)


def pcl(
    match_distances: Tensor, matched: Tensor, non_match_distances: Tensor, non_matched: Tensor, *, margin: float = 0.5
) -> Tensor:
    """Pixel-wise contrastive loss (paper section "Preliminaries"), from Euclidean distances.

    ``match_distances`` (..., G) and ``non_match_distances`` (..., N), with boolean masks of the same shapes; of PCL G
    is 1, of SPCL (paper section "SPCL Baseline") the orbit's size. The mean squared distance of the matches, plus the
    mean over the *hard* non-matches (those within the margin) of (margin - distance)², the hard-negative scaling of
    Dense Object Nets.
    """
    match_loss = (match_distances.square() * matched).sum() / matched.sum().clamp(min=1)
    violation = (margin - non_match_distances).clamp(min=0) * non_matched
    return match_loss + violation.square().sum() / (violation > 0).sum().clamp(min=1)


def make_prototypes(xy: np.ndarray, permutations: np.ndarray, dim: int, diagonal: float) -> Tensor:
    """Initial prototypes (P, dim): a kernel PCA of how near the points lie to one another in images.

    ``xy`` (N, P, 2) px, ``permutations`` (G, P), ``diagonal`` of the image in px. Symmetric points get equal rows.
    """
    kernel = np.zeros((xy.shape[1],) * 2)
    for points in xy[np.linspace(0, len(xy) - 1, min(IMAGES, len(xy))).astype(int)].astype(float):
        squared = np.square(points[:, None] - points[None]).sum(-1)
        kernel += np.exp(-squared / (2 * (REACH * diagonal) ** 2))
    kernel = np.mean([kernel[:, g] for g in permutations], axis=0)
    kernel = np.mean([kernel[g] for g in permutations], axis=0)
    kernel -= kernel.mean(0) + kernel.mean(1)[:, None] - kernel.mean()
    values, vectors = np.linalg.eigh((kernel + kernel.T) / 2)
    features = np.zeros((len(kernel), dim))
    rank = min(dim, len(kernel))
    features[:, :rank] = (vectors * np.sqrt(values.clip(min=0)))[:, ::-1][:, :rank]
    features *= np.sqrt(SPREAD / (2 * np.square(features).sum(1).mean() + 1e-12))
    return torch.from_numpy(features.astype(np.float32))


def compute_prototype_loss(descriptors: Tensor, askable: Tensor, prototypes: Tensor, permutations: Tensor) -> Tensor:
    """Cross-entropy of the visible points' descriptors with their own orbit among all material points.

    ``descriptors`` (B, P, D) at the projected points, ``askable`` (B, P) bool, ``prototypes`` (P, D) of which symmetric
    points share the mean, ``permutations`` (G, P).
    """
    tied = prototypes[permutations].mean(0)  # (P, D)
    image, point = askable.nonzero(as_tuple=True)
    squared = compute_squared_distances(descriptors[image, point][None], tied[None])[0]  # (n, P)
    log_share = torch.log_softmax(-squared, -1)
    own = permutations[:, point].T  # (n, G)
    distinct = torch.stack([(own[:, : i + 1] == own[:, i, None]).sum(1) == 1 for i in range(own.shape[1])], 1)
    log_own = log_share.gather(1, own).masked_fill(~distinct, -torch.inf).logsumexp(1)  # a fixed point counts once
    return -log_own.sum() / max(1, len(point))


def compute_mask_loss(logits: Tensor, mask: Tensor) -> Tensor:
    """Cross-entropy of mask logits (B, hm, wm) with masks (B, h, w) in [0, 1], averaged over the logits' cells."""
    target = F.interpolate(mask[:, None], logits.shape[-2:], mode="area")[:, 0]
    return F.binary_cross_entropy_with_logits(logits, target)


def compute_presence_loss(logits: Tensor, present: Tensor) -> Tensor:
    """Cross-entropy of presence logits (B,) with (B,) bool; the few images without the object count ten times."""
    weight = torch.where(present, 1.0, 10.0).to(logits.dtype)
    return F.binary_cross_entropy_with_logits(logits, present.float(), weight)


def compute_visibility_loss(logits: Tensor, seen: Tensor, counted: Tensor) -> Tensor:
    """Cross-entropy of visibility logits (...) with ``seen`` (...) bool, over those ``counted`` (...) bool.

    Seen and unseen places weigh as much as each other.
    """
    loss = F.binary_cross_entropy_with_logits(logits, seen.float(), reduction="none")
    parts = [loss[counted & (seen == truth)] for truth in (True, False)]
    return sum(part.mean() for part in parts if part.numel()) / 2 + 0 * logits.sum()


def _integrate_hats(mean: Tensor, centres: Tensor, sigma: float) -> Tensor:
    """Integral of N(x; mean, sigma²) times the hat function of every centre, (..., n) for ``mean`` (..., 1).

    It is a second difference of h(t) = t Φ(t) + φ(t), written as max(t, 0) + tail(|t|): the first part's difference is
    the hat itself, so that nothing cancels far from the mean.
    """
    offset = (centres - mean) / sigma  # (..., n)
    width = float(centres[1] - centres[0]) / sigma

    def tail(t: Tensor) -> Tensor:
        """φ(t) − |t| Φ(−|t|): what h(t) has beyond max(t, 0)."""
        t = t.abs()
        return torch.exp(-0.5 * t * t) / math.sqrt(2 * math.pi) - t * torch.special.ndtr(-t)

    hat = (width - offset.abs()).clamp(min=0)
    return (hat + tail(offset + width) - 2 * tail(offset) + tail(offset - width)).clamp(min=0) / width
