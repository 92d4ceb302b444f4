"""The stage that measures what a network says beside its descriptors: masks, hidden matches, objects not there."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import torch

from mmgsd.checks import read_flag
from mmgsd.config import EvaluateConfig, digest
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.files import is_kept, write_json
from mmgsd.match.matcher import Matcher
from mmgsd.measure.evaluation import read_results
from mmgsd.measure.metrics import assign_modes
from mmgsd.measure.questions import choose_points, describe, draw_pairs, read_modes
from mmgsd.measure.uncertainty import compute_auroc
from mmgsd.model.heads import Outputs, look_up
from mmgsd.progress import ProgressBar

MEASURES = ("mask_iou", "auroc_on_object", "auroc_visible", "auroc_absent", "auroc_absent_textile",
            "auroc_absent_clutter")  # fmt: skip
PIXELS = 500  # random ones of each image that are asked whether they show the object


def evaluate_heads(
    weights: Path | str, dataset: Path | str, config: EvaluateConfig, out: Path | str, *,
    overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Measure a model's heads on the test images and write ``out`` (JSON); one of the same question is returned.

    ``mask_iou``, the mean over images that show the object; ``auroc_on_object`` of random pixels; ``auroc_visible`` of
    modes, by whether the true match paired with each is seen; ``auroc_absent`` of images, by whether they lack the
    object, and the same of those that show another textile, and of those with other clutter alone. null where the test
    images hold only one kind. Of weights that learnt no heads, ``heads`` is false and all are null. ValueError for
    weights of another object, FileNotFoundError where there are none.
    """
    overwrite, progress, out = read_flag("overwrite", overwrite), read_flag("progress", progress), Path(out)
    matcher, data = Matcher.load(weights), load_dataset(dataset, "test")
    question = {"weights": hashlib.sha256(Path(weights).read_bytes()).hexdigest(), "data": data.fingerprint,
                "labels": data.info.get("labels_sha256", ""), "config": digest(config)}  # fmt: skip
    if not overwrite and is_kept(out, lambda path: read_results(path, depth=0).get("question") == question):
        return out
    measures = measure_heads(matcher, data, config, progress=progress)
    return write_json(out, {**measures, "heads": matcher.config.heads, "images": len(data), "question": question})


def measure_heads(
    matcher: Matcher, data: Dataset, config: EvaluateConfig, *, progress: bool = False
) -> dict[str, float | None]:
    """The measures of `evaluate_heads`."""
    if not matcher.config.heads:
        return dict.fromkeys(MEASURES)
    outputs = describe(matcher, data, np.arange(len(data)))
    values = (
        measure_mask_iou(outputs, data),
        compute_auroc(*_ask_pixels(outputs, data, np.random.default_rng(config.seed))),
        compute_auroc(*_ask_modes(matcher, outputs, data, config, progress)),
        *_measure_absent(np.array([-float(outputs[index].presence) for index in range(len(data))]), data),
    )
    return {n: round(float(v), 4) if np.isfinite(v) else None for n, v in zip(MEASURES, values, strict=True)}


def _measure_absent(score: np.ndarray, data: Dataset) -> list[float]:
    """AUROC of images (N,) without the object: all of them, with another textile, with other things alone."""
    things = data.labels.get("things", pd.Series("", data.labels.index)).fillna("")
    textile = things.str.contains("textile").to_numpy(bool)
    kinds = (np.ones(len(data), bool), textile, ~textile)
    return [compute_auroc(score[kind | data.present], ~data.present[kind | data.present]) for kind in kinds]


def measure_mask_iou(outputs: dict[int, Outputs], data: Dataset) -> float:
    """Mean intersection over union of the masks, over the images that show the object; NaN of none."""
    shares = []
    for index in np.flatnonzero(data.present):
        predicted = cv2.resize(outputs[index].mask.cpu().numpy(), data.size, interpolation=cv2.INTER_LINEAR) > 0
        true = data.load_mask(index)
        shares.append((predicted & true).sum() / max(1, (predicted | true).sum()))
    return float(np.mean(shares)) if shares else np.nan


def _ask_pixels(outputs: dict[int, Outputs], data: Dataset, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """How likely random pixels of each image show the object, and whether they do: (N PIXELS,) each."""
    scores, true = [], []
    for index in range(len(data)):
        xy = rng.integers(0, data.size, (PIXELS, 2))
        scores.append(look_up(None, outputs[index].mask, xy, data.size))
        true.append(data.load_mask(index)[xy[:, 1], xy[:, 0]])
    return np.concatenate(scores), np.concatenate(true)


def _ask_modes(
    matcher: Matcher, outputs: dict[int, Outputs], data: Dataset, config: EvaluateConfig, progress: bool
) -> tuple[np.ndarray, np.ndarray]:
    """How likely each mode of visible sources is seen, and whether the true match paired with it is: (M,) each."""
    points, group = choose_points(config.points, data.n_points), data.group(matcher.config.group)
    orbits = group.permutations[:, points].T  # (P, n)
    scores, true = [np.empty(0)], [np.empty(0, bool)]
    for first, second in ProgressBar(draw_pairs(data, config), desc="heads", disable=not progress, leave=False):
        seen = data.visible[first, points]
        xy, orbit = torch.from_numpy(data.xy[first, points[seen]]), orbits[seen]
        described = outputs[first], outputs[second]
        modes = read_modes(matcher, *described, xy, data.size, orbits.shape[1])[0].modes
        visible = matcher.compute_visible(*described, xy, modes, (data.size, data.size))
        paired = assign_modes(modes.double().cpu().numpy(), data.xy[second][orbit].astype(float))  # of each true match
        scores.append(np.take_along_axis(visible.cpu().numpy(), paired, 1).ravel())
        true.append(data.visible[second][orbit].ravel())
    return np.concatenate(scores), np.concatenate(true)
