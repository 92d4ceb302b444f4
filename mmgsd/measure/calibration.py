"""Calibration on images that were not trained on: a heatmap's scale, how modes are read, and what they promise.

    python -m mmgsd calibrate WEIGHTS --data FOLDER         adds it to weights that are trained; their tensors stay
    python -m mmgsd calibrate WEIGHTS --unseen FOLDER …     by images of other simulations, how modes are read as well

The tables of a `Calibration` are read from all pairs; its errors are those of each half by the tables of the other.
A reading (`mmgsd.match.em.ModeReadout`) counts by what a robot can grasp: `mmgsd.measure.photographs` asks the
same of photographs, which choose nothing.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.optimize import minimize, minimize_scalar
from torch import Tensor

from mmgsd.checks import read_count, read_flag
from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset, hold_out, join_datasets, load_dataset, load_parts
from mmgsd.match.em import ModeReadout
from mmgsd.match.match import RADIUS_PX
from mmgsd.match.matcher import Matcher
from mmgsd.match.mixture import fit_modes
from mmgsd.measure import uncertainty
from mmgsd.measure.metrics import compute_query_errors
from mmgsd.measure.questions import BATCH, ask, choose_points, describe, draw_pairs, measure_mean_error, model_answer
from mmgsd.model.calibration import LEVELS, Calibration, Modes, compute_unit
from mmgsd.model.network import compute_cell_centres
from mmgsd.model.tensors import load_metadata, read_tensors, write_tensors
from mmgsd.model.weights import PLACES
from mmgsd.numerics import own_numerics
from mmgsd.progress import ProgressBar

BANDWIDTHS = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of a contrastive heatmap, in margins
TEMPERATURES = (0.1, 10.0)  # range in which the calibrated one is sought
PICTURES = 400  # at most, that an object's places are described by
POWERS, SHARPNESSES = (1.0, 1.25, 1.5, 2.0), (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)  # of readings that are tried
ALLOWED = 1.05  # times the RMSE of modes that are read as they are
WIDENED = (1.0, 1.2, 1.5, 2.0)  # times the likeliest temperature
SHRINKAGES = (0.0, 0.25, 0.5, 0.75, 1.0)
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
    matcher.places = describe_places(matcher, held_out)
    how = {"pairs": pairs, "points": points, "progress": progress}
    return _calibrate(weights, matcher, held_out, {}, "dataset must hold out", **how)


@own_numerics()
def calibrate_unseen(
    weights: Path | str, unseen: Sequence[Path | str], *, pairs: int = PAIRS, points: int = 40, overwrite: bool = False,
    progress: bool = True,
) -> Path:  # fmt: skip
    """The same by the test images of data sets that were not trained on, from which a reading is chosen first.

    ``unseen`` are their folders, one or more, of other seeds than those that the weights are measured on. The reading
    (`choose_temperature`, `choose_shrinkage`, `choose_readout`) is kept as ``temperature``, ``shrinkage``, ``power``
    and ``sharpness``, the fingerprints as ``unseen``.
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
    matcher.places, matcher.shrinkage = describe_places(matcher, data), 0.0
    choose_temperature(matcher, data)
    choose_shrinkage(matcher, data)
    readout = choose_readout(matcher, data, progress=read_flag("progress", progress))
    chosen = {"temperature": repr(matcher.temperature), "shrinkage": repr(matcher.shrinkage),
              "power": repr(readout.exponent), "sharpness": repr(readout.mean_exponent),
              "unseen": json.dumps([part.fingerprint for part in parts])}  # fmt: skip
    how = {"pairs": pairs, "points": points, "progress": progress}
    return _calibrate(weights, matcher, data, chosen, "unseen must hold test", **how)


