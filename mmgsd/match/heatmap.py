"""From distances between descriptors to heatmaps, their entropy, their modes, and the ``Match`` that these make."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmgsd.match.em import AS_IT_IS, ModeReadout
from mmgsd.match.match import Match
from mmgsd.match.mixture import Mixture, check_count, fit_modes, keep_most_probable


def compute_heatmap(squared_distances: Tensor, *, bandwidth: float | None = None, temperature: float = 1.0) -> Tensor:
    """Distributions over cells (..., C) from squared descriptor distances (..., C).

    softmax(-d²) as in training (paper section "Symmetric Distributional Loss"); or, for descriptors of a contrastive
    loss, which have no scale of their own, a Gaussian of ``bandwidth`` in the descriptor norm differences, normalised.
    Either is raised to the power 1 / ``temperature``. ValueError where one of the two is not finite and above 0.
    """
    check_scales(bandwidth=bandwidth, temperature=temperature)
    scale = 1.0 if bandwidth is None else 1 / (2 * bandwidth**2)
    return torch.softmax(-scale / temperature * squared_distances, -1)


def compute_entropy(heatmap: Tensor, cell_area: float) -> Tensor:
    """Differential entropy in nats of the density over px: (S, C) to (S,); ln of the area it spreads over."""
    return torch.special.entr(heatmap).sum(-1) + float(np.log(cell_area))


def check_scales(*, bandwidth: float | None = None, temperature: float = 1.0) -> None:
    """ValueError, which names it, for a ``bandwidth`` or a ``temperature`` that is not finite and greater than 0."""
    for name, value in (("bandwidth", bandwidth), ("temperature", temperature)):
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if value is not None and not (number and math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be finite and greater than 0, got {value!r}")


def read_heatmap(
    heatmap: Tensor, n: int | str | Tensor, centres: tuple[Tensor, Tensor], **how: Any
) -> tuple[Mixture, Tensor]:
    """Mixtures of ``n`` modes and entropies (S,) in nats of heatmaps (S, h, w) with cell ``centres`` (w,), (h,) px.

    ``how`` modes are fitted is as `fit_modes` has it.
    """
    xs, ys = (c.float().to(heatmap.device) for c in centres)
    entropy = compute_entropy(heatmap.flatten(1), float((xs[1] - xs[0]) * (ys[1] - ys[0])))
    return fit_modes(heatmap, n, xs, ys, **how), entropy


def make_match(
    image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, cells: Tensor, centres: tuple[Tensor, Tensor], n: Any, *,
    fitted: int = 1, readout: ModeReadout = AS_IT_IS, scale: float = 1.0, merge: bool = True,
) -> Match:  # fmt: skip
    """The answer that heatmaps (S, h, w) with cell ``centres`` (w,), (h,) px hold, however they were made.

    At least ``fitted`` modes are fitted, of which the ``n`` most probable are returned; None: as many. Unless ``merge``
    is false, those on one spot are one (`fit_modes`). ``scale`` is
    `compute_scale`'s, for an entropy that does not depend on the number of image1's pixels.
    """
    wanted = check_count(fitted if n is None else n, "n", queries=len(cells))
    fit, entropy = read_heatmap(cells, "auto" if wanted is None else wanted.clamp(min=fitted), centres,
                                readout=readout, merge=merge)  # fmt: skip
    fit = fit if wanted is None else keep_most_probable(fit, wanted)
    arrays = (t.cpu().numpy() for t in (fit.modes, fit.weights, fit.covariances, entropy, fit.outlier_mass, cells))
    match = Match(image0, image1, xy, *arrays, scale=scale)
    return dataclasses.replace(match, entropy=match.entropy - np.float32(2 * math.log(scale)))


def compute_scale(size: tuple[int, int], trained: tuple[int, int]) -> float:
    """px of an image of ``size`` by px of one that the model was ``trained`` with: the root of their areas' ratio.

    As large as the network sees them: its inputs have as many pixels of one as of the other (`fit_input_size`).
    """
    return math.sqrt(size[0] * size[1] / (trained[0] * trained[1]))
