"""Trained networks as ONNX, for programs without torch; docs/onnx.md shows how to match with them in NumPy."""

from __future__ import annotations

import copy
import json
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from mmgsd.files import atomic_write
from mmgsd.match.matcher import Matcher
from mmgsd.match.places import PLACE_TEMPERATURE
from mmgsd.model.network import compute_input_size
from mmgsd.numerics import own_numerics

TOLERANCE = {False: 1e-3, True: 1e-2}  # of an output, relative to its largest value; True: of weights in half precision
HALVED = 64  # numbers from which on a tensor is worth halving
STEP_PX = 8  # both sides of an input are multiples of it
FIELDS = {"present": "presence"}  # of `Outputs`, by the name of what a file gives
OUTPUTS = {  # what is exported of `Outputs`, and its axes that an image changes
    "descriptors": {0: "batch", 2: "rows", 3: "columns"},
    "mask": {0: "batch", 1: "mask_rows", 2: "mask_columns"},
    "surface": {0: "batch", 2: "rows", 3: "columns"},
    "present": {0: "batch"},
}


@own_numerics()
def export_onnx(matcher: Matcher, path: Path | str, *, half: bool = False) -> float:
    """Write what `Matcher.describe` does as ``path``: ``image`` (B, 3, H, W) in [0, 1], ``descriptors`` (B, C, …) out.

    H and W are multiples of 8 from `Matcher.least_px` on: resize an image, keeping its aspect, to about as many pixels
    as ``input_size`` has. The mean over quarter turns is part of the graph. C is D; or 2 D where the training's
    ``roles`` is 2: first those of a pixel that is asked about, then those of one that answers. Of weights with heads
    further outputs are logits, ``mask`` (B, hm, wm) and ``present`` (B,), and ``surface`` (B, K, h, w) for visibility.

    The file's metadata hold ``input_size`` ("width height", px, of the training's images), ``multiple_of``,
    ``least_px``, ``quarter_turns`` (averaged in the graph), ``modes``, ``temperature``, for contrastive descriptors
    ``bandwidth``, with heads the layers of ``judge``, which says what is visible, the training's ``config``, and with
    a ``Matcher.shrinkage`` the ``places`` that sources move towards (`describe_shrinkage`).

    What onnxruntime makes of random images of four shapes is compared with torch, both in single precision: returns the
    largest difference, relative to the largest value. On a CPU with bfloat16, which `Matcher.describe` takes for some
    of its layers, its descriptors differ from the file's by up to a hundredth. With ``half`` weights are stored in half
    precision, and computed with in single: half the size, on any machine. ValueError for another ending than .onnx,
    RuntimeError where they differ by more than 1e-3 in single precision, or of ``half`` 1e-2; ``path`` is then as it
    was.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"path must end with .onnx, got {path}")
    (width, height), least = compute_input_size(matcher.size, matcher.config.input_px), matcher.least_px
    network = _Described(matcher).eval()
    generator = torch.Generator().manual_seed(0)
    shapes = ((2, height, width), (1, width, height + STEP_PX), (1, height + 2 * STEP_PX, width), (1, least, least))
    images = [torch.rand((count, 3, *size), generator=generator, dtype=torch.float32) for count, *size in shapes]
    with atomic_write(path) as aside:
        _write(network, images[0][:1], aside, _describe(matcher, (width, height)), half)
        difference = max(_compare(network, aside, image) for image in images)
        if not difference <= TOLERANCE[half]:
            raise RuntimeError(f"onnxruntime's descriptors differ from torch's by {difference:.1e}: {path} is not "
                               "written")  # fmt: skip
    return difference


def describe_shrinkage(matcher: Matcher) -> dict[str, Any] | None:
    """What `mmgsd.match.places.shrink_sources` needs besides sources, as plain values; None where it does nothing."""
    if not matcher.shrinkage or matcher.places is None:
        return None
    return {"shrinkage": matcher.shrinkage, "temperature": PLACE_TEMPERATURE, "descriptors": matcher.places.tolist()}


class _Described(nn.Module):
    """What `Matcher.describe_inputs` does, in operations that ONNX has for images of any shape."""

    def __init__(self, matcher: Matcher) -> None:
        super().__init__()
        self.network, self.turns = copy.deepcopy(matcher.network).cpu().float(), matcher.turns
        self.network.reduced_precision = False
        self.names = ["descriptors"]
        if getattr(self.network, "heads", None):
            self.names, self.network.heads.present = list(OUTPUTS), _Product(self.network.heads.present)

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """(B, 3, H, W) to the outputs of ``names``."""
        outputs = [self.network.describe(_turn(image, k)) for k in range(self.turns)]
        turned = [[getattr(one, FIELDS.get(name, name)) for one in outputs] for name in self.names]
        return tuple(sum(_turn(value, -k) for k, value in enumerate(values)) / self.turns for values in turned)


class _Product(nn.Module):
    """A linear layer as a matrix product: quantising has no type for what a Gemm gives."""

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__()
        self.weight, self.bias = layer.weight, layer.bias

    def forward(self, x: Tensor) -> Tensor:
        """(…, inputs) to (…, outputs)."""
        return x @ self.weight.T + self.bias


def _turn(image: Tensor, quarters: int) -> Tensor:
    """As `torch.rot90` over the last two axes, which ONNX lacks; what has no such axes stays."""
    quarters %= 4
    if image.ndim < 3 or not quarters:
        return image
    image = image.flip(-2, -1) if quarters == 2 else image
    return image.transpose(-2, -1).flip(-2 if quarters == 1 else -1) if quarters % 2 else image


def _describe(matcher: Matcher, size: tuple[int, int]) -> dict[str, str]:
    """The file's metadata."""
    numbers = {"input_size": f"{size[0]} {size[1]}", "multiple_of": STEP_PX, "least_px": matcher.least_px,
               "quarter_turns": matcher.turns, "modes": matcher.num_modes,
               "temperature": matcher.temperature}  # fmt: skip
    if matcher.bandwidth is not None:
        numbers["bandwidth"] = matcher.bandwidth
    values = {"config": asdict(matcher.config)}
    if getattr(matcher.network, "heads", None):
        judge = matcher.network.heads.judge_layers
        values["judge"] = [[layer.weight.tolist(), layer.bias.tolist()] for layer in (judge[0], judge[2])]
    if places := describe_shrinkage(matcher):
        values["places"] = places
    return {name: str(value) for name, value in numbers.items()} | {n: json.dumps(v) for n, v in values.items()}


