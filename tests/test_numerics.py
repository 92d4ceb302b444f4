"""What a caller has set for the rest of a program changes no answer, and is as it was afterwards."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.extras.exporting import export_onnx
from mmgsd.learn.training import train_model
from mmgsd.match.baselines import BaselineMatcher
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher, load
from mmgsd.measure.calibration import calibrate_bandwidth, calibrate_temperature

CONFIG = TrainConfig(steps=2, batch=4, pairs=6, queries=16, input_px=64, descriptor_dim=4, heads=True, roles=2,
                     rotate=False)  # fmt: skip


@contextmanager
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


ENVIRONMENTS: dict[str, Callable[[], AbstractContextManager]] = {
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "default dtype": double,
    "np.seterr": lambda: np.errstate(all="raise"),
    "inference_mode": torch.inference_mode,
    "no_grad": torch.no_grad,
    "default device": lambda: torch.device("meta"),
}


class Question:
    """What is asked about: a trained model's file, a data set of it, and a folder to write to."""

    def __init__(self, weights: Path, dataset: Path, folder: Path) -> None:
        self.weights, self.dataset, self.folder, data = weights, dataset, folder, load_dataset(dataset, "test")
        self.images, self.xy = [data.load_image(0), data.load_image(1)], data.xy[0][[24, 100, 312]]


def list_numbers(match: Match) -> list[np.ndarray]:
    promises = match.confidence(), match.radius_px(), match.ellipses(), match.compute_heatmap(), match.best().xy
    return [match.modes, match.weights, match.covariances, match.visible, match.on_object, match.absent, *promises]


def match(question: Question, matcher: Matcher) -> list[Any]:
    return list_numbers(matcher.match(*question.images, question.xy))


def joint(question: Question, matcher: Matcher) -> list[Any]:
    mask0 = np.zeros(question.images[0].shape[:2], bool)
    mask0[100:380, 100:380] = True
    return list_numbers(matcher.match(*question.images, question.xy, joint=True, mask0=mask0))


def auto(question: Question, matcher: Matcher) -> list[Any]:
    return [found.modes for found in matcher.match_many([(*question.images, question.xy)] * 2, n="auto")]


def segment(question: Question, matcher: Matcher) -> list[Any]:
    return [matcher.segment(question.images[0])]


def baselines(question: Question, _: Matcher) -> list[Any]:
    return [BaselineMatcher(name).match(*question.images, question.xy).modes for name in ("sift", "imagenet")]


def export(question: Question, matcher: Matcher) -> list[Any]:
    path = question.folder / "network.onnx"
    export_onnx(matcher, path)
    return [np.frombuffer(path.read_bytes(), np.uint8)]


def calibrate(question: Question, matcher: Matcher) -> list[Any]:
    data = load_dataset(question.dataset, "test")
    return [calibrate_temperature(matcher, data, pairs=2, points=5), calibrate_bandwidth(matcher, data, pairs=2)]


def train(question: Question, _: Matcher) -> list[Any]:
    weights = train_model(CONFIG, question.dataset, question.folder, device="cpu", progress=False, overwrite=True)
    return list(load_file(weights).values())


QUICK, SLOW = (match, joint, auto, segment, baselines), (calibrate, export, train)
CASES = [(name, action) for action in QUICK for name in ENVIRONMENTS]
CASES += [("all", action) for action in SLOW] + [("threads", segment)]


@pytest.fixture(scope="module")
def question(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Question:
    folder = tmp_path_factory.mktemp("model")
    weights = train_model(CONFIG, cloth_dataset, folder, device="cpu", progress=False)
    return Question(weights, cloth_dataset, tmp_path_factory.mktemp("folder"))


@pytest.fixture(scope="module")
def expected(question: Question) -> dict[str, list[Any]]:
    with threads(1):
        return {action.__name__: action(question, load(question.weights, device="cpu")) for action in (*QUICK, *SLOW)}


@pytest.mark.parametrize(("name", "action"), CASES, ids=lambda value: getattr(value, "__name__", value))
def test_no_setting_of_the_callers_matters(
    question: Question, expected: dict[str, list[Any]], name: str, action: Callable[[Question, Matcher], list[Any]]
) -> None:
    ahead = [load(question.weights, device="cpu")] if action is match else []
    chosen = [make for key, make in ENVIRONMENTS.items() if name in (key, "all")]
    with threads(2 if name == "threads" else 1), ExitStack() as stack:
        for make in chosen:
            stack.enter_context(make())
        settings = read_settings()
        found = [action(question, matcher) for matcher in (*ahead, load(question.weights, device="cpu"))]
        assert read_settings() == settings
    near = {"rtol": 0, "atol": 1e-3 if name == "threads" else 0}
    for numbers in found:
        for got, wanted in zip(numbers, expected[action.__name__], strict=True):
            np.testing.assert_allclose(got, wanted, **near)
            assert getattr(got, "dtype", None) == getattr(wanted, "dtype", None)


def read_settings() -> tuple[Any, ...]:
    autocast = torch.is_autocast_enabled("cpu"), torch.is_autocast_cache_enabled()
    gradients = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
    return *autocast, *gradients, torch.get_default_dtype(), torch.get_default_device(), tuple(np.geterr().items())


@pytest.mark.parametrize("device", ["cuda:99", "meta", "gpu", "cpu:x", 3.5])
def test_a_device_that_is_not_here_is_named(question: Question, device: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"device must"):
        load(question.weights, device=device)
    with pytest.raises(ValueError, match=r"device must"):
        train_model(CONFIG, question.dataset, tmp_path, device=device, progress=False)
    assert not list(tmp_path.iterdir())
