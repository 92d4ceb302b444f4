"""The losses of a batch: the heads' leaves descriptors to the method's own; SPCL's learns hidden matches if told so."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from mmgsd.config import TrainConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.learn.augmentation import Batch, load_training_images, make_batch
from mmgsd.learn.objective import compute_head_loss, compute_loss
from mmgsd.model.network import build_network

CONFIG = TrainConfig(input_px=64, descriptor_dim=8, heads=True, clutter=True, roles=2)


@pytest.fixture
def data(tiny_dataset: Callable[..., Path]) -> Dataset:
    return load_dataset(tiny_dataset(), "train")


@pytest.fixture
def batch(data: Dataset, rng: np.random.Generator) -> Batch:
    images = load_training_images(data, CONFIG.input_px)
    return make_batch(images, np.arange(4), CONFIG, rng, torch.device("cpu"))


def test_the_heads_learn_and_the_judge_leaves_descriptors_alone(data: Dataset, batch: Batch) -> None:
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


def test_a_batch_without_any_object_has_a_finite_loss(data: Dataset, batch: Batch) -> None:
    nothing = {name: torch.zeros_like(getattr(batch, name)) for name in ("mask", "askable", "inside")}
    network = build_network("lite0", 8, roles=2, heads=True, pretrained=False)
    empty = dataclasses.replace(batch, **nothing)
    permutations = torch.tensor(data.group().permutations)
    loss = compute_head_loss(network.heads, network.describe(batch.image), empty, permutations, data.size,
                             torch.Generator().manual_seed(0))  # fmt: skip
    assert torch.isfinite(loss)


def test_contrastive_losses_learn_hidden_matches_where_that_is_asked_for(data: Dataset, batch: Batch) -> None:
    config = TrainConfig(method="spcl", margin=4.0, input_px=64, descriptor_dim=8, batch=4, pairs=6, queries=16)
    descriptors = torch.randn(len(batch.image), 8, 16, 16, generator=torch.Generator().manual_seed(0))
    permutations = torch.tensor(data.group().permutations)
    batch.askable[1, ::2] = False  # they are inside the second image, but something hides them

    def measure(hidden_matches: bool) -> float:
        asked = dataclasses.replace(config, hidden_matches=hidden_matches)
        return float(compute_loss(asked, descriptors, batch, permutations, data.size, 0))

    assert measure(False) != measure(True)
    batch.askable[:] = batch.inside
    assert measure(False) == measure(True)
    with pytest.raises(ValueError, match="hidden_matches must"):
        TrainConfig(method="mmgsd", hidden_matches=True)
