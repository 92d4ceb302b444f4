"""Trained networks as ONNX, for programs without torch."""

from __future__ import annotations

import copy
import json
import os
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from mmgsd.matching import Matcher
from mmgsd.network import compute_input_size

TOLERANCE = 1e-3  # of a descriptor, relative to the largest


def export_onnx(matcher: Matcher, path: Path) -> float:
    """Write the network as ``path``: ``image`` (B, 3, h, w) in [0, 1] of its input size, ``descriptors`` (B, C, …) out.

    C is D; or 2 D where the training's ``roles`` is 2: first those of a pixel that is asked about, then those of one
    that answers. The file's metadata hold ``input_size`` ("width height", px) and the training's ``config``. What
    onnxruntime makes of random images is compared with torch, both in single precision: returns the largest
    difference, relative to the largest value. ValueError for another ending than .onnx, RuntimeError where they differ
    by more than 1e-3.
    """
    if path.suffix != ".onnx":
        raise ValueError(f"path must end with .onnx, got {path}")
    width, height = compute_input_size(matcher.size, matcher.config.input_px)
    image = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(0))
    network, aside = copy.deepcopy(matcher.network).cpu().eval(), path.with_suffix(".tmp")
    network.reduced_precision = False
    path.parent.mkdir(parents=True, exist_ok=True)
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's older exporter, which needs no further package, says it is the older
        torch.onnx.export(
            network, (image[:1],), aside, dynamo=False, opset_version=17, input_names=["image"],
            output_names=["descriptors"], dynamic_axes={"image": {0: "batch"}, "descriptors": {0: "batch"}},
        )  # fmt: skip
        expected = network(image).numpy()
    model = onnx.load(aside)
    onnx.helper.set_model_props(
        model, {"input_size": f"{width} {height}", "config": json.dumps(asdict(matcher.config))}
    )
    onnx.save(model, aside)
    got = onnxruntime.InferenceSession(aside, providers=["CPUExecutionProvider"]).run(None, {"image": image.numpy()})
    difference = float(np.abs(got[0] - expected).max() / np.abs(expected).max())
    if not difference <= TOLERANCE:
        aside.unlink()
        raise RuntimeError(f"onnxruntime's descriptors differ from torch's by {difference:.1e}: {path} is not written")
    os.replace(aside, path)
    return difference