def _calibrate(
    weights: Path, matcher: Matcher, data: Dataset, chosen: dict[str, str], accepted: str, *,
    pairs: int, points: int, progress: bool,
) -> Path:  # fmt: skip
    """Add to a file of weights what was ``chosen``, what its modes hold on ``data``, and the matcher's places."""
    pairs, points = read_count("pairs", pairs, least=LEAST_PAIRS), read_count("points", points, least=1)
    calibration = calibrate_modes(matcher, data, pairs=pairs, points=points, progress=read_flag("progress", progress))
    if calibration is None:
        raise ValueError(f"{accepted} images for at least {LEAST_PAIRS} pairs, got {len(data)} images")
    tensors, note = read_tensors(weights)
    tensors |= {PLACES: matcher.places.cpu()}
    return write_tensors(weights, tensors, {**note, **chosen, "calibration": calibration.to_json()})


def choose_temperature(matcher: Matcher, data: Dataset, *, pairs: int = 60, points: int = 40) -> float:
    """The temperature with the least mean error on ``data``: the likeliest (`calibrate_temperature`) or a higher one.

    Modes are fitted better to heatmaps that are wider than likelihood wants them, and probabilities are calibrated
    anyway. ``data`` must not have been trained on. Leaves it set on the matcher and returns it.
    """
    likely, errors = calibrate_temperature(matcher, data), {}
    config = EvaluateConfig(pairs=pairs, points=points)
    answer = model_answer(matcher, data, config)
    for temperature in (likely * factor for factor in WIDENED):
        matcher.temperature = temperature
        errors[temperature] = measure_mean_error(answer, matcher, data, config)
    matcher.temperature = min(errors, key=errors.get)
    return matcher.temperature


def choose_shrinkage(matcher: Matcher, data: Dataset, *, pairs: int = 120, points: int = 40) -> float:
    """The share of `SHRINKAGES` with the least mean error on ``data``, which must not have been trained on.

    By it what a pixel is asked about with moves towards the places that it looks like (`Matcher.sample_sources`).
    Leaves it set on the matcher, which must know the object's places, and returns it.
    """
    config, errors = EvaluateConfig(pairs=pairs, points=points), {}
    answer = model_answer(matcher, data, config)
    for share in SHRINKAGES:
        matcher.shrinkage = share
        errors[share] = measure_mean_error(answer, matcher, data, config)
    matcher.shrinkage = min(errors, key=errors.get)
    return matcher.shrinkage


