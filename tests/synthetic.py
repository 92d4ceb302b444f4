"""Synthetic data sets, drawn without Blender: filled squares and thick curves with exact labels."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from mmgsd.config import DEFAULT_GROUP, IMAGE_SIZE
from mmgsd.dataset_format import FORMAT
from mmgsd.images import encode_image, encode_mask
from mmgsd.symmetry import GRID_GROUPS, LINE_GROUPS, load_group, load_mirror

CLOTH_SIDE_PX = 240.0  # of every synthetic cloth, seen from above


def write_tiny_dataset(parent: Path, *, object: str = "cloth", n_train: int = 4, n_test: int = 2) -> Path:
    """A data set in the on-disk format: filled squares or thick curves, two views of each simulation."""
    folder, rng = parent / object, np.random.default_rng(0)
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    draw, (width, height) = {"cloth": _draw_cloth, "rope": _draw_rope}[object], IMAGE_SIZE[object]
    rows = []
    for index in range(n_train + n_test):
        xy, visible, mask = draw(width, height, rng)
        image = np.full((height, width, 3), rng.integers(0, 80, 3), dtype=np.uint8)
        image[mask] = rng.integers(120, 255, 3)
        image[mask] += (np.argwhere(mask).sum(1, keepdims=True) % 32).astype(np.uint8) // 8
        row = {"file": f"images/{index:05d}.webp", "mask": f"masks/{index:05d}.png"}
        (folder / row["file"]).write_bytes(encode_image(image))
        (folder / row["mask"]).write_bytes(encode_mask(mask))
        split = "train" if index < n_train else "test"
        row |= {"split": split, "episode": index // 2 + 100 * (split == "test"), "view": index % 2}
        row |= {"xy": xy.astype(np.float32).ravel(), "visible": visible, "state": "flat"}
        rows.append(row | {"intrinsics": np.eye(3).ravel(), "camera_pose": np.eye(4).ravel()})
    pd.DataFrame(rows).to_parquet(folder / "labels.parquet", index=False)
    groups = GRID_GROUPS if object == "cloth" else LINE_GROUPS
    info = {
        "format": FORMAT,
        "object": object,
        "size": [width, height],
        "symmetry": {name: load_group(object, name).permutations.tolist() for name in groups},
        "mirror": load_mirror(object).tolist(),
        "default_group": DEFAULT_GROUP[object],
        "config": {},
        "images": {"train": n_train, "test": n_test},
        "versions": {},
    }
    (folder / "dataset.json").write_text(json.dumps(info))
    return folder


def _draw_cloth(width: int, height: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat square, turned at random about the image's centre; all points visible."""
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    axis = np.linspace(-0.5, 0.5, 25) * CLOTH_SIDE_PX
    flat = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)  # (625, 2), index r * 25 + c
    xy = flat @ turn.T + [(width - 1) / 2, (height - 1) / 2]
    mask = np.zeros((height, width), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.rint(xy[[0, 24, 624, 600]]).astype(np.int32), 1)
    return xy, np.ones(len(xy), dtype=bool), mask.astype(bool)


def _draw_rope(width: int, height: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A thick sine wave of random phase; every seventh point is marked hidden."""
    x = np.linspace(80, width - 80, 625)
    xy = np.column_stack([x, height / 2 + 90 * np.sin(x / 60 + rng.uniform(0, 6))])
    mask = np.zeros((height, width), dtype=np.uint8)
    cv2.polylines(mask, [np.rint(xy).astype(np.int32)], isClosed=False, color=1, thickness=15)
    return xy, np.arange(625) % 7 > 0, mask.astype(bool)
