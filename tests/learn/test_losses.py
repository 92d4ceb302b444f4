"""Losses: hand-computed values, gradients, the target's mass and mean, and what they refuse."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid
from scipy.stats import norm
from torch import Tensor

from mmgsd.learn import losses
from mmgsd.learn.losses import SPREAD, compute_prototype_loss, compute_target, make_prototypes
from mmgsd.model.network import compute_cell_centres, compute_squared_distances
from mmgsd.symmetry import line_group


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def cells(columns: int = 40, rows: int = 30) -> tuple[Tensor, Tensor]:
    """A grid of 4 x 4 px cells in float64."""
    return tuple(c.double() for c in compute_cell_centres((4 * columns, 4 * rows), (rows, columns)))


def one_mode(x: float, y: float, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
    """Target (h, w) of one mode with its grid."""
    xs, ys = cells()
    target = compute_target(torch.tensor([[x, y]], dtype=torch.float64), torch.tensor([True]), xs, ys, sigma)
    return target.view(len(ys), len(xs)), xs, ys


def both(*values: float) -> tuple[Tensor, Tensor]:
    """Distances and a mask that keeps them all."""
    return torch.tensor(values), torch.ones(len(values), dtype=torch.bool)


def test_pcl_by_hand() -> None:
    # matches: (0.09 + 0.16) / 2; non-matches within 0.5: (0.3² + 0.1²) / 2, the one at 0.6 is not hard
    loss = losses.pcl(*both(0.3, 0.4), *both(0.2, 0.6, 0.4), margin=0.5)
    assert loss.item() == pytest.approx(0.125 + 0.05)


def test_pcl_masks_count_nowhere() -> None:
    matched, non_matched = torch.tensor([True, False]), torch.tensor([True, False, False])
    loss = losses.pcl(both(0.3, 0.4)[0], matched, both(0.2, 0.6, 0.4)[0], non_matched)
    assert loss.item() == pytest.approx(0.09 + 0.09)


def test_pcl_without_any_match_is_zero() -> None:
    nothing = torch.zeros(3, dtype=torch.bool)
    assert losses.pcl(torch.ones(3), nothing, torch.zeros(3), nothing).item() == 0


def test_spcl_by_hand() -> None:
    # the orbit's four matches: (0 + 0.01 + 0.04 + 0.09) / 4
    assert losses.pcl(*both(0.0, 0.1, 0.2, 0.3), *both(0.9), margin=0.5).item() == pytest.approx(0.035)


def test_contrastive_gradient(generator: torch.Generator) -> None:
    match, far = (torch.rand(3, n, generator=generator, dtype=torch.float64).requires_grad_() for n in (2, 5))
    masks = [torch.rand(t.shape, generator=generator) < 0.7 for t in (match, far)]
    assert torch.autograd.gradcheck(lambda m, f: losses.pcl(m, masks[0], f, masks[1], margin=0.6), (match, far))


def test_mmgsd_by_hand() -> None:
    # exp(-d²) is 1, 1/2, 1/4, 1/4, so p is 1/2, 1/4, 1/8, 1/8
    squared = torch.tensor([[0.0, math.log(2), math.log(4), math.log(4)]])
    one, two = torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.5, 0.5, 0, 0]])
    assert losses.mmgsd(squared, one).item() == pytest.approx(math.log(2))
    assert losses.mmgsd(squared, two).item() == pytest.approx(1.5 * math.log(2))


def test_unimodal_by_hand() -> None:
    squared, target = torch.tensor([[0.0, math.log(3)]]), torch.tensor([[0.0, 1.0]])
    assert losses.mmgsd(squared, target).item() == pytest.approx(math.log(4))


def test_queries_without_a_match_do_not_count() -> None:
    squared = torch.tensor([[0.0, math.log(3)], [0.0, 5.0]])
    target = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    assert losses.mmgsd(squared, target).item() == pytest.approx(math.log(4 / 3))
    assert losses.mmgsd(squared, torch.zeros_like(squared)).item() == 0


def test_mmgsd_is_least_where_the_prediction_is_the_target() -> None:
    target = torch.tensor([[0.5, 0.3, 0.2]])
    entropy = -(target * target.log()).sum()
    torch.testing.assert_close(losses.mmgsd(-target.log(), target), entropy)
    assert losses.mmgsd(-target.flip(-1).log(), target) > entropy


def test_mmgsd_gradient(generator: torch.Generator) -> None:
    source, descriptors = (
        torch.randn(2, n, 3, generator=generator, dtype=torch.float64, requires_grad=True) for n in (2, 6)
    )
    target = torch.rand(2, 2, 6, generator=generator, dtype=torch.float64).softmax(-1)
    target[0, 0] = 0  # a query that is not asked
    function = lambda s, d: losses.mmgsd(compute_squared_distances(s, d), target)  # noqa: E731
    assert torch.autograd.gradcheck(function, (source, descriptors))


SIGMAS = pytest.mark.parametrize("sigma", [0.05, 1.0, 4.0, 9.0])  # px, cells are of 4 px


@SIGMAS
@pytest.mark.parametrize("xy", [(80.3, 60.9), (81.5, 57.5), (79.5, 60.0)])
def test_targets_mean_is_the_mode(sigma: float, xy: tuple[float, float]) -> None:
    target, xs, ys = one_mode(*xy, sigma)
    assert ((target.sum(0) * xs).sum().item(), (target.sum(1) * ys).sum().item()) == pytest.approx(xy, abs=1e-6)


@SIGMAS
def test_target_is_the_gaussian_integrated_over_hats(sigma: float) -> None:
    target, xs, _ = one_mode(80.3, 60.9, sigma)
    fine = np.linspace(80.3 - 9 * sigma, 80.3 + 9 * sigma, 20001)
    hats = np.clip(1 - np.abs(fine - xs.numpy()[:, None]) / 4, 0, None)
    expected = trapezoid(hats * norm.pdf(fine, 80.3, sigma), fine)
    np.testing.assert_allclose(target.sum(0).numpy(), expected, atol=1e-6)


@SIGMAS
def test_target_is_symmetric_about_a_cell(sigma: float) -> None:
    xs, ys = cells(21, 21)
    middle = torch.stack([xs[10], ys[10]])[None]
    target = compute_target(middle, torch.tensor([True]), xs, ys, sigma).view(21, 21)
    for image in (target.flip(0), target.flip(1), target.T):
        torch.testing.assert_close(image, target)


@SIGMAS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_target_sums_to_one(sigma: float, dtype: torch.dtype, rng: np.random.Generator) -> None:
    xs, ys = (c.to(dtype) for c in cells())
    modes = torch.from_numpy(rng.uniform(-0.5, 119.5, (50, 4, 2))).to(dtype)
    valid = torch.from_numpy(rng.random((50, 4)) < 0.5)
    total = compute_target(modes, valid, xs, ys, sigma).sum(-1)
    torch.testing.assert_close(total, valid.any(-1).to(dtype))


def test_target_weighs_its_modes_alike() -> None:
    xs, ys = cells()
    modes = torch.tensor([[20.0, 20.0], [140.0, 100.0], [20.0, 100.0], [0.0, 0.0]]).double()
    target = compute_target(modes, torch.tensor([True, True, True, False]), xs, ys, 2.0).view(30, 40)
    masses = [target[:15, :20].sum(), target[15:, 20:].sum(), target[15:, :20].sum(), target[:15, 20:].sum()]
    assert [m.item() for m in masses] == pytest.approx([1 / 3, 1 / 3, 1 / 3, 0], abs=1e-9)


GROUP = line_group("c2", n=9)
LINE = np.stack([np.linspace(0, 100, 9), np.zeros(9)], -1)[None].repeat(3, 0)  # (3, 9, 2) px


def test_symmetric_points_start_from_one_prototype_and_others_apart() -> None:
    prototypes = make_prototypes(LINE, GROUP.permutations, 4, 100.0)
    assert prototypes.shape == (9, 4)
    torch.testing.assert_close(prototypes, prototypes.flip(0), atol=1e-4, rtol=0)
    near, far = (prototypes[0] - prototypes[1]).norm(), (prototypes[0] - prototypes[4]).norm()
    assert near < far


def test_the_mean_squared_distance_of_prototypes_is_the_spread() -> None:
    prototypes = make_prototypes(LINE, np.arange(9)[None], 9, 100.0)
    assert float(torch.cdist(prototypes, prototypes).square().mean()) == pytest.approx(SPREAD, rel=1e-3)


def test_loss_by_hand() -> None:
    prototypes = torch.tensor([[0.0], [1.0], [0.0]])
    permutations = torch.tensor([[0, 1, 2], [2, 1, 0]])
    descriptors = torch.tensor([[[0.0], [1.0], [5.0]]])
    asked = torch.tensor([[True, True, False]])
    total = 2 + math.exp(-1)  # of point 0: itself and its mirror at distance 0, the middle at 1
    middle = 1 + 2 * math.exp(-1)
    expected = (-math.log(2 / total) - math.log(1 / middle)) / 2  # the middle is its own mirror: counted once
    loss = compute_prototype_loss(descriptors, asked, prototypes, permutations)
    assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_nothing_asked_costs_nothing() -> None:
    nobody = torch.zeros(1, 3, dtype=torch.bool)
    assert compute_prototype_loss(torch.zeros(1, 3, 1), nobody, torch.zeros(3, 1), torch.arange(3)[None]).item() == 0