@own_numerics()
def describe_places(matcher: Matcher, data: Dataset) -> Tensor:
    """What `Matcher.find` asks about, (P, D): the mean descriptor of each material point and its like ones.

    Over `PICTURES` images of ``data``, drawn, or all that there are, where the points are seen. A point that none of
    them shows has that of the nearest one by number which is seen.
    """
    drawn = np.random.default_rng(0).permutation(np.flatnonzero(data.present))[:PICTURES]
    total = torch.zeros(data.n_points, matcher.config.descriptor_dim, dtype=torch.float64)
    seen = torch.zeros(data.n_points, 1, dtype=torch.float64)
    for batch in np.array_split(drawn, -(-len(drawn) // BATCH)):
        for index, outputs in describe(matcher, data, batch).items():
            points = torch.from_numpy(data.visible[index])
            xy = torch.from_numpy(data.xy[index][data.visible[index]])
            total[points] += matcher.sample_sources(outputs, xy, data.size, shrink=False)[0].double().cpu()
            seen[points] += 1
    orbits = torch.from_numpy(data.group(matcher.config.group).permutations.T.copy())  # (P, G)
    mean, is_seen = total[orbits].sum(1) / seen[orbits].sum(1).clamp(min=1), seen[orbits].sum((1, 2)) > 0
    numbers = torch.arange(data.n_points)
    nearest = (numbers[:, None] - numbers[is_seen]).abs().argmin(1)
    return mean[is_seen][nearest].float()


def choose_readout(
    matcher: Matcher, data: Dataset, *, pairs: int = 120, points: int = 40, progress: bool = False
) -> ModeReadout:
    """The reading that finds the most matches that are seen in ``data``, which must not have been trained on.

    Of `POWERS` and `SHARPNESSES` that with the largest found share less the spurious one, as `count_seen` counts them,
    among those whose RMSE is at most `ALLOWED` times what it is without. Leaves it set on the matcher and returns it.
    """
    questions = list(_ask_seen(matcher, data, EvaluateConfig(pairs=pairs, points=points)))
    plain = ModeReadout(matcher.readout.shape_prior)
    readouts = [dataclasses.replace(plain, exponent=a, mean_exponent=b) for a in POWERS for b in SHARPNESSES]
    bar = ProgressBar(readouts, desc="choose a reading", disable=not progress, leave=False)
    quality = {readout: measure_readout(questions, readout, data.size) for readout in bar}
    allowed = {readout: gain for readout, (rmse, gain) in quality.items() if rmse <= ALLOWED * quality[plain][0]}
    matcher.readout = max(allowed, key=allowed.get)
    return matcher.readout


def _ask_seen(
    matcher: Matcher, data: Dataset, config: EvaluateConfig
) -> Iterator[tuple[Tensor, np.ndarray, np.ndarray]]:
    """Of each pair the points seen in its first image: heatmaps (S, h, w), true matches (S, n, 2), which are seen."""
    chosen, points = draw_pairs(data, config), choose_points(config.points, data.n_points)
    outputs, group = describe(matcher, data, np.unique(chosen)), data.group(matcher.config.group).permutations
    points = points[[len(np.unique(group[:, point])) == len(group) for point in points]]  # none of a symmetry's centre
    for first, second in chosen:
        seen_points = points[data.visible[first, points]]
        if len(seen_points):
            xy, orbits = torch.from_numpy(data.xy[first, seen_points]), group[:, seen_points].T  # (S, 2), (S, n)
            heatmaps = matcher.compute_heatmaps(outputs[first], outputs[second], xy, data.size)
            yield heatmaps, data.xy[second][orbits].astype(float), data.visible[second][orbits]


def measure_readout(
    questions: list[tuple[Tensor, np.ndarray, np.ndarray]], readout: ModeReadout, size: tuple[int, int]
) -> tuple[float, float]:
    """Mean RMSE in px, and mean found share less the spurious one, on questions about images of ``size``."""
    rows = []
    for heatmaps, true, seen in questions:
        fit = fit_modes(heatmaps, true.shape[1], *compute_cell_centres(size, heatmaps.shape[-2:]), readout=readout)
        modes, covariances = (t.double().cpu().numpy() for t in (fit.modes, fit.covariances))
        rows.append((compute_query_errors(modes, covariances, true)["rmse_px"], *count_seen(modes, true, seen)))
    rmse_px, found_share, spurious = (float(np.concatenate(values).mean()) for values in zip(*rows, strict=True))
    return rmse_px, found_share - spurious


def count_seen(modes: np.ndarray, true: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares found and spurious (Q,) of the Q queries with a match that is seen.

    ``modes`` and ``true`` (S, n, 2) px, ``seen`` (S, n) bool. Found: of the seen matches those with a mode within
    `RADIUS_PX`. Spurious: of the k most probable modes, k matches being seen, those twice as far from all of them.
    """
    any_seen = seen.any(1)
    modes, true, seen = modes[any_seen], true[any_seen], seen[any_seen]
    distance = np.linalg.norm(modes[:, :, None] - true[:, None], axis=-1)  # (Q, modes, matches)
    count = seen.sum(1)
    found_share = ((distance.min(1) < RADIUS_PX) & seen).sum(1) / count
    far = np.where(seen[:, None], distance, np.inf).min(2) > 2 * RADIUS_PX  # (Q, modes)
    first = np.arange(modes.shape[1]) < count[:, None]
    return found_share, (far & first).sum(1) / count


@own_numerics()
def calibrate_modes(
    matcher: Matcher, data: Dataset, *, pairs: int = PAIRS, points: int = 10, progress: bool = False
) -> Calibration | None:
    """What the modes of a matcher hold on ``data``, which must not have been trained on; None of too few images.

    Its errors are those of each half of the pairs under a calibration that is fitted to the other half. Leaves it set
    on the matcher and returns it.
    """
    count = int(data.present.sum())
    config = EvaluateConfig(pairs=min(pairs, count * (count - 1)), points=points)
    if config.pairs < LEAST_PAIRS:
        return None
    queries = ask(model_answer(matcher, data, config), data, config, matcher.config.group, progress, "held out")
    if queries[queries.visible]["pair"].nunique() < LEAST_PAIRS:
        return None
    halves = [queries[queries["pair"] % 2 == half] for half in (0, 1)]
    errors = [check_calibration(fit_calibration(one), other) for one, other in (halves, halves[::-1])]
    ellipse, confidence = (round(float(error), 4) for error in np.mean(errors, 0))
    matcher.calibration = dataclasses.replace(fit_calibration(queries), ece_ellipse=ellipse, ece_confidence=confidence)
    return matcher.calibration


def fit_calibration(queries: pd.DataFrame) -> Calibration:
    """The calibration of a table of answers (`mmgsd.measure.evaluation.load_queries`): its visible sources count."""
    rows = uncertainty.get_modes(queries)
    modes, distance = uncertainty.measure_modes(rows), rows.distance_px.to_numpy()
    powers = fit_powers(modes, distance)
    unit, pair = compute_unit(modes, powers), rows["pair"].to_numpy()
    ellipse = find_quantiles(np.sqrt(rows.mahalanobis2.to_numpy()) * modes.spread / unit, pair)
    radius = find_quantiles(distance / unit, pair)
    return Calibration(tuple(ellipse.tolist()), tuple(radius.tolist()), powers, pairs=len(np.unique(pair)))


def check_calibration(calibration: Calibration, queries: pd.DataFrame) -> tuple[float, float]:
    """Expected calibration errors of ellipses and confidences on answers that it was not fitted to."""
    distances = uncertainty.get_distances(uncertainty.recalibrate(queries, calibration))
    modes = uncertainty.get_modes(queries)
    return uncertainty.compute_coverage_error(distances), uncertainty.compute_confidence_error(modes, calibration)


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

    A logistic model tells of each radius of `uncertainty.RADII_PX` whether the distance is within it, from the
    logarithms of all; the most likely one's slopes, by the radius', are the powers.
    """
    radii = np.log(uncertainty.RADII_PX)  # (R,)
    within = np.log(np.maximum(distance, 1e-6))[:, None] <= radii
    predictors = np.stack([*(np.log(np.maximum(each, 1e-6)) for each in modes), np.ones(len(distance))], 1)  # (M, 4)

    def measure(slopes: np.ndarray) -> float:
        """Negative log-likelihood of the logistic model, with a little weight decay."""
        logits = slopes[0] * radii + (predictors @ slopes[1:])[:, None]
        return float(np.mean(np.logaddexp(0, logits) - within * logits)) + 1e-6 * float(slopes @ slopes)

    slopes = minimize(measure, [1.0, -1.0, 0.0, 0.0, 0.0]).x
    if slopes[0] < 1e-3:  # no radius tells anything: the spread is all there is
        return 1.0, 0.0, 0.0
    return tuple(float(np.clip(round(-slope / slopes[0], 4), -3, 3)) for slope in slopes[1:4])


@own_numerics()
def calibrate_bandwidth(matcher: Matcher, data: Dataset, *, pairs: int = 8, points: int = 80) -> float:
    """The heatmap bandwidth with the least mean error on ``data``: contrastive descriptors have no scale.

    Leaves it set on the matcher and returns it (descriptor units).
    """
    config, errors = EvaluateConfig(pairs=pairs, points=points), {}
    answer = model_answer(matcher, data, config)
    for bandwidth in (matcher.config.margin * b for b in BANDWIDTHS):
        matcher.bandwidth = bandwidth
        errors[bandwidth] = measure_mean_error(answer, matcher, data, config)
    matcher.bandwidth = min(errors, key=errors.get)
    return matcher.bandwidth


@own_numerics()
def calibrate_temperature(matcher: Matcher, data: Dataset, *, pairs: int = 32, points: int = 40) -> float:
    """The temperature with the least negative log-likelihood of the true matches on ``data`` (Guo et al., ICML 2017).

    ``data`` must not have been trained on. Leaves it set on the matcher and returns it.
    """
    chosen = draw_pairs(data, EvaluateConfig(pairs=pairs))
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
