"""n-modal Gaussian mixtures fitted to heatmaps: weighted expectation-maximisation, batched over queries.

Peaks, one after another, are where it starts, and flattened heatmaps are what it is fitted to first: two components
that share a strong mode while a weak one has none would stay there (deterministic annealing, Ueda and Nakano, Neural
Networks 1998). Where one component gets next to nothing all the same, they are fitted again from the peaks, and the
likelier fit counts. The steps themselves are in `mmgsd.match.em`.

Of an image unlike those that a network was taught with, part of the heatmap spreads over all of the object, and draws
modes away from its peaks. `ModeReadout` says how far modes follow the peaks instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from mmgsd.checks import check
from mmgsd.config import MAX_MODES
from mmgsd.match.em import (
    AS_IT_IS,
    SPREAD,
    ModeReadout,
    compute_log_densities,
    compute_log_likelihood,
    compute_moments,
    describe_cells,
    get_chunk,
    run_cycle,
    run_em,
)
from mmgsd.numerics import own_numerics

ANNEALING, ANNEALING_CYCLES = (4.0, 2.0), 6  # temperatures of the flattened heatmaps fitted first, on half the grid
KERNEL_CELLS = 1.0  # std of the kernel that finds the initial peaks, in cells twice as long and high
COLLAPSED = 0.2  # of an equal share of the heatmap: a component with less may have left a peak to none
EVEN = 0.05  # of the mass may lie anywhere where two fits are compared: who explains the background alone is no better
MOST_MODES, SAMPLES = 8, 200  # n="auto": the most modes tried; a heatmap weighs as much as so many drawn pixels
ELLIPSE = 5.991  # squared Mahalanobis distance of the ellipse that holds 95 % of a Gaussian in the plane


@dataclass(frozen=True)
class Mixture:
    """Gaussian mixtures fitted to S heatmaps, most probable mode first; absent modes have weight 0, else NaN."""

    modes: Tensor  # (S, N, 2) px
    weights: Tensor  # (S, N), sum to 1
    covariances: Tensor  # (S, N, 2, 2) px²
    outlier_mass: Tensor  # (S,) mass of the heatmap outside every mode's 95 % ellipse


@own_numerics()
def fit_modes(
    heatmap: Tensor, n: int | str | Tensor, xs: Tensor, ys: Tensor, *, readout: ModeReadout = AS_IT_IS,
    merge: bool = False, start: Tensor | None = None, others: Sequence[Tensor] = (),
) -> Mixture:  # fmt: skip
    """Fit an n-modal Gaussian mixture to each heatmap by weighted expectation-maximisation.

    ``heatmap`` (S, h, w) not negative, ``n`` modes for all or (S,), or "auto" for what the Bayesian information
    criterion prefers; ``xs`` (w,) and ``ys`` (h,) cell centres in px. Symmetric modes are a priori equally likely,
    round and equally wide, the latter two as far as ``readout`` says: that decides which cell belongs to which mode,
    while the result holds the moments of the mass itself. With ``merge``, modes less than a cell apart are one, and
    the others absent. From ``start`` (S, N, 2) px, NaN where a query has no further mode, the fit goes on instead of
    from the heatmap's peaks; ``n`` then does not count. Of fits from ``others`` besides, starts of the same kind, the
    likeliest counts. Raises ValueError for ``n`` that is not from 1 to `MAX_MODES`, another word, or values that are
    not finite.
    """
    count = check_count(n, "n", queries=len(heatmap))
    heatmap = heatmap.float()
    total = heatmap.flatten(1).sum(-1, keepdim=True)
    if not total.isfinite().all():
        raise ValueError("heatmap must be finite, got NaN or infinity: the weights, or the descriptors, are damaged")
    mass = torch.where(total > 0, heatmap.flatten(1) / total.clamp(min=1e-30), 1 / (len(xs) * len(ys)))
    grid = heatmap.shape[1:]
    mass = _interpolate(mass, grid)
    powered = _raise(mass, readout.exponent)
    step, middle = torch.stack([xs[1] - xs[0], ys[1] - ys[0]]), torch.stack([xs.mean(), ys.mean()])  # px a cell, px
    starts = [_make_params((each.to(mass) - middle) / step) for each in ([] if start is None else [start]) + [*others]]
    fitted = [run_em(powered, each, describe_cells(grid, mass.device), readout) for each in starts]
    if start is not None:
        params = fitted.pop(0)
    elif count is None:
        params = _choose_fit(powered, grid, readout)
    else:
        most = int(count.max()) if count.numel() else 1
        params = _fit(powered, count.to(heatmap.device).expand(len(heatmap)), most, grid, readout)
    for each in fitted:
        params = _keep_likelier(powered, params, each, grid)
    params = _measure_shares(mass, params, grid, readout)
    params = _merge(params) if merge else params
    outlier_mass = _measure_outliers(mass, params, grid)
    order = params[..., 2].argsort(-1, descending=True)
    params = params.gather(1, order[..., None].expand_as(params))
    absent = (params[..., 2] == 0)[..., None]
    modes = (params[..., :2] * step + middle).masked_fill(absent, torch.nan)
    covariances = params[..., [3, 4, 4, 5]].unflatten(-1, (2, 2)) * step[:, None] * step
    return Mixture(modes, params[..., 2], covariances.masked_fill(absent[..., None], torch.nan), outlier_mass)


@own_numerics()
def find_peaks(heatmap: Tensor, n: Tensor, xs: Tensor, ys: Tensor) -> Tensor:
    """Peaks (S, N, 2) px of heatmaps, ``n`` (S,) of each, NaN for further ones, as `fit_modes` finds where it starts.

    That is on the grid itself, not on half of it, and without flattening.
    """
    step, middle = torch.stack([xs[1] - xs[0], ys[1] - ys[0]]), torch.stack([xs.mean(), ys.mean()])
    params = _start(heatmap.float().flatten(1), n, int(n.max()), heatmap.shape[1:])
    return (params[..., :2] * step + middle).masked_fill(params[..., 2:3] == 0, torch.nan)


def _fit(mass: Tensor, n: Tensor, n_max: int, grid: tuple[int, int], readout: ModeReadout) -> Tensor:
    """Parameters of the fit to (S, C) mass; where a component collapsed, the likelier of it and one from the peaks."""
    how = n_max, grid, readout
    params = _fit_from(ANNEALING, mass, n, *how)
    weight = params[..., 2]
    poor = ((weight > 0) & (weight * n[:, None] < COLLAPSED)).any(1).nonzero()[:, 0]
    if not len(poor):
        return params
    params[poor] = _keep_likelier(mass[poor], params[poor], _fit_from((), mass[poor], n[poor], *how), grid)
    return params


def _keep_likelier(mass: Tensor, params: Tensor, others: Tensor, grid: tuple[int, int]) -> Tensor:
    """Of two fits to each (S, C) mass, of as many components, the likelier."""
    cells = describe_cells(grid, mass.device)
    before, after = (compute_log_likelihood(mass, each, cells, even=EVEN) for each in (params, others))
    return torch.where((after > before)[:, None, None], others, params)


def _fit_from(
    temperatures: tuple[float, ...], mass: Tensor, n: Tensor, n_max: int, grid: tuple[int, int], readout: ModeReadout
) -> Tensor:
    """Parameters of the fit to (S, C) mass, flattened before, in chunks of queries: memory stays bounded."""
    coarse, coarse_grid = _halve(mass, grid)
    size = get_chunk(n_max, coarse)
    parts = zip(coarse.split(size), n.split(size), strict=True)
    starts = [_anneal(temperatures, *part, n_max, coarse_grid, readout) for part in parts]
    params = torch.cat(starts) * mass.new_tensor([2, 2, 1, 4, 4, 4])
    params[..., 0] += 0.5 * (grid[1] % 2)  # an odd grid was halved with a column, or a row, of nothing
    params[..., 1] += 0.5 * (grid[0] % 2)
    return run_em(mass, params, describe_cells(grid, mass.device), readout)


def _merge(params: Tensor) -> Tensor:
    """State where components less than a cell apart are one, with their moments together, and the others absent."""
    mean, weight, covariance = params.split([2, 1, 3], -1)
    near = torch.cdist(mean, mean) < 1  # (S, N, N)
    into = torch.where(near, weight.mT, -1).argmax(-1)  # (S, N), the heaviest that is near
    for _ in range(2):
        into = into.gather(1, into)  # of a chain
    share = F.one_hot(into, params.shape[1]).mT * weight.mT  # (S, N, N), of what each is merged from
    total = share.sum(-1, keepdim=True)
    share = share / total.clamp(min=1e-30)
    middle = share @ mean
    dx, dy = (mean[:, None] - middle[:, :, None]).unbind(-1)  # (S, N, N)
    spread = covariance[:, None] + torch.stack([dx * dx, dx * dy, dy * dy], -1)
    return torch.cat([middle, total, (share[..., None] * spread).sum(2)], -1)


def _raise(mass: Tensor, power: float) -> Tensor:
    """(S, C) mass to the power, its sum 1."""
    if power == 1:
        return mass
    raised = (mass / mass.amax(-1, keepdim=True).clamp(min=1e-30)) ** power
    return raised / raised.sum(-1, keepdim=True)


def _measure_shares(mass: Tensor, params: Tensor, grid: tuple[int, int], readout: ModeReadout) -> Tensor:
    """State with the weights and covariances of the components' shares of the mass, and the means of sharper ones."""
    if readout.exponent == readout.mean_exponent == 1:
        return params
    size, cells = get_chunk(params.shape[1], mass), describe_cells(grid, mass.device)
    parts = zip(mass.split(size), params.split(size), strict=True)
    return torch.cat([_measure_part(*part, cells, readout.mean_exponent) for part in parts])


