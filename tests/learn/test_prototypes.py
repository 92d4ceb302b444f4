"""The dense supervision: prototypes, and their loss."""

import math

import numpy as np
import pytest
import torch

from mmgsd.learn.prototypes import SPREAD, compute_prototype_loss, make_prototypes
from mmgsd.symmetry import line_group

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
    loss = compute_prototype_loss(
        torch.zeros(1, 3, 1), torch.zeros(1, 3, dtype=torch.bool), torch.zeros(3, 1), torch.arange(3)[None]
    )
    assert float(loss) == 0


def test_prototypes_of_another_shape_are_an_error() -> None:
    with pytest.raises(ValueError, match="prototypes must be"):
        compute_prototype_loss(torch.zeros(1, 3, 2), torch.ones(1, 3).bool(), torch.zeros(3, 1), torch.arange(3)[None])
