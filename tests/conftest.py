"""What all tests share: a seeded generator, synthetic data sets, and property tests that draw the same examples."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch
from synthetic import write_tiny_dataset

from mmgsd.learn import training
from mmgsd.model import dinov2
from mmgsd.model.tensors import write_tensors

os.environ.setdefault("MPLBACKEND", "Agg")  # no window, and before anything imports matplotlib

gc.set_threshold(100_000, 50, 50)  # thousands of tests are many objects, which are looked through again and again

hypothesis.settings.register_profile("reproducible", derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile("reproducible")

LONGEST = "test_run_all.py"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest file first: where processes share the files, none is left with it at the end."""
    items.sort(key=lambda item: item.path.name != LONGEST)


@pytest.fixture(scope="session", autouse=True)
def backbone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], Path]]:
    """A frozen backbone of random weights where the published one, which is no part of a clone, is not at hand.

    It is what found the published one.
    """
    published = dinov2.find_backbone
    if (dinov2.find_shipped() / dinov2.FILE).is_file():
        yield published
        return
    path = tmp_path_factory.mktemp("backbone") / "random.safetensors"

    def find() -> Path:
        if not path.is_file():
            torch.manual_seed(0)
            write_tensors(path, {k: v.half() for k, v in dinov2.VisionTransformer().state_dict().items()}, {})
        return path

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dinov2, "find_backbone", find)
        yield published


@pytest.fixture(scope="session", autouse=True)
def unflushed() -> Iterator[None]:
    """What a test writes need not outlive a loss of power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def few_questions() -> Iterator[None]:
    """Training asks a few questions where it validates itself and looks for a bandwidth: most of its time here."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("measure_rmse", "calibrate_bandwidth"):
            patch.setattr(training, name, partial(getattr(training, name), pairs=2, points=9))
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that draws the same numbers in every run."""
    return np.random.default_rng(0)


@pytest.fixture
def tiny_dataset(tmp_path: Path) -> Callable[..., Path]:
    """Writes a small synthetic data set below ``tmp_path``; returns its folder."""
    return partial(write_tiny_dataset, tmp_path)


@pytest.fixture(scope="session")
def cloth_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic cloth data set that all tests share: read it only."""
    return write_tiny_dataset(tmp_path_factory.mktemp("shared"), object="cloth", n_train=6, n_test=4)