def _write(network: _Described, image: Tensor, path: Path, metadata: dict[str, str], half: bool) -> None:
    axes = {"image": {0: "batch", 2: "height", 3: "width"}, **{name: OUTPUTS[name] for name in network.names}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's older exporter, which needs no further package, says it is the older
        torch.onnx.export(network, (image,), path, dynamo=False, opset_version=17, input_names=["image"],
                          output_names=network.names, dynamic_axes=axes)  # fmt: skip
    model = onnx.load(path)
    _name_weights(model.graph)
    if half:
        _halve_weights(model.graph)
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, path)


def _name_weights(graph: onnx.GraphProto) -> None:
    """Give layers their weights themselves: torch puts an Identity between where one is used again, and quantising
    refuses that."""
    same = {weight.name: weight.name for weight in graph.initializer}
    nodes = []
    for node in graph.node:
        if node.op_type == "Identity" and node.input[0] in same:
            same[node.output[0]] = same[node.input[0]]
        else:
            node.input[:] = [same.get(name, name) for name in node.input]
            nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)


def _halve_weights(graph: onnx.GraphProto) -> None:
    """Store weights in half precision; runtimes cast them back when they load the file."""
    for k, weight in enumerate(graph.initializer):
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype == np.float32 and values.size >= HALVED:
            name = weight.name
            graph.initializer[k].CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
            graph.node.insert(0, onnx.helper.make_node("Cast", [f"{name}.half"], [name], to=onnx.TensorProto.FLOAT))


def _compare(network: _Described, path: Path, image: Tensor) -> float:
    """The largest difference of the file's outputs from torch's, relative to the largest value of each."""
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    differences = []
    for expected, got in zip(network(image), session.run(None, {"image": image.numpy()}), strict=True):
        expected = expected.numpy()
        same = got.shape == expected.shape
        differences.append(float(np.abs(got - expected).max() / np.abs(expected).max()) if same else float("inf"))
    return max(differences)
