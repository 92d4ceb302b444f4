"""What the paper's figures are drawn from, small enough to be kept with the results: errors summed up, an example."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from mmgsd.dataset import Dataset
from mmgsd.files import DamagedFileError, write_bytes
from mmgsd.match.heatmap import read_heatmap
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher
from mmgsd.measure.metrics import ErrorSummary, summarise_errors
from mmgsd.measure.shipped import PLAIN
from mmgsd.model.network import compute_cell_centres

EXAMPLE_QUALITY = 90  # of the example's images, JPEG
TRUE = "true{}"  # the tensors of the queries' true matches: true, true1, …
_SUMMARY = ("mean_px", "histogram")  # and asked, which all methods share
_IMAGES = ("image0", "image1")
_CELLS = "{}/cells"  # tensor of a method's heatmaps: its modes are fitted to them when they are read


@dataclass(frozen=True)
class FigureData:
    """One object's part of the paper's figures."""

    errors: dict[str, ErrorSummary]  # {method: its errors}
    object_size_px: float  # diagonal of the bounding box, mean over the test images
    answers: dict[str, Match]  # {method: its answers about the example}
    true: list[np.ndarray]  # (n, 2) px each, the matches of the example's queries; of old files of the first alone


def choose_example(queries: pd.DataFrame, points: Sequence[int]) -> tuple[int, int]:
    """The two images with the median error of ``points``, of those pairs that show most of them, then of their matches.

    So the pictures show what the answer is to be, where any pair does.
    """
    groups = queries[queries.point.isin(points)].groupby("pair")
    rows = groups.agg({"image0": "first", "image1": "first", "visible": "sum", "hidden": "sum", "rmse_px": "mean"})
    rows = rows[rows.visible == rows.visible.max()]
    rows = rows[rows.hidden == rows.hidden.min()].sort_values("rmse_px")
    row = rows.iloc[len(rows) // 2]
    return int(row.image0), int(row.image1)


def choose_plain(data: Dataset, point: int = 0) -> tuple[int, int]:
    """The first image of a flat cloth or a straight rope, and the first of another state: what needs no explanation.

    Both show all matches of the material ``point``.
    """
    visible = data.visible[:, data.group().distinct_modes(point)].all(1)
    plain = data.labels.state.isin(PLAIN).to_numpy()
    pair = {f"of state {' or '.join(PLAIN)}": visible & plain, "of another state": visible & ~plain}
    for name, images in pair.items():
        if not images.any():
            raise ValueError(f"data must have an image {name} that shows all matches of point {point}: {data.folder}")
    return tuple(int(images.argmax()) for images in pair.values())


def ask_plain(matcher: Matcher, data: Dataset, point: int = 0) -> Match:
    """The answer about ``point`` of the pair that needs no explanation (`choose_plain`)."""
    first, second = choose_plain(data, point)
    return matcher.match(data.load_image(first), data.load_image(second), data.xy[first, [point]])


def choose_contrast(data: FigureData) -> int:
    """The query of the example about which the methods differ most, of those whose true matches are known.

    By the spread, over the methods, of the mean distance of the true matches to the nearest mode.
    """
    spreads = []
    for query, true in enumerate(data.true):
        modes = (match.modes[query] for match in data.answers.values())
        errors = [np.nanmin(np.linalg.norm(true[:, None] - mode, axis=-1), 1).mean() for mode in modes]
        spreads.append(np.ptp(errors))
    return int(np.argmax(spreads))


def compute_object_size(masks: Sequence[np.ndarray]) -> float:
    """Diagonal of the object's bounding box in px, mean over (H, W) bool masks."""
    spans = [np.ptp(np.argwhere(mask), axis=0) + 1 for mask in masks]
    return float(np.linalg.norm(spans, axis=1).mean())


def gather_figure_data(
    queries: Mapping[str, pd.DataFrame], weights: Mapping[str, Path], data: Dataset, *, points: Sequence[int]
) -> FigureData:
    """Join all methods' ``queries`` with the trained models' answers about one example pair (`choose_example`).

    ``queries`` must hold "mmgsd", which chooses the example; ``points`` are the material points asked about in it.
    """
    first, second = choose_example(queries["mmgsd"], points)
    images, xy = (data.load_image(first), data.load_image(second)), data.xy[first, points]
    true = [data.xy[second][data.group().distinct_modes(point)] for point in points]
    count = [len(matches) for matches in true]  # of all methods, as the tables ask for
    answers = {method: Matcher.load(path).match(*images, xy, n=count) for method, path in weights.items()}
    errors = {method: summarise_errors(table) for method, table in queries.items()}
    size = compute_object_size([data.load_mask(i) for i in range(len(data))])
    return FigureData(errors, size, answers, true)


