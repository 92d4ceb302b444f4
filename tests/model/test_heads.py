"""The heads: shapes, losses by hand, gradients that stay where they belong."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from mmgsd.learn.losses import compute_mask_loss, compute_presence_loss, compute_visibility_loss
from mmgsd.model.heads import Heads, look_up
from mmgsd.model.network import build_network


@pytest.mark.parametrize(("name", "stride", "mask_stride"), [("lite0", 4, 4), ("lite0x2", 4, 4), ("lite0x2fine", 8, 2)])
def test_shapes_of_what_a_network_says(name: str, stride: int, mask_stride: int) -> None:
    network = build_network(name, 8, roles=2, heads=True, pretrained=False).eval()
    with torch.inference_mode():
        outputs = network.describe(torch.rand(2, 3, 128, 192))
        plain = network(torch.rand(2, 3, 128, 192))
    assert outputs.descriptors.shape == plain.shape == (2, 16, 128 // stride, 192 // stride)
    assert outputs.mask.shape == (2, 128 // mask_stride, 192 // mask_stride)
    assert outputs.surface.shape[2:] == outputs.descriptors.shape[2:]
    assert outputs.presence.shape == (2,)


def test_heads_change_no_descriptor() -> None:
    torch.manual_seed(0)
    network = build_network("lite0", 8, heads=True, pretrained=False).eval()
    image = torch.rand(1, 3, 64, 64)
    with torch.inference_mode():
        assert torch.equal(network(image), network.describe(image).descriptors)


def test_without_heads_nothing_more_is_said() -> None:
    outputs = build_network("lite0", 8, pretrained=False).eval().describe(torch.rand(1, 3, 64, 64))
    assert outputs.mask is None and outputs.surface is None and outputs.presence is None


def test_heads_are_put_onto_trained_weights_and_not_taken_off() -> None:
    plain, headed = (build_network("lite0", 8, heads=heads, pretrained=False) for heads in (False, True))
    headed.start_from(plain)
    assert torch.equal(headed.head.weight, plain.head.weight)
    with pytest.raises(ValueError, match="no heads"):
        plain.start_from(headed)


def test_mask_loss_by_hand() -> None:
    logits = torch.tensor([[[0.0, 4.0]]])
    mask = torch.tensor([[[1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0]]])  # two cells: half full, full
    expected = (np.log(2) + np.log1p(np.exp(-4.0))) / 2
    assert compute_mask_loss(logits, mask).item() == pytest.approx(expected, abs=1e-6)


def test_absent_images_count_ten_times() -> None:
    logits = torch.tensor([0.0, 0.0])
    present = compute_presence_loss(logits, torch.tensor([True, True]))
    mixed = compute_presence_loss(logits, torch.tensor([True, False]))
    assert mixed.item() == pytest.approx(5.5 * present.item())


def test_seen_and_unseen_places_weigh_as_much() -> None:
    logits = torch.tensor([2.0, -1.0, -1.0, -1.0, 50.0])
    seen = torch.tensor([True, False, False, False, False])
    counted = torch.tensor([True, True, True, True, False])
    expected = (np.log1p(np.exp(-2.0)) + np.log1p(np.exp(-1.0))) / 2
    assert compute_visibility_loss(logits, seen, counted).item() == pytest.approx(expected, abs=1e-6)


def test_nothing_to_judge_is_no_loss() -> None:
    nothing = torch.zeros(3, dtype=torch.bool)
    assert compute_visibility_loss(torch.ones(3), nothing, nothing).item() == 0


@pytest.mark.parametrize("roles", [1, 2])
def test_the_judge_takes_any_leading_shape(roles: int) -> None:
    heads = Heads(8, 4, roles)
    logits = heads.visibility(torch.rand(2, 5, 1, 4), torch.rand(2, 5, 3, 4 * roles), torch.rand(2, 5, 3, 16))
    assert logits.shape == (2, 5, 3)


@pytest.mark.parametrize("size", [(64, 48), (485, 364), (4000, 3000)], ids=str)
@pytest.mark.parametrize("own", [True, False], ids=["logits", "caller's mask"])
def test_a_click_just_beside_the_object_is_on_it(size: tuple[int, int], own: bool) -> None:
    mask = np.zeros(size[::-1], bool)
    mask[size[1] // 4 : size[1] // 2, size[0] // 4 : size[0] // 2] = True
    logits = torch.from_numpy(cv2.resize(mask.astype(np.float32), (128, 96))) * 20 - 10
    corner = np.array([[size[0] / 4, size[1] / 4]])
    beside, far = corner - size[0] / 100, corner - size[0] / 16
    found = look_up(*((None, logits) if own else (mask, None)), np.concatenate([corner, beside, far]), size)
    np.testing.assert_allclose(found, [1, 1, 0], atol=0.01)
