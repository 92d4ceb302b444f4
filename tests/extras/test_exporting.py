"""ONNX: what a program without torch gets, beside what the library says itself."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch

import mmgsd
from mmgsd.extras.exporting import export_onnx
from mmgsd.match.matcher import Matcher
from mmgsd.model.network import has_bfloat16

ROOT = Path(__file__).parents[2]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "onnx.md").read_text("utf-8"), re.DOTALL)
IMAGES = [ROOT / "data/sample/cloth/images" / f"test_{name}_00.webp" for name in ("000007", "000002")]


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return mmgsd.load("cloth", device="cpu")


@pytest.fixture(scope="module")
def said(matcher: Matcher, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the program of docs/onnx.md ends with, and the folder it ran in."""
    folder, names = tmp_path_factory.mktemp("program"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "data").symlink_to(ROOT / "data")
        assert export_onnx(matcher, "cloth.onnx") < 1e-5  # a str is a path
        for block in BLOCKS:
            exec(block, names)
    return names | {"folder": folder}


def test_the_program_of_the_docs_matches_as_the_library_does(matcher: Matcher, said: dict[str, Any]) -> None:
    images, xy = [mmgsd.read_image(path) for path in IMAGES], said["xy"]
    matcher.network.reduced_precision = False
    try:
        pair = matcher.prepare(*images)
    finally:
        matcher.network.reduced_precision = True
    match = pair.match(xy)
    np.testing.assert_allclose(said["heat"], match.cells, atol=1e-4 * match.cells.max())
    sizes = tuple(image.shape[1::-1] for image in images)
    modes = torch.from_numpy(said["modes"])[None]
    visible = matcher.compute_visible(*pair.outputs, torch.from_numpy(xy), modes, sizes)
    np.testing.assert_allclose(said["visible"], visible[0], atol=1e-3)
    np.testing.assert_allclose(1 - said["present"], match.absent[0], atol=1e-3)
    np.testing.assert_allclose(said["outputs1"]["mask"], pair.outputs[1].mask, atol=1e-2)
    apart = np.linalg.norm(said["modes"][:, None] - match.modes[0], axis=-1)
    assert apart.min(0).max() < 16 and apart.min(1).max() < 16  # px: a cell


def test_the_difference_from_describe_is_bfloat16s_where_the_cpu_has_it(matcher: Matcher, said: dict[str, Any]) -> None:
    descriptors = matcher.describe([mmgsd.read_image(IMAGES[0])])[0].descriptors.numpy()
    difference = np.abs(said["outputs0"]["descriptors"] - descriptors).max() / np.abs(descriptors).max()
    assert difference < 1e-2 and (difference > 1e-5) == has_bfloat16(torch.device("cpu"))


def test_it_can_be_quantised(said: dict[str, Any]) -> None:
    whole, small = (said["folder"] / name for name in ("cloth.onnx", "cloth-int8.onnx"))
    assert small.stat().st_size < 0.5 * whole.stat().st_size
    session = onnxruntime.InferenceSession(small, providers=["CPUExecutionProvider"])
    image = np.random.default_rng(0).random((1, 3, 96, 128), np.float32)
    for got, expected in zip(*(one.run(None, {"image": image}) for one in (session, said["session"])), strict=True):
        assert np.abs(got - expected).max() < 0.3 * np.abs(expected).max()


def test_the_least_size_is_said_and_is_one(matcher: Matcher, said: dict[str, Any]) -> None:
    least = int(said["known"]["least_px"])
    for height, width in ((least, least), (least, least + 8), (least + 16, least)):
        image = torch.rand((1, 3, height, width))
        with torch.inference_mode():
            expected = matcher.describe_inputs(image).numpy()
        (got, *_) = said["session"].run(None, {"image": image.numpy()})
        np.testing.assert_allclose(got, expected, atol=1e-2 * np.abs(expected).max())
