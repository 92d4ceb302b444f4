"""The heads' loss of a batch: it can be learnt, and leaves the descriptors to the method's own loss."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.learn.augmentation import load_training_images, make_batch
from mmgsd.learn.objective import compute_head_loss
from mmgsd.model.network import build_network

CONFIG = TrainConfig(input_px=64, descriptor_dim=8, heads=True, clutter=True, roles=2)


def test_the_heads_learn_and_the_judge_leaves_descriptors_alone(tiny_dataset: Callable[..., Path]) -> None:
    data = load_dataset(tiny_dataset(), "train")
    images = load_training_images(data, CONFIG.input_px)
    batch = make_batch(images, np.arange(4), CONFIG, np.random.default_rng(0), torch.device("cpu"))
    torch.manual_seed(0)
    network = build_network("lite0", 8, roles=2, heads=True)
    permutations, losses = torch.tensor(data.group().permutations), []
    optimiser = torch.optim.AdamW(network.heads.parameters(), lr=1e-2)
    for _ in range(25):
        said = network.describe(batch.image)
        loss = compute_head_loss(network.heads, said, batch, permutations, data.size, torch.Generator().manual_seed(0))
        losses.append(loss.item())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert losses[-1] < 0.6 * losses[0]
    assert network.head.source.weight.grad is None


def test_a_batch_without_any_object_has_a_finite_loss(tiny_dataset: Callable[..., Path]) -> None:
    data = load_dataset(tiny_dataset(), "train")
    images = load_training_images(data, CONFIG.input_px)
    batch = make_batch(images, np.arange(4), CONFIG, np.random.default_rng(0), torch.device("cpu"))
    nothing = {name: torch.zeros_like(getattr(batch, name)) for name in ("mask", "askable", "inside")}
    network = build_network("lite0", 8, roles=2, heads=True, pretrained=False)
    empty = dataclasses.replace(batch, **nothing)
    permutations = torch.tensor(data.group().permutations)
    loss = compute_head_loss(network.heads, network.describe(batch.image), empty, permutations, data.size,
                             torch.Generator().manual_seed(0))  # fmt: skip
    assert torch.isfinite(loss)
