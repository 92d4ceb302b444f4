"""Calibration on simulations that were held out from training: a heatmap's scale, and what modes promise.

    python -m mmgsd calibrate WEIGHTS --data FOLDER         adds it to weights that are trained; their tensors stay
    python -m mmgsd calibrate WEIGHTS --unseen FOLDER …     by images of other simulations, how modes are read as well

The tables of a `Calibration` are read from all pairs; its errors are those of each half by the tables of the other.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

from mmgsd.checks import read_count, read_flag
from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset, hold_out, join_datasets, load_dataset, load_parts, sample_pairs
from mmgsd.match.matcher import Matcher
from mmgsd.measure.questions import ask, choose_points, describe, measure_mean_error, model_answer
from mmgsd.measure.readout import choose_readout
from mmgsd.measure.uncertainty import (
    RADII_PX,
    compute_confidence_error,
    compute_coverage_error,
    get_distances,
    get_modes,
    measure_modes,
    recalibrate,
)
from mmgsd.model.calibration import LEVELS, Calibration, Modes, compute_unit
from mmgsd.model.tensors import load_metadata, read_tensors, write_tensors
from mmgsd.model.weights import PLACES
from mmgsd.numerics import own_numerics

BANDWIDTHS = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of a contrastive heatmap, in margins
TEMPERATURES = (0.1, 10.0)  # range in which the calibrated one is sought
BATCH = 16  # images that are described at a time
PICTURES = 400  # at most, that an object's places are described by
PAIRS, LEAST_PAIRS = 400, 40  # drawn, and the fewest: half of these can just tell the level of 95 %


@own_numerics()
def calibrate_weights(
    weights: Path | str, dataset: Path | str, *, pairs: int = PAIRS, points: int = 40, overwrite: bool = False,
    progress: bool = True,
) -> Path:  # fmt: skip
    """Add to a file of weights what its modes hold on the training split's held-out simulations; returns its path.

    Only the metadata's ``calibration`` changes, and nothing where there is one, without ``overwrite``. ``dataset`` is
    the folder trained on. FileNotFoundError where there is none; ValueError for weights of other data, for those whose
    held-out images make too few ``pairs``, and for a file that is damaged or not ours.
    """
    overwrite = read_flag("overwrite", overwrite)
    weights = Path(weights)
    matcher, note = Matcher.load(weights), load_metadata(weights)
    if matcher.calibration is not None and not overwrite:
        return weights
    parts = load_parts(dataset, "train", also=matcher.config.also)
    data = join_datasets(*parts)
    if note.get("data") != data.fingerprint:
        raise ValueError(f"dataset must be the one that {weights} was trained on, of fingerprint {note.get('data')}: "
                         f"{dataset} has {data.fingerprint}")  # fmt: skip
    held_out = join_datasets(*(hold_out(part)[1] for part in parts))
    found = _calibrate(matcher, held_out, "dataset must hold out", pairs=pairs, points=points, progress=progress)
    return _keep(weights, {"calibration": found}, describe_places(matcher, held_out))


@own_numerics()
def calibrate_unseen(
    weights: Path | str, unseen: Sequence[Path | str], *, pairs: int = PAIRS, points: int = 40, overwrite: bool = False,
    progress: bool = True,
) -> Path:  # fmt: skip
    """The same by the test images of data sets that were not trained on, from which a reading is chosen first.

    ``unseen`` are their folders, one or more, of other seeds than those that the weights are measured on. The reading
    (`mmgsd.measure.readout.choose_readout`) is kept as ``power`` and ``sharpness``, the fingerprints as ``unseen``.
    Errors are those of `calibrate_weights`, and ValueError where a data set is that of the training.
    """
    overwrite, weights = read_flag("overwrite", overwrite), Path(weights)
    matcher, note = Matcher.load(weights), load_metadata(weights)
    if "unseen" in note and not overwrite:
        return weights
    parts = [load_dataset(place, "test") for place in unseen]
    for part in parts:
        if part.fingerprint == note.get("data"):
            raise ValueError(f"unseen must be data sets that {weights} was not trained on, got that: {part.folder}")
    data = join_datasets(*parts)
    how = {"points": points, "progress": progress}
    readout = choose_readout(matcher, data, progress=read_flag("progress", progress))
    found = _calibrate(matcher, data, "unseen must hold test", pairs=pairs, **how)
    chosen = {"power": repr(readout.exponent), "sharpness": repr(readout.mean_exponent)}
    note = {**chosen, "calibration": found, "unseen": json.dumps([p.fingerprint for p in parts])}
    return _keep(weights, note, describe_places(matcher, data))


def _calibrate(matcher: Matcher, data: Dataset, accepted: str, *, pairs: int, points: int, progress: bool) -> str:
    """What the modes hold on ``data``, as metadata; ValueError of too few images."""
    pairs, points = read_count("pairs", pairs, least=LEAST_PAIRS), read_count("points", points, least=1)
    found = calibrate_modes(matcher, data, pairs=pairs, points=points, progress=read_flag("progress", progress))
    if found is None:
        raise ValueError(f"{accepted} images for at least {LEAST_PAIRS} pairs, got {len(data)} images")
    return found.to_json()


def _keep(weights: Path, found: dict[str, str], places: Tensor) -> Path:
    """Add to a file's metadata, and the object's places; its network's tensors stay."""
    tensors, note = read_tensors(weights)
    return write_tensors(weights, tensors | {PLACES: places.cpu()}, note | found)


