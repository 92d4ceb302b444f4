"""The evaluation stage: the same questions for every method, answered into one table of queries each."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor
from tqdm.auto import tqdm

from mmgsd.checks import read_count, read_flag
from mmgsd.config import EvaluateConfig, digest
from mmgsd.dataset import Dataset, load_dataset, sample_pairs
from mmgsd.dataset_format import UNREADABLE
from mmgsd.files import DamagedFileError, read_json, saying_what_stays, set_aside, write_json, writing
from mmgsd.learn.heads import Outputs
from mmgsd.learn.network import compute_cell_centres
from mmgsd.match.baselines import BASELINES, BaselineMatcher
from mmgsd.match.matcher import Matcher, check_scales, read_heatmap
from mmgsd.match.mixture import Mixture, check_modes
from mmgsd.measure.metrics import aggregate, compute_mahalanobis2, compute_query_errors

CHANCE = ("centre", "random")
BANDWIDTHS = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of a contrastive heatmap, in margins
MEASURES = "2"  # to be raised where the same answers are measured in another way
TEMPERATURES = (0.1, 10.0)  # range in which the calibrated one is sought

Answer = Callable[[int, int, np.ndarray, np.ndarray], tuple[Mixture, Tensor]]


def evaluate_model(
    weights: Path, dataset: Path, config: EvaluateConfig, out: Path, *, group: str = "", modes: int = 0,
    temperature: float | None = None, overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Ask a trained model all queries and write the table ``out`` (Parquet).

    A table of the same weights, data set and configuration is returned as it is.

    The true matches are those of ``group`` ("" is the object's own), whatever the model was taught. As many modes are
    fitted as a query has true matches, but at least ``modes``: of these the most probable ones are the answer.
    ``temperature`` of the heatmaps is the model's own, calibrated one unless given. ValueError for ``modes`` that are
    not from 0 to `mmgsd.config.MAX_MODES`, for another ``temperature`` than a number above 0, and for weights that
    were taught another object than the data set shows.
    """
    overwrite, progress = read_flag("overwrite", overwrite), read_flag("progress", progress)
    modes, out = read_count("modes", modes), Path(out)
    if modes:
        check_modes(modes)
    check_scales(temperature=temperature)
    data = load_dataset(dataset, "test")
    method = hashlib.sha256(Path(weights).read_bytes()).hexdigest()
    method += "" if temperature is None else f" at temperature {temperature:g}"
    method += f" of {modes} modes" if modes else ""
    question = _describe_question(data, config, group, method)
    if not overwrite and _is_answered(out, question):
        return out
    matcher = Matcher.load(weights)
    if temperature is not None:
        matcher.temperature = temperature
    answer = _model_answer(matcher, data, config)
    return _answer_all(answer, data, config, group, out, question, progress, modes)


