"""The evaluation stage: the same questions for every method, answered into one table of queries each."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from mmgsd.checks import read_count, read_flag
from mmgsd.config import EvaluateConfig, digest
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.dataset_format import UNREADABLE
from mmgsd.files import DamagedFileError, atomic_write, is_kept, read_json, saying_what_stays, write_json
from mmgsd.match.baselines import BASELINES, EXTRACTORS, OPTIONAL, BaselineMatcher, FeatureMatcher
from mmgsd.match.em import AS_IT_IS, ModeReadout
from mmgsd.match.features import Extractor
from mmgsd.match.heatmap import check_scales, read_heatmap
from mmgsd.match.matcher import Matcher
from mmgsd.match.mixture import Mixture, check_modes
from mmgsd.measure.metrics import aggregate
from mmgsd.measure.questions import AnswerFunction, ask, model_answer

CHANCE = ("centre", "random")
ASKED = ["pair", "image0", "image1", "point", "visible", "n", "hidden"]  # columns that are the same for all methods
MEASURES = "3"  # to be raised where the same answers are measured in another way


def evaluate_model(
    weights: Path, dataset: Path, config: EvaluateConfig, out: Path, *, group: str = "", modes: int = 0,
    temperature: float | None = None, readout: ModeReadout | None = None, shrinkage: float | None = None,
    overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Ask a trained model all queries and write the table ``out`` (Parquet).

    A table of the same weights, data set and configuration is returned as it is.

    The true matches are those of ``group`` ("" is the object's own), whatever the model was taught. As many modes are
    fitted as a query has true matches, but at least ``modes``: of these the most probable ones are the answer.
    ``temperature`` of the heatmaps is the model's own, calibrated one unless given, and so are the ``readout`` of their
    modes and the ``shrinkage`` of sources. ValueError for ``modes`` that are not from 0 to `mmgsd.config.MAX_MODES`,
    for another ``temperature`` than a number above 0, and for weights that were taught another object than the data
    set shows.
    """
    modes = read_count("modes", modes)
    if modes:
        check_modes(modes)
    check_scales(temperature=temperature)
    method = hashlib.sha256(Path(weights).read_bytes()).hexdigest()
    method += "" if temperature is None else f" at temperature {temperature:g}"
    method += f" of {modes} modes" if modes else ""
    method += f" by {readout}" if readout else ""
    method += "" if shrinkage is None else f" shrunk by {shrinkage:g}"

    def make_answer(data: Dataset) -> AnswerFunction:
        """The weights' answers, read as they are asked to."""
        matcher = Matcher.load(weights)
        if temperature is not None:
            matcher.temperature = temperature
        if readout is not None:
            matcher.readout = readout
        if shrinkage is not None:
            matcher.shrinkage = shrinkage
        return model_answer(matcher, data, config)

    how = {"overwrite": overwrite, "progress": progress}
    return _answer_all(make_answer, method, dataset, config, out, group=group, modes=modes, **how)


