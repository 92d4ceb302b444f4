"""Weighted expectation-maximisation of Gaussian mixtures on a grid, batched over queries.

A fit's parameters are (S, N, 6): a component's mean x, y, weight and covariance [[a, b], [b, c]], in cells, from the
grid's centre, so that one regularisation suits every image size. Weight 0 marks a component that a query has not.

A log-density is linear in (1, x, y, x², xy, y²), so an E-step is one matrix product with these six numbers of every
cell, and an M-step, which needs their means, another. Where modes overlap, expectation-maximisation creeps: SQUAREM
(Varadhan and Roland, Scandinavian Journal of Statistics 2008) leaps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from mmgsd.checks import check
from mmgsd.config import ROUNDNESS

CYCLES = 60  # of three EM steps and a leap, at most; a query at rest is left alone
TOLERANCE_CELLS = 0.0005  # the most that a mode at rest moves in a cycle
LEAP = 16.0  # the longest leap, in steps
SPREAD = (1 / 12, 10 / 12, 1 / 12)  # of a cell's mass: to second order what bilinear interpolation to pixels does
MIN_VARIANCE = 0.05  # cells²
PRIOR_WEIGHT = 1.0  # heatmap mass by which each component is a priori as likely as any other
CHUNK = {"cpu": 2**21, "cuda": 2**26}  # numbers in the largest array of a fit


@dataclass(frozen=True)
class ModeReadout:
    """How modes are read from a heatmap; ValueError, which names it, for another value.

    ``shape_prior``: heatmap mass by which modes are a priori round and equally wide, greater than 0; their common width
    is the mean of theirs, or with ``median_width`` the median. ``exponent``, at least 1: they are fitted to the heatmap
    raised to it. ``mean_exponent``, at least 1: each then lies at the mean of its share of the heatmap raised to it.
    Weights and covariances are those of the shares of the heatmap itself.
    """

    shape_prior: float = ROUNDNESS
    exponent: float = 1.0
    mean_exponent: float = 1.0
    median_width: bool = False

    def __post_init__(self) -> None:
        check("shape_prior", self.shape_prior, "greater than 0", 0 < self.shape_prior < math.inf)
        for name in ("exponent", "mean_exponent"):
            check(name, getattr(self, name), "at least 1", 1 <= getattr(self, name) < math.inf)


AS_IT_IS = ModeReadout()  # modes at the means of their shares


def run_em(mass: Tensor, params: Tensor, cells: Tensor, readout: ModeReadout) -> Tensor:
    """Iterate until at rest; then the moments of each component's share of the mass, without the priors."""
    size, moving = get_chunk(params.shape[1], mass), torch.arange(len(mass), device=mass.device)
    for _ in range(CYCLES):
        moved = []
        for part in moving.split(size):
            after = run_cycle(mass[part], params[part], cells, readout)
            moved.append((after - params[part])[..., :2].abs().amax((1, 2)) > TOLERANCE_CELLS)
            params[part] = after
        moving = moving[torch.cat(moved)]
        if not len(moving):
            break
    parts = zip(mass.split(size), params.split(size), strict=True)
    present, params = params[..., 2] > 0, torch.cat([compute_moments(*part, cells) for part in parts])
    params[..., 2] = torch.where(present, params[..., 2].clamp(min=1e-9), 0)  # 0 stays the mark of an absent one
    return params


def run_cycle(mass: Tensor, params: Tensor, cells: Tensor, readout: ModeReadout) -> Tensor:
    """Two EM steps, a leap as far as their change of pace suggests, and a step that steadies it."""
    first = _step(mass, params, cells, readout)
    second = _step(mass, first, cells, readout)
    pace, change = first - params, second - 2 * first + params
    length = pace.flatten(1).norm(dim=1) / change.flatten(1).norm(dim=1).clamp(min=1e-12)
    length = length.clamp(1, LEAP)[:, None, None]
    leapt = params + 2 * length * pace + length**2 * change
    weight, a, b, c = leapt[..., 2:].unbind(-1)
    lawful = (a > MIN_VARIANCE) & (c > MIN_VARIANCE) & (a * c - b * b > MIN_VARIANCE**2) & (weight >= 0)
    return _step(mass, torch.where(lawful.all(1)[:, None, None], leapt, second), cells, readout)