def evaluate_baseline(
    method: str, dataset: Path, config: EvaluateConfig, out: Path, *,
    group: str = "", overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Ask hand-made descriptors, or chance (``centre``, ``random``), the same queries; ValueError for others."""
    if method not in BASELINES + CHANCE:
        raise ValueError(f"method must be one of {BASELINES + CHANCE}, got {method!r}")
    overwrite, progress = read_flag("overwrite", overwrite), read_flag("progress", progress)
    out = Path(out)
    data = load_dataset(dataset, "test")
    question = _describe_question(data, config, group, method)
    if not overwrite and _is_answered(out, question):
        return out
    answer = _chance_answer(method, data) if method in CHANCE else _classical_answer(method, data)
    return _answer_all(answer, data, config, group, out, question, progress)


def load_queries(path: Path) -> pd.DataFrame:
    """One method's table, a row a query.

    pair, image0, image1, point; visible (source), n and hidden (true matches), rmse_px, nearest_px, best_px, swapped,
    pck@…, entropy (nats), outside (share of the heatmap), mahalanobis2 (a list of n).
    FileNotFoundError, or DamagedFileError, which names the file.
    """
    try:
        queries = pd.read_parquet(path, page_checksum_verification=True)
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise DamagedFileError(f"{path} is damaged or no Parquet table ({error}): use overwrite=True") from error
    missing = [column for column in ("visible", "rmse_px") if column not in queries]
    if missing:
        raise DamagedFileError(f"{path} lacks the columns {missing}: use overwrite=True")
    return queries


def summarise(tables: dict[str, Path]) -> dict[str, dict[str, float]]:
    """{method: {metric: value}} over queries with a visible source, and over all of them with the suffix ``_all``."""
    summary = {}
    for method, path in tables.items():
        queries = load_queries(path)
        everything = {f"{name}_all": value for name, value in aggregate(queries).items()}
        summary[method] = aggregate(queries[queries.visible]) | everything
    return summary


def write_results(results: dict, path: Path) -> Path:
    """Write nested results as JSON, whole or not at all."""
    return write_json(path, results)


def read_results(path: Path, *, depth: int = 1) -> dict[str, Any]:
    """What `write_results` wrote, {} where there is none: a dictionary of dictionaries, ``depth`` times one in another.

    DamagedFileError where the file says something else: rows that only it holds would be lost if it were written anew.
    """
    if not path.is_file():
        return {}
    remedy = "restore it (it may be in git), or remove it and lose what no table of answers here gives again"
    values = read_json(path, remedy=remedy)
    if not _is_nested(values, depth):
        raise DamagedFileError(f"{path} holds no table of results: {remedy}")
    return values


def _is_nested(values: Any, depth: int) -> bool:
    return isinstance(values, dict) and (depth == 0 or all(_is_nested(value, depth - 1) for value in values.values()))


def measure_rmse(matcher: Matcher, data: Dataset, *, pairs: int = 60, points: int = 125, seed: int = 0) -> float:
    """Mean RMSE (px) of the queries with a visible source: one number on images kept apart for validation."""
    config = EvaluateConfig(pairs=pairs, points=points, seed=seed)
    return _measure_rmse(_model_answer(matcher, data, config), matcher, data, config)


def _measure_rmse(answer: Answer, matcher: Matcher, data: Dataset, config: EvaluateConfig) -> float:
    queries = _ask(answer, data, config, matcher.config.group, False, "")
    return float(queries.rmse_px[queries.visible].mean())


def calibrate_bandwidth(matcher: Matcher, data: Dataset, *, pairs: int = 8, points: int = 80, seed: int = 0) -> float:
    """The heatmap bandwidth with the least mean error on ``data``: contrastive descriptors have no scale.

    Leaves it set on the matcher and returns it (descriptor units).
    """
    config, errors = EvaluateConfig(pairs=pairs, points=points, seed=seed), {}
    answer = _model_answer(matcher, data, config)
    for bandwidth in (matcher.config.margin * b for b in BANDWIDTHS):
        matcher.bandwidth = bandwidth
        errors[bandwidth] = _measure_rmse(answer, matcher, data, config)
    matcher.bandwidth = min(errors, key=errors.get)
    return matcher.bandwidth


def calibrate_temperature(
    matcher: Matcher, data: Dataset, *, pairs: int = 32, points: int = 40, seed: int = 0
) -> float:
    """The temperature with the least negative log-likelihood of the true matches on ``data`` (Guo et al., ICML 2017).

    ``data`` must not have been trained on. Leaves it set on the matcher and returns it.
    """
    chosen = sample_pairs(data.episode, pairs, np.random.default_rng(seed), present=data.present)
    descriptors, points = _describe(matcher, data, np.unique(chosen)), choose_points(points, data.n_points)
    orbits = data.group(matcher.config.group).permutations[:, points].T  # (S, G)
    matcher.temperature, logits, true = 1.0, [], []
    for first, second in chosen:
        asked = data.visible[first, points]
        xy = torch.from_numpy(data.xy[first, points[asked]])
        heatmap = matcher.compute_heatmaps(descriptors[first], descriptors[second], xy, data.size)
        logits.append(heatmap.flatten(1).clamp(min=1e-38).log())
        true.append(_find_cells(data.xy[second][orbits[asked]], data.size, heatmap.shape[-2:]))
    logits, true = torch.cat(logits), torch.from_numpy(np.concatenate(true)).to(logits[0].device)

    def measure(log_temperature: float) -> float:
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


def choose_points(count: int, total: int) -> np.ndarray:
    """``count`` of ``total`` material points spread evenly in order; all of them where there are no more."""
    return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))


def _ask(
    answer: Answer, data: Dataset, config: EvaluateConfig, group: str, progress: bool, name: str, modes: int = 0
) -> pd.DataFrame:
    """Ask ``answer`` every query and compare with the truth; one row a query."""
    pairs = _draw_pairs(data, config)
    symmetry, points = data.group(group), choose_points(config.points, data.n_points)
    orbits = [symmetry.distinct_modes(int(p)) for p in points]
    count = np.array([len(o) for o in orbits])
    frames = []
    for pair, (first, second) in enumerate(tqdm(pairs, desc=f"evaluate {name}", disable=not progress, leave=False)):
        fit, entropy = answer(first, second, data.xy[first, points], count.clip(min=modes))
        frame = pd.DataFrame({"pair": pair, "image0": first, "image1": second, "point": points})
        frame = frame.assign(visible=data.visible[first, points], n=count, entropy=entropy.cpu().numpy())
        hidden = [int((~data.visible[second, o]).sum()) for o in orbits]
        frame = frame.assign(hidden=hidden, outside=fit.outside.cpu().numpy())
        means, covariances = (t.double().cpu().numpy() for t in (fit.modes, fit.covariances))
        frame["mahalanobis2"] = None
        for n in np.unique(count):
            rows = np.flatnonzero(count == n)
            true = data.xy[second][np.stack([orbits[r] for r in rows])].astype(float)
            for column, values in compute_query_errors(means[rows, :n], covariances[rows, :n], true).items():
                frame.loc[rows, column] = values
            distances = compute_mahalanobis2(means[rows, :n], covariances[rows, :n], true)
            frame.loc[rows, "mahalanobis2"] = pd.Series(list(distances.astype(np.float32)), rows)
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)


def _draw_pairs(data: Dataset, config: EvaluateConfig) -> np.ndarray:
    """(pairs, 2) images of different simulations that show the object."""
    return sample_pairs(data.episode, config.pairs, np.random.default_rng(config.seed), present=data.present)


def _model_answer(matcher: Matcher, data: Dataset, config: EvaluateConfig) -> Answer:
    descriptors = _describe(matcher, data, np.unique(_draw_pairs(data, config)))

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        heatmap = matcher.compute_heatmaps(descriptors[first], descriptors[second], torch.from_numpy(xy), data.size)
        centres = compute_cell_centres(data.size, heatmap.shape[-2:])
        return read_heatmap(heatmap, torch.from_numpy(n), centres, roundness=matcher.config.roundness)

    return answer


def _classical_answer(method: str, data: Dataset) -> Answer:
    images = [data.load_image(i) for i in range(len(data))]
    masks = [data.load_mask(i) for i in range(len(data))]
    matcher, last = BaselineMatcher(method), np.array(data.size, dtype=np.float32) - 0.5

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        xy = np.clip(xy, -0.5, last)  # a corner may stick out of the image: the networks take its nearest pixel as well
        heatmap, centres = matcher.compute_heatmaps(images[first], images[second], xy, masks[second])
        return read_heatmap(heatmap, torch.from_numpy(n), centres)

    return answer


def _chance_answer(method: str, data: Dataset) -> Answer:
    """All modes at the centre of the object's pixels, or each at a random one of them."""
    pixels = [np.argwhere(data.load_mask(i))[:, ::-1].astype(float) for i in range(len(data))]
    rng = np.random.default_rng(0)

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        shape, on_object = (len(xy), n.max()), pixels[second]
        centre = np.broadcast_to(on_object.mean(0), (*shape, 2))
        modes = centre if method == "centre" else on_object[rng.integers(len(on_object), size=shape)]
        unknown = torch.full((*shape, 2, 2), torch.nan)
        fit = Mixture(torch.tensor(modes), torch.ones(shape) / shape[1], unknown, unknown[:, 0, 0, 0])
        return fit, torch.full((len(xy),), float(np.log(len(on_object))))

    return answer


def _describe(matcher: Matcher, data: Dataset, indices: np.ndarray, *, batch: int = 16) -> dict[int, Outputs]:
    """What the network says of the images, computed once each; ValueError for images of another object."""
    if matcher.object and matcher.object != data.object:
        raise ValueError(f"weights must be of the object {data.object!r} of {data.folder}, got weights of "
                         f"{matcher.object!r}")  # fmt: skip
    return dict(_describe_batches(matcher, data, indices, batch))


def _describe_batches(
    matcher: Matcher, data: Dataset, indices: np.ndarray, batch: int
) -> Iterator[tuple[int, Outputs]]:
    for start in range(0, len(indices), batch):
        chosen = indices[start : start + batch]
        yield from zip(chosen.tolist(), matcher.describe([data.load_image(i) for i in chosen]), strict=True)


def _describe_question(data: Dataset, config: EvaluateConfig, group: str, method: str) -> dict[str, str]:
    """What a table of answers depends on; kept in it, so that a stale one is noticed."""
    asked = {"data": data.fingerprint, "config": digest(config), "group": data.group(group).name}
    return {**asked, "method": method, "measures": MEASURES}


def _is_answered(out: Path, question: dict[str, str]) -> bool:
    """Whether a table answers the question; a damaged one is set aside."""
    try:
        return out.is_file() and load_queries(out).attrs == question
    except DamagedFileError:
        set_aside(out)
        return False


def _answer_all(
    answer: Answer, data: Dataset, config: EvaluateConfig, group: str, out: Path, question: dict[str, str],
    progress: bool, modes: int = 0,
) -> Path:  # fmt: skip
    """Ask every query and write the table of answers, each page of it with a checksum."""
    with saying_what_stays(lambda: f"stopped: nothing of {out} is kept, tables that are finished are"):
        table = _ask(answer, data, config, group, progress, out.stem, modes)
    table.attrs = question
    with writing(out) as aside:
        table.to_parquet(aside, index=False, write_page_checksum=True)
    return out
