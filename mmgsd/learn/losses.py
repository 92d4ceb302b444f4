"""The four training losses as pure functions of descriptors, positions and masks.

Shapes: K ordered pairs of images, Q source points a pair, G matches a point (the orbit's size), N non-matches a point,
C cells of the target's descriptor grid, D descriptor dimensions. Positions are in full-image px.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def compute_target(modes: Tensor, valid: Tensor, xs: Tensor, ys: Tensor, sigma_px: float) -> Tensor:
    """The n-modal isotropic Gaussian mixture on a grid of cells (paper section "Symmetric Distributional Loss").

    ``modes`` (..., G, 2) px, ``valid`` (..., G) bool, ``xs`` (w,) and ``ys`` (h,) evenly spaced cell centres in px.
    Returns (..., h * w) summing to 1 where any mode is valid, else 0. Every Gaussian is integrated against the cells'
    linear interpolation functions, so a std far below a cell's size keeps its mean exactly.
    """
    if sigma_px <= 0:
        raise ValueError(f"sigma_px must be greater than 0, got {sigma_px}")
    across = _integrate_hats(modes[..., 0, None], xs, sigma_px)  # (..., G, w)
    down = _integrate_hats(modes[..., 1, None], ys, sigma_px)  # (..., G, h)
    density = torch.einsum("...gh,...gw->...hw", down * valid[..., None], across).flatten(-2)  # (..., h * w)
    return density / density.sum(-1, keepdim=True).clamp(min=1e-12)


def mmgsd(squared_distances: Tensor, target: Tensor) -> Tensor:
    """Cross-entropy of p = softmax(-distance²) with the mixture ``target``, both (..., C); mean over the queries.

    Queries whose target is 0 (no match in the image) do not count. Paper section "Symmetric Distributional Loss",
    with the sign of its exponent corrected. With one mode in ``target`` it is the unimodal loss (Florence 2020).
    """
    _check_same_shape(squared_distances, target)
    matched = target.sum(-1) > 0
    loss = -(target * torch.log_softmax(-squared_distances, -1)).sum(-1)
    return (loss * matched).sum() / matched.sum().clamp(min=1)


def pcl(
    match_distances: Tensor, matched: Tensor, non_match_distances: Tensor, non_matched: Tensor, *, margin: float = 0.5
) -> Tensor:
    """Pixel-wise contrastive loss (paper section "Preliminaries"), from Euclidean distances.

    ``match_distances`` (..., G) and ``non_match_distances`` (..., N), with boolean masks of the same shapes. The mean
    squared distance of the matches, plus the mean over the *hard* non-matches (those within the margin) of
    (margin - distance)², the hard-negative scaling of Dense Object Nets.
    """
    _check_same_shape(match_distances, matched)
    _check_same_shape(non_match_distances, non_matched)
    if margin <= 0:
        raise ValueError(f"margin must be greater than 0, got {margin}")
    match_loss = (match_distances.square() * matched).sum() / matched.sum().clamp(min=1)
    violation = (margin - non_match_distances).clamp(min=0) * non_matched
    return match_loss + violation.square().sum() / (violation > 0).sum().clamp(min=1)


def spcl(
    match_distances: Tensor, matched: Tensor, non_match_distances: Tensor, non_matched: Tensor, *, margin: float = 0.5
) -> Tensor:
    """The same loss with every symmetric match (paper section "SPCL Baseline"): G is the orbit's size, not 1."""
    return pcl(match_distances, matched, non_match_distances, non_matched, margin=margin)


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


def _check_same_shape(first: Tensor, second: Tensor) -> None:
    if first.shape != second.shape:
        raise ValueError(f"both arguments must have one shape, got {tuple(first.shape)} and {tuple(second.shape)}")
