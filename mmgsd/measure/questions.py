"""The questions of an evaluation and a trained model's answers to them, compared with the truth; no baselines."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset, sample_pairs
from mmgsd.match.heatmap import read_heatmap
from mmgsd.match.matcher import Matcher
from mmgsd.match.mixture import Mixture
from mmgsd.measure.metrics import LISTS, compute_mode_lists, compute_query_errors
from mmgsd.model.heads import Outputs
from mmgsd.model.network import compute_cell_centres
from mmgsd.progress import ProgressBar

BATCH = 16  # images that are described at a time
AnswerFunction = Callable[[int, int, np.ndarray, np.ndarray], tuple[Mixture, Tensor]]


def choose_points(count: int, total: int) -> np.ndarray:
    """``count`` of ``total`` material points spread evenly in order; all of them where there are no more."""
    return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))


def draw_pairs(data: Dataset, config: EvaluateConfig) -> np.ndarray:
    """(pairs, 2) images of different simulations that show the object."""
    return sample_pairs(data.episode, config.pairs, np.random.default_rng(config.seed), present=data.present)


def ask(
    answer: AnswerFunction, data: Dataset, config: EvaluateConfig, group: str, progress: bool, name: str, modes: int = 0
) -> pd.DataFrame:
    """Ask ``answer`` every query and compare with the truth; one row a query."""
    pairs = draw_pairs(data, config)
    symmetry, points = data.group(group), choose_points(config.points, data.n_points)
    orbits = [symmetry.distinct_modes(int(p)) for p in points]
    count = np.array([len(o) for o in orbits])
    frames = []
    bar = ProgressBar(pairs, desc=f"evaluate {name}", disable=not progress, leave=False)
    for pair, (first, second) in enumerate(bar):
        fit, entropy = answer(first, second, data.xy[first, points], count.clip(min=modes))
        hidden = [int((~data.visible[second, o]).sum()) for o in orbits]
        columns = {
            "pair": pair, "image0": first, "image1": second, "point": points, "visible": data.visible[first, points],
            "n": count, "entropy": entropy.cpu().numpy(), "hidden": hidden, "outside": fit.outlier_mass.cpu().numpy(),
        }  # fmt: skip
        means, covariances, weights = (t.double().cpu().numpy() for t in (fit.modes, fit.covariances, fit.weights))
        lists = {name: np.empty(len(points), object) for name in LISTS}
        errors: dict[str, np.ndarray] = {}
        for n in np.unique(count):
            rows = np.flatnonzero(count == n)
            points_there = np.stack([orbits[r] for r in rows])
            true, seen = data.xy[second][points_there].astype(float), data.visible[second][points_there]
            for column, values in compute_query_errors(means[rows, :n], covariances[rows, :n], true, seen).items():
                errors.setdefault(column, np.zeros(len(points), values.dtype))[rows] = values
            of_modes = compute_mode_lists(means[rows, :n], covariances[rows, :n], weights[rows, :n], true)
            for column, values in of_modes.items():
                lists[column][rows] = [*values.astype(np.float32)]
        frames.append(pd.DataFrame(columns | lists | errors))
    return pd.concat(frames, ignore_index=True)


def model_answer(matcher: Matcher, data: Dataset, config: EvaluateConfig) -> AnswerFunction:
    """A trained model's answers about the pairs of ``config``, whose images are described at once."""
    descriptors = describe(matcher, data, np.unique(draw_pairs(data, config)))

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        """Modes and entropies (nats) of pixels ``xy`` of the first image."""
        outputs = descriptors[first], descriptors[second]
        return read_modes(matcher, *outputs, torch.from_numpy(xy), data.size, torch.from_numpy(n))

    return answer


def read_modes(
    matcher: Matcher, outputs0: Outputs, outputs1: Outputs, xy: Tensor, size: tuple[int, int], n: int | Tensor
) -> tuple[Mixture, Tensor]:
    """``n`` modes and entropies (nats) of source pixels (S, 2), of two images of one ``size``."""
    heatmap = matcher.compute_heatmaps(outputs0, outputs1, xy, size)
    return read_heatmap(heatmap, n, compute_cell_centres(size, heatmap.shape[-2:]), readout=matcher.readout)


def describe(matcher: Matcher, data: Dataset, indices: np.ndarray) -> dict[int, Outputs]:
    """What the network says of the images, computed once each; ValueError for images of another object."""
    if matcher.object and matcher.object != data.object:
        raise ValueError(f"weights must be of the object {data.object!r} of {data.folder}, got weights of "
                         f"{matcher.object!r}")  # fmt: skip
    described = {}
    for start in range(0, len(indices), BATCH):
        chosen = indices[start : start + BATCH]
        described |= zip(chosen.tolist(), matcher.describe([data.load_image(i) for i in chosen]), strict=True)
    return described


def measure_rmse(matcher: Matcher, data: Dataset, *, pairs: int = 60, points: int = 125, seed: int = 0) -> float:
    """Mean RMSE (px) of the queries with a visible source: one number on images kept apart for validation."""
    config = EvaluateConfig(pairs=pairs, points=points, seed=seed)
    return measure_mean_error(model_answer(matcher, data, config), matcher, data, config)


def measure_mean_error(answer: AnswerFunction, matcher: Matcher, data: Dataset, config: EvaluateConfig) -> float:
    """Mean RMSE (px) of the answers to queries with a visible source."""
    queries = ask(answer, data, config, matcher.config.group, False, "")
    return float(queries.rmse_px[queries.visible].mean())