def _measure_part(mass: Tensor, params: Tensor, cells: Tensor, sharpness: float) -> Tensor:
    moments = compute_moments(mass, params, cells)
    share = torch.softmax(compute_log_densities(params, cells), 1).mul_(mass[:, None])  # (S, N, C)
    sharp = (share / share.amax(-1, keepdim=True).clamp(min=1e-30)) ** sharpness
    mean = (sharp @ cells[1:3].T) / sharp.sum(-1, keepdim=True).clamp(min=1e-9)
    mean = torch.where(moments[..., 2:3] > 1e-9, mean, params[..., :2])
    return torch.cat([mean, params[..., 2:3], moments[..., 3:]], -1)


def _halve(mass: Tensor, grid: tuple[int, int]) -> tuple[Tensor, tuple[int, int]]:
    """(S, C) mass on a grid of cells twice as long and high."""
    image = F.pad(mass.view(-1, 1, *grid), (0, grid[1] % 2, 0, grid[0] % 2))
    half = 4 * F.avg_pool2d(image, 2)[:, 0]
    return half.flatten(1), half.shape[1:]


def _anneal(
    temperatures: tuple[float, ...], mass: Tensor, n: Tensor, n_max: int, grid: tuple[int, int], readout: ModeReadout
) -> Tensor:
    """State at the peaks, then fitted to the flattened mass, less and less flattened."""
    params, cells = _start(mass, n, n_max, grid), describe_cells(grid, mass.device)
    for temperature in temperatures:
        flat = mass ** (1 / temperature)
        flat /= flat.sum(-1, keepdim=True)
        for _ in range(ANNEALING_CYCLES):
            params = run_cycle(flat, params, cells, readout)
    return params