def keep_stored(data: FigureData, path: Path, methods: Collection[str]) -> FigureData:
    """``data`` with those of ``methods`` that it lacks and ``path`` holds, answered on another machine.

    Their errors are kept where both have the same queries, their answers where the example is the same as well.
    """
    if not path.is_file():
        return data
    stored = load_figure_data(path)
    same = np.array_equal(_first(data.errors).asked, _first(stored.errors).asked)
    example = [(_first(data.answers).xy, _first(stored.answers).xy), (data.true[0], stored.true[0])]
    same_example = same and all(np.array_equal(ours, theirs) for ours, theirs in example)
    missing = set(methods) - set(data.errors)
    errors = {method: value for method, value in stored.errors.items() if same and method in missing}
    answers = {method: value for method, value in stored.answers.items() if same_example and method in missing}
    return dataclasses.replace(data, errors=errors | data.errors, answers=answers | data.answers)


def _first(values: Mapping[str, Any]) -> Any:
    return next(iter(values.values()))


def save_figure_data(data: FigureData, path: Path) -> Path:
    """Write a safetensors file; ValueError where the methods did not answer the same queries."""
    counts, example = _first(data.errors).asked, _first(data.answers)
    tensors = {"asked": counts} | {TRUE.format(k or ""): true for k, true in enumerate(data.true)}
    for name in _IMAGES:
        image = cv2.cvtColor(getattr(example, name), cv2.COLOR_RGB2BGR)
        tensors[name] = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, EXAMPLE_QUALITY])[1]
    for method, summary in data.errors.items():
        if not np.array_equal(summary.asked, counts):
            raise ValueError(f"errors[{method!r}] must answer the same queries as the other methods")
        tensors |= {f"errors/{method}/{name}": getattr(summary, name) for name in _SUMMARY}
    tensors |= {"xy": example.xy, "n": np.isfinite(example.modes[..., 0]).sum(1)}
    tensors |= {_CELLS.format(method): np.asarray(match.cells, np.float32) for method, match in data.answers.items()}
    note = {"methods": list(data.errors), "models": list(data.answers), "object_size_px": data.object_size_px}
    packed = save({n: np.ascontiguousarray(t) for n, t in tensors.items()}, {"figures": json.dumps(note)})
    return write_bytes(path, packed)


def _fit_answer(images: Mapping[str, np.ndarray], xy: np.ndarray, cells: np.ndarray, n: np.ndarray) -> Match:
    """The answer that heatmaps (S, h, w) of queries with (S,) matches give, as all methods of the tables are read."""
    centres = compute_cell_centres(images["image1"].shape[1::-1], cells.shape[1:])
    fit, entropy = read_heatmap(torch.from_numpy(cells), torch.from_numpy(n), centres)
    values = {name: getattr(fit, name).numpy() for name in ("modes", "weights", "covariances", "outlier_mass")}
    return Match(**images, xy=xy, cells=cells, entropy=entropy.numpy(), **values)


def load_figure_data(path: Path, *, answers: bool = True) -> FigureData:
    """Read what `save_figure_data` wrote; FileNotFoundError, or ValueError for another or a damaged file.

    Without ``answers``, whose modes are fitted anew, they are left out.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: run notebooks/04_evaluate.ipynb with run=True for this preset")
    try:
        with safe_open(path, "np") as file:
            note = json.loads(file.metadata()["figures"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        summaries = {m: [tensors[f"errors/{m}/{name}"] for name in _SUMMARY] for m in note["methods"]}
        errors = {m: ErrorSummary(tensors["asked"], *summary) for m, summary in summaries.items()}
        images = {n: cv2.cvtColor(cv2.imdecode(tensors[n], cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB) for n in _IMAGES}
        fitted = {m: _fit_answer(images, tensors["xy"], tensors[_CELLS.format(m)], tensors["n"])
                  for m in note["models"] if answers}  # fmt: skip
        true = [tensors[TRUE.format(k or "")] for k in range(sum(name.startswith("true") for name in tensors))]
        return FigureData(errors, float(note["object_size_px"]), fitted, true)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, cv2.error) as error:
        remedy = "restore it (it may be in git), or run notebooks/04_evaluate.ipynb with run=True for this preset"
        raise DamagedFileError(f"{path} does not hold the data of figures ({error}): {remedy}") from error
