"""Trained networks as ONNX, for programs without torch."""

from __future__ import annotations

import copy
import json
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from mmgsd.files import writing
from mmgsd.learn.network import compute_input_size
from mmgsd.match.matcher import Matcher

TOLERANCE = 1e-3  # of a descriptor, relative to the largest
STEP_PX = 8  # both sides of an input are multiples of it


def export_onnx(matcher: Matcher, path: Path) -> float:
    """Write what `Matcher.describe` does as ``path``: ``image`` (B, 3, H, W) in [0, 1], ``descriptors`` (B, C, …) out.

    H and W are any multiples of 8: resize an image, keeping its aspect, to about as many pixels as ``input_size`` has.
    The mean over quarter turns is part of the graph. C is D; or 2 D where the training's ``roles`` is 2: first those of
    a pixel that is asked about, then those of one that answers. The file's metadata hold ``input_size`` ("width
    height", px, of the training's images), ``multiple_of``, ``quarter_turns`` (averaged in the graph), ``modes``,
    ``temperature``, for contrastive descriptors ``bandwidth``, and the training's ``config``.

    What onnxruntime makes of random images of three shapes is compared with torch, both in single precision: returns
    the largest difference, relative to the largest value. ValueError for another ending than .onnx, RuntimeError where
    they differ by more than 1e-3; ``path`` is then as it was.
    """
    if path.suffix != ".onnx":
        raise ValueError(f"path must end with .onnx, got {path}")
    width, height = compute_input_size(matcher.size, matcher.config.input_px)
    network = _Described(matcher).eval()
    generator = torch.Generator().manual_seed(0)
    shapes = ((2, 3, height, width), (1, 3, width, height + STEP_PX), (1, 3, height + 2 * STEP_PX, width))
    images = [torch.rand(shape, generator=generator) for shape in shapes]
    with writing(path) as aside:
        _write(network, images[0][:1], aside, _describe(matcher, (width, height)))
        difference = max(_compare(network, aside, image) for image in images)
        if not difference <= TOLERANCE:
            raise RuntimeError(f"onnxruntime's descriptors differ from torch's by {difference:.1e}: {path} is not "
                               "written")  # fmt: skip
    return difference


class _Described(nn.Module):
    """What `Matcher.describe_inputs` does, in operations that ONNX has for images of any shape."""

    def __init__(self, matcher: Matcher) -> None:
        super().__init__()
        self.network, self.turns = copy.deepcopy(matcher.network).cpu().float(), matcher.turns
        self.network.reduced_precision = False

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, C, h, w)."""
        return sum(_turn(self.network(_turn(image, k)), -k) for k in range(self.turns)) / self.turns


def _turn(image: Tensor, quarters: int) -> Tensor:
    """As `torch.rot90` over the last two axes, which ONNX lacks."""
    quarters %= 4
    image = image.flip(2, 3) if quarters == 2 else image
    return image.transpose(2, 3).flip(2 if quarters == 1 else 3) if quarters % 2 else image


def _describe(matcher: Matcher, size: tuple[int, int]) -> dict[str, str]:
    """The file's metadata."""
    numbers = {"input_size": f"{size[0]} {size[1]}", "multiple_of": STEP_PX, "quarter_turns": matcher.turns,
               "modes": matcher.modes, "temperature": matcher.temperature}  # fmt: skip
    if matcher.bandwidth is not None:
        numbers["bandwidth"] = matcher.bandwidth
    return {name: str(value) for name, value in numbers.items()} | {"config": json.dumps(asdict(matcher.config))}


def _write(network: nn.Module, image: Tensor, path: Path, metadata: dict[str, str]) -> None:
    axes = {"image": {0: "batch", 2: "height", 3: "width"}, "descriptors": {0: "batch", 2: "rows", 3: "columns"}}
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's older exporter, which needs no further package, says it is the older
        torch.onnx.export(network, (image,), path, dynamo=False, opset_version=17, input_names=["image"],
                          output_names=["descriptors"], dynamic_axes=axes)  # fmt: skip
    model = onnx.load(path)
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, path)


def _compare(network: nn.Module, path: Path, image: Tensor) -> float:
    """The largest difference of the file's descriptors from torch's, relative to the largest value."""
    with torch.inference_mode():
        expected = network(image).numpy()
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (got,) = session.run(None, {"image": image.numpy()})
    if got.shape != expected.shape:
        return float("inf")
    return float(np.abs(got - expected).max() / np.abs(expected).max())