@own_numerics()
def describe_places(matcher: Matcher, data: Dataset, *, pictures: int = PICTURES, seed: int = 0) -> Tensor:
    """What `Matcher.find` asks about, (P, D): the mean descriptor of each material point and its like ones.

    Over ``pictures`` images of ``data``, drawn, or all that there are, where the points are seen. A point that none of
    them shows has that of the nearest one by number which is seen.
    """
    drawn = np.random.default_rng(seed).permutation(np.flatnonzero(data.present))[:pictures]
    total = torch.zeros(data.n_points, matcher.config.descriptor_dim, dtype=torch.float64)
    seen = torch.zeros(data.n_points, 1, dtype=torch.float64)
    for batch in np.array_split(drawn, -(-len(drawn) // BATCH)):
        for index, outputs in describe(matcher, data, batch).items():
            points = torch.from_numpy(data.visible[index])
            xy = torch.from_numpy(data.xy[index][data.visible[index]])
            total[points] += matcher.sample_sources(outputs, xy, data.size)[0].double().cpu()
            seen[points] += 1
    orbits = torch.from_numpy(data.group(matcher.config.group).permutations.T.copy())  # (P, G)
    mean, known = total[orbits].sum(1) / seen[orbits].sum(1).clamp(min=1), seen[orbits].sum((1, 2)) > 0
    numbers = torch.arange(data.n_points)
    nearest = (numbers[:, None] - numbers[known]).abs().argmin(1)
    return mean[known][nearest].float()


@own_numerics()
def calibrate_modes(
    matcher: Matcher, data: Dataset, *, pairs: int = PAIRS, points: int = 10, seed: int = 0, progress: bool = False
) -> Calibration | None:
    """What the modes of a matcher hold on ``data``, which must not have been trained on; None of too few images.

    Its errors are those of each half of the pairs under a calibration that is fitted to the other half. Leaves it set
    on the matcher and returns it.
    """
    shown = int(data.present.sum())
    config = EvaluateConfig(pairs=min(pairs, shown * (shown - 1)), points=points, seed=seed)
    if config.pairs < LEAST_PAIRS:
        return None
    queries = ask(model_answer(matcher, data, config), data, config, matcher.config.group, progress, "held out")
    if queries[queries.visible]["pair"].nunique() < LEAST_PAIRS:
        return None
    halves = [queries[queries["pair"] % 2 == half] for half in (0, 1)]
    errors = [check_calibration(fit_calibration(one), other) for one, other in (halves, halves[::-1])]
    ellipse, confidence = (round(float(error), 4) for error in np.mean(errors, 0))
    found = dataclasses.replace(fit_calibration(queries), ece_ellipse=ellipse, ece_confidence=confidence)
    matcher.calibration = found
    return matcher.calibration


def fit_calibration(queries: pd.DataFrame) -> Calibration:
    """The calibration of a table of answers (`mmgsd.measure.evaluation.load_queries`): its visible sources count."""
    rows = get_modes(queries)
    modes, distance = measure_modes(rows), rows.distance_px.to_numpy()
    powers = fit_powers(modes, distance)
    unit, pair = compute_unit(modes, powers), rows["pair"].to_numpy()
    ellipse = find_quantiles(np.sqrt(rows.mahalanobis2.to_numpy()) * modes.spread / unit, pair)
    radius = find_quantiles(distance / unit, pair)
    return Calibration(tuple(ellipse.tolist()), tuple(radius.tolist()), powers, pairs=len(np.unique(pair)))


def check_calibration(calibration: Calibration, queries: pd.DataFrame) -> tuple[float, float]:
    """Expected calibration errors of ellipses and confidences on answers that it was not fitted to."""
    ellipse = compute_coverage_error(get_distances(recalibrate(queries, calibration)))
    return ellipse, compute_confidence_error(get_modes(queries), calibration)


def find_quantiles(scores: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Scores (20,) that those of a new pair exceed with probability 1 - level at most, for each of `LEVELS`.

    ``scores`` (M,) and the ``pair`` (M,) that each is of. All pairs weigh the same, and one more, the new one's, is
    infinitely bad (Lee, Barber and Willett, "Distribution-free inference with hierarchical data", 2023).
    """
    _, number, count = np.unique(pair, return_inverse=True, return_counts=True)
    order = np.argsort(scores)
    mass = np.cumsum(1 / count[number][order]) / (len(count) + 1)
    place = np.searchsorted(mass, np.array(LEVELS) - 1e-9)
    return np.append(scores[order], np.inf)[place]


def fit_powers(modes: Modes, distance: np.ndarray) -> tuple[float, ...]:
    """Powers (3,) of M modes' spread, share and effective size in what their ``distance`` (M,) px is measured by.

    A logistic model tells of each radius of `RADII_PX` whether the distance is within it, from the logarithms of all;
    the most likely one's slopes, by the radius', are the powers.
    """
    radii = np.log(RADII_PX)  # (R,)
    within = np.log(np.maximum(distance, 1e-6))[:, None] <= radii
    known = np.stack([*(np.log(np.maximum(each, 1e-6)) for each in modes), np.ones(len(distance))], 1)  # (M, 4)

    def measure(slopes: np.ndarray) -> float:
        """Negative log-likelihood of the logistic model, with a little weight decay."""
        logits = slopes[0] * radii + (known @ slopes[1:])[:, None]
        return float(np.mean(np.logaddexp(0, logits) - within * logits)) + 1e-6 * float(slopes @ slopes)

    slopes = minimize(measure, [1.0, -1.0, 0.0, 0.0, 0.0]).x
    if slopes[0] < 1e-3:  # no radius tells anything: the spread is all there is
        return 1.0, 0.0, 0.0
    return tuple(float(np.clip(round(-slope / slopes[0], 4), -3, 3)) for slope in slopes[1:4])


@own_numerics()
def calibrate_bandwidth(matcher: Matcher, data: Dataset, *, pairs: int = 8, points: int = 80, seed: int = 0) -> float:
    """The heatmap bandwidth with the least mean error on ``data``: contrastive descriptors have no scale.

    Leaves it set on the matcher and returns it (descriptor units).
    """
    config, errors = EvaluateConfig(pairs=pairs, points=points, seed=seed), {}
    answer = model_answer(matcher, data, config)
    for bandwidth in (matcher.config.margin * b for b in BANDWIDTHS):
        matcher.bandwidth = bandwidth
        errors[bandwidth] = measure_mean_error(answer, matcher, data, config)
    matcher.bandwidth = min(errors, key=errors.get)
    return matcher.bandwidth


@own_numerics()
def calibrate_temperature(
    matcher: Matcher, data: Dataset, *, pairs: int = 32, points: int = 40, seed: int = 0
) -> float:
    """The temperature with the least negative log-likelihood of the true matches on ``data`` (Guo et al., ICML 2017).

    ``data`` must not have been trained on. Leaves it set on the matcher and returns it.
    """
    chosen = sample_pairs(data.episode, pairs, np.random.default_rng(seed), present=data.present)
    descriptors, points = describe(matcher, data, np.unique(chosen)), choose_points(points, data.n_points)
    orbits = data.group(matcher.config.group).permutations[:, points].T  # (S, G)
    matcher.temperature, logits, true = 1.0, [], []
    for first, second in chosen:
        seen = data.visible[first, points]
        xy = torch.from_numpy(data.xy[first, points[seen]])
        heatmap = matcher.compute_heatmaps(descriptors[first], descriptors[second], xy, data.size)
        logits.append(heatmap.flatten(1).clamp(min=1e-38).log())
        true.append(_find_cells(data.xy[second][orbits[seen]], data.size, heatmap.shape[-2:]))
    logits, true = torch.cat(logits), torch.from_numpy(np.concatenate(true)).to(logits[0].device)

    def measure(log_temperature: float) -> float:
        """Negative log-likelihood of the true matches."""
        return -float((logits / np.exp(log_temperature)).log_softmax(-1).gather(1, true).mean())

    best = minimize_scalar(measure, bounds=np.log(TEMPERATURES), method="bounded", options={"xatol": 0.01})
    matcher.temperature = float(np.exp(best.x))
    return matcher.temperature


def _find_cells(xy: np.ndarray, size: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """Number (…) in a (h, w) grid of the cell that each pixel (…, 2) of an image of ``size`` lies in, or is nearest."""
    column, row = (
        np.floor((xy[..., k] + 0.5) * (shape[1 - k] / size[k])).astype(int).clip(0, shape[1 - k] - 1) for k in (0, 1)
    )
    return row * shape[1] + column