def _interpolate(mass: Tensor, grid: tuple[int, int]) -> Tensor:
    """(S, C) mass whose moments are those of the heatmap at full resolution."""
    matrices = []
    for count in grid:
        matrix = sum(share * torch.eye(count + 2, dtype=torch.float32)[k : k + count] for k, share in enumerate(SPREAD))
        matrix[:, 1] += matrix[:, 0]  # none leaves the image
        matrix[:, -2] += matrix[:, -1]
        matrices.append(matrix[:, 1:-1].to(mass.device))
    return (matrices[0].T @ mass.view(-1, *grid) @ matrices[1]).flatten(1)


def _start(mass: Tensor, n: Tensor, n_max: int, grid: tuple[int, int]) -> Tensor:
    """State at n peaks found one after another, each taking all mass around it away."""
    (h, w), rest = grid, mass.view(-1, *grid)
    blur_y, blur_x = (_make_kernel(count, mass.device) for count in grid)
    peaks = []
    for _ in range(n_max):
        local = blur_y @ (rest @ blur_x)
        # the blurred mass finds the region, the mass itself the peak inside it
        index = (local * (rest + 1e-3 * local)).flatten(1).argmax(-1)
        row, column = index // w, index % w
        rest = rest * (1 - blur_y[row][:, :, None] * blur_x[column][:, None])
        peaks.append(torch.stack([column, row], -1) - mass.new_tensor([(w - 1) / 2, (h - 1) / 2]))
    present = torch.arange(n_max, device=n.device) < n[:, None]
    return _make_params(torch.stack(peaks, 1).masked_fill(~present[..., None], torch.nan))