def _step(mass: Tensor, params: Tensor, cells: Tensor, readout: ModeReadout) -> Tensor:
    """One step of EM with the priors."""
    mean, weight, covariance = compute_moments(mass, params, cells).split([2, 1, 3], -1)
    each = covariance[..., ::2].mean(-1)  # (S, N)
    if readout.median_width:
        width = each.masked_fill(params[..., 2] == 0, torch.nan).nanquantile(0.5, 1)  # (S,)
    else:
        width = (weight[..., 0] * each).sum(1) / weight.sum((1, 2))
    average = width[:, None, None] * width.new_tensor([1.0, 0.0, 1.0])
    prior = readout.shape_prior
    covariance = (weight * covariance + prior * average) / (weight + prior)
    weight = (weight + PRIOR_WEIGHT) * (params[..., 2:3] > 0)
    return torch.cat([mean, weight / weight.sum(1, keepdim=True), covariance], -1)


def compute_moments(mass: Tensor, params: Tensor, cells: Tensor) -> Tensor:
    """Parameters of the components' shares of the (S, C) mass: an E-step and an M-step."""
    share = torch.softmax(compute_log_densities(params, cells), 1).mul_(mass[:, None])  # (S, N, C)
    moments = share @ cells.T  # (S, N, 6)
    weight = moments[..., :1]
    mean, (xx, xy, yy) = moments[..., 1:3] / weight.clamp(min=1e-9), moments[..., 3:].unbind(-1)
    mean = torch.where(weight > 1e-9, mean, params[..., :2])
    x, y = mean.unbind(-1)
    count = weight[..., 0].clamp(min=1e-9)
    a, b, c = xx / count - x * x, xy / count - x * y, yy / count - y * y
    covariance = torch.stack([a.clamp(min=MIN_VARIANCE) + 1e-3, b, c.clamp(min=MIN_VARIANCE) + 1e-3], -1)
    covariance = torch.where(weight > 1e-9, covariance, params[..., 3:])
    return torch.cat([mean, weight, covariance], -1)


def compute_log_densities(params: Tensor, cells: Tensor) -> Tensor:
    """ln(weight * density) of each component at each cell, (S, N, C), less the constant ln 2π."""
    x, y, weight, a, b, c = params.unbind(-1)
    determinant = a * c - b * b
    p, q, r = c / determinant, -b / determinant, a / determinant  # the inverse covariance [[p, q], [q, r]]
    at_origin = weight.log() - 0.5 * determinant.log() - 0.5 * (p * x * x + 2 * q * x * y + r * y * y)
    at_origin = at_origin.clamp(min=-1e30)  # of a component that is not there; -inf times 0 would be NaN
    return torch.stack([at_origin, p * x + q * y, q * x + r * y, -0.5 * p, -q, -0.5 * r], -1) @ cells


def compute_log_likelihood(mass: Tensor, params: Tensor, cells: Tensor, *, even: float = 0.0) -> Tensor:
    """Mean log-density (S,) of the mass, each component wider by a cell's own spread: no spike between cells counts.

    The mixture may have a further part that is ``even`` over the grid.
    """
    params = params + 2 * SPREAD[0] * params.new_tensor([0, 0, 0, 1, 0, 1])
    size = get_chunk(params.shape[1], mass)
    parts = zip(mass.split(size), params.split(size), strict=True)
    floor = mass.new_tensor(2 * math.pi * even / mass.shape[1]).log()
    return torch.cat([(compute_log_densities(s, cells).logsumexp(1).logaddexp(floor) * m).sum(-1) for m, s in parts])


def describe_cells(grid: tuple[int, int], device: torch.device) -> Tensor:
    """(6, C): 1, x, y, x², xy, y² of each cell, in which log-densities are linear and whose means are moments."""
    y, x = (torch.arange(count, dtype=torch.float32, device=device) - (count - 1) / 2 for count in grid)
    x, y = (t.flatten() for t in torch.meshgrid(x, y, indexing="xy"))
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def get_chunk(n_max: int, mass: Tensor) -> int:
    """How many queries of so many components, on the mass's grid, are fitted at once."""
    return max(1, CHUNK.get(mass.device.type, CHUNK["cpu"]) // (n_max * mass.shape[1]))