def evaluate_baseline(
    method: str, dataset: Path, config: EvaluateConfig, out: Path, *,
    group: str = "", readout: ModeReadout = AS_IT_IS, overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Ask hand-made descriptors, or chance (``centre``, ``random``), the same queries; ValueError for others.

    ``readout`` of the descriptors' modes.
    """
    if method not in BASELINES + OPTIONAL + CHANCE:
        raise ValueError(f"method must be one of {BASELINES + CHANCE}, got {method!r}")
    label = method if readout == AS_IT_IS else f"{method} by {readout}"
    make_answer = partial(_chance_answer, method) if method in CHANCE else partial(_classical_answer, method, readout)
    return _answer_all(make_answer, label, dataset, config, out, group=group, overwrite=overwrite, progress=progress)


def load_queries(path: Path) -> pd.DataFrame:
    """One method's table, a row a query.

    pair, image0, image1, point; visible (source), n and hidden (true matches), rmse_px, nearest_px, best_px, swapped,
    pck@…, entropy (nats), outside (share of the heatmap), and lists of n: mahalanobis2, distance_px, spread_px, share
    (`mmgsd.measure.metrics.compute_mode_lists`).
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


def check_same_questions(tables: dict[str, pd.DataFrame]) -> None:
    """ValueError unless all methods of ``tables`` {method: queries} answered the same queries, in one order."""
    first, *others = tables
    for method in others:
        if not tables[method][ASKED].equals(tables[first][ASKED]):
            raise ValueError(f"tables must answer the same queries, got other ones of {method!r} than of {first!r}: "
                             "use overwrite=True")  # fmt: skip


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


def _classical_answer(method: str, readout: ModeReadout, data: Dataset) -> AnswerFunction:
    images = [data.load_image(i) for i in range(len(data))]
    masks = [data.load_mask(i) for i in range(len(data))]
    last = np.array(data.size, dtype=np.float32) - 0.5
    # images are kept, so each array is known again: a network says the same of it in every pair
    matcher = FeatureMatcher(_once(EXTRACTORS[method])) if method in EXTRACTORS else BaselineMatcher(method)

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        """Modes and entropies (nats) of pixels ``xy`` of the first image."""
        xy = np.clip(xy, -0.5, last)  # a corner may stick out of the image: the networks take its nearest pixel as well
        heatmap, centres = matcher.compute_heatmaps(images[first], images[second], xy, masks[second])
        return read_heatmap(heatmap, torch.from_numpy(n), centres, readout=readout)

    return answer


def _once(extract: Extractor) -> Extractor:
    """The same for arrays that stay as they are, each asked about once."""
    cache: dict[int, Any] = {}

    def extract_new(image: np.ndarray) -> Any:
        """What ``extract`` said of this array."""
        if id(image) not in cache:
            cache[id(image)] = extract(image)
        return cache[id(image)]

    return extract_new


def _chance_answer(method: str, data: Dataset) -> AnswerFunction:
    """All modes at the centre of the object's pixels, or each at a random one of them."""
    pixels = [np.argwhere(data.load_mask(i))[:, ::-1].astype(float) for i in range(len(data))]
    rng = np.random.default_rng(0)

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        """Modes and entropies (nats) of pixels ``xy`` of the first image."""
        shape, on_object = (len(xy), n.max()), pixels[second]
        centre = np.broadcast_to(on_object.mean(0), (*shape, 2))
        modes = centre if method == "centre" else on_object[rng.integers(len(on_object), size=shape)]
        unknown = torch.full((*shape, 2, 2), torch.nan)
        fit = Mixture(torch.tensor(modes), torch.ones(shape) / shape[1], unknown, unknown[:, 0, 0, 0])
        return fit, torch.full((len(xy),), float(np.log(len(on_object))))

    return answer


def _describe_question(data: Dataset, config: EvaluateConfig, group: str, method: str) -> dict[str, str]:
    """What a table of answers depends on; kept in it, so that a stale one is noticed."""
    question = {"data": data.fingerprint, "config": digest(config), "group": data.group(group).name}
    labels = data.info.get("labels_sha256", "")  # they can be corrected without being rendered anew
    return {**question, "labels": labels, "method": method, "measures": MEASURES}


def _answer_all(
    make_answer: Callable[[Dataset], AnswerFunction], method: str, dataset: Path, config: EvaluateConfig, out: Path, *,
    group: str, overwrite: bool, progress: bool, modes: int = 0,
) -> Path:  # fmt: skip
    """Ask every query, unless the table is there, and write it, each page of it with a checksum."""
    overwrite, progress = read_flag("overwrite", overwrite), read_flag("progress", progress)
    data, out = load_dataset(dataset, "test"), Path(out)
    question = _describe_question(data, config, group, method)
    if not overwrite and is_kept(out, lambda table: load_queries(table).attrs == question):
        return out
    with saying_what_stays(lambda: f"stopped: nothing of {out} is kept, tables that are finished are"):
        table = ask(make_answer(data), data, config, group, progress, out.stem, modes)
    table.attrs = question
    with atomic_write(out) as aside:
        table.to_parquet(aside, index=False, write_page_checksum=True)
    return out