def _make_params(places: Tensor) -> Tensor:
    """Parameters of equal components at places (S, N, 2) in cells from the grid's centre; those at NaN are absent."""
    present = places.isfinite().all(-1)
    weight = present.to(places) / present.sum(1, keepdim=True)
    variance = torch.full_like(weight, KERNEL_CELLS**2)
    rest = torch.stack([weight, variance, 0 * variance, variance], -1)
    return torch.cat([places.nan_to_num(0.0), rest], -1)


def _make_kernel(count: int, device: torch.device) -> Tensor:
    at = torch.arange(count, dtype=torch.float32, device=device)
    return torch.exp(-0.5 * ((at[:, None] - at) / KERNEL_CELLS) ** 2)


def _choose_fit(mass: Tensor, grid: tuple[int, int], readout: ModeReadout) -> Tensor:
    """State (S, 8, 6) with as many components as the Bayesian information criterion prefers."""
    cells, states, criteria = describe_cells(grid, mass.device), [], []
    for n in range(1, MOST_MODES + 1):
        params = _fit(mass, torch.full((len(mass),), n, device=mass.device), n, grid, readout)
        likelihood = SAMPLES * compute_log_likelihood(mass, params, cells)
        criteria.append((6 * n - 1) * float(np.log(SAMPLES)) - 2 * likelihood)
        states.append(F.pad(params, (0, 0, 0, MOST_MODES - n)))
    best = torch.stack(criteria).argmin(0)  # (S,)
    return torch.stack(states)[best, torch.arange(len(mass), device=mass.device)]


def _measure_outliers(mass: Tensor, params: Tensor, grid: tuple[int, int]) -> Tensor:
    """Mass (S,) outside every component's 95 % ellipse."""
    x, y = describe_cells(grid, mass.device)[1:3]
    outlier_mass = torch.ones_like(mass, dtype=torch.bool)
    for component in params.unbind(1):
        mean_x, mean_y, weight, a, b, c = component[..., None].unbind(1)  # (S, 1) each
        dx, dy = x - mean_x, y - mean_y
        inside = c * dx * dx - 2 * b * dx * dy + a * dy * dy <= ELLIPSE * (a * c - b * b)
        outlier_mass &= ~inside | (weight == 0)
    return (mass * outlier_mass).sum(-1)


def check_count(n: Any, name: str, *, queries: int = 1) -> Tensor | None:
    """Numbers of modes, () or (S,) for as many ``queries``, or None from "auto".

    ValueError, which names it, for what is not from 1 to `MAX_MODES`.
    """
    if isinstance(n, str) and n == "auto":
        return None
    accepted = f"{name} must be an integer, or ({queries},) integers, from 1 to {MAX_MODES}, or 'auto'"
    try:
        count = torch.as_tensor(n)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ValueError(f"{accepted}, got {n!r:.80}") from error
    whole = not (count.is_floating_point() or count.is_complex() or count.dtype == torch.bool)
    within = not count.numel() or (whole and bool(((count >= 1) & (count <= MAX_MODES)).all()))
    if not within or count.shape not in ((), (queries,)):
        raise ValueError(f"{accepted}, got {n!r:.80}")
    return count.long()


def check_modes(modes: Any, name: str = "modes", most: int = MAX_MODES, where: str = "") -> None:
    """ValueError, which names it, for a number of modes that is no integer from 1 to the ``most`` there can be."""
    whole = isinstance(modes, int | np.integer) and not isinstance(modes, bool)
    check(name, modes, f"an integer from 1 to {most}{where}", whole and 1 <= modes <= most)


def keep_most_probable(fit: Mixture, n: Tensor) -> Mixture:
    """The ``n``, () or (S,), most probable modes of each fit, (S, max n, …), their weights divided by their sum.

    ``outside`` stays that of all modes that were fitted.
    """
    most = min(int(n.max()), fit.weights.shape[1]) if n.numel() else fit.weights.shape[1]
    n = n.to(fit.weights.device).expand(len(fit.weights))
    absent = torch.arange(most, device=n.device) >= n[:, None]  # (S, most)
    weights = fit.weights[:, :most].masked_fill(absent, 0)
    if not torch.equal(weights.count_nonzero(1), fit.weights.count_nonzero(1)):
        weights = weights / weights.sum(1, keepdim=True)
    modes = fit.modes[:, :most].masked_fill(absent[..., None], torch.nan)
    covariances = fit.covariances[:, :most].masked_fill(absent[..., None, None], torch.nan)
    return Mixture(modes, weights, covariances, fit.outlier_mass)
