"""What weights, and what one would pick instead, do on clean renders, cluttered ones, others' and on photographs.

Others' renders are of one cloth whose material points' pixels are told. Their folder is as that of
`priyasundaresan/cloth-rendering` has its ``texture_images``: pictures ``000001_rgb.png``, …, and in
``knots_info.json``, by a picture's number, a list of the pixels of its 25 × 25 points, row by row: [[[x, y]], …].
The square at the left of each picture is asked about: each ordered pair, every second point of each row and column,
whether it is seen or not, and all its matches under ``c4``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from mmgsd.config import DEFAULT_GROUP, N_POINTS, EvaluateConfig, load_preset
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.dataset_format import SPLITS
from mmgsd.files import DamagedFileError, read_json
from mmgsd.images import read_image
from mmgsd.match.baselines import BaselineMatcher, FeatureMatcher
from mmgsd.match.em import AS_IT_IS, ModeReadout
from mmgsd.match.heatmap import read_heatmap
from mmgsd.match.match import RADIUS_PX, Match
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.match.places import NAMES
from mmgsd.measure import uncertainty
from mmgsd.measure.evaluation import evaluate_baseline, evaluate_model, load_queries
from mmgsd.measure.heads import MEASURES as HEADS
from mmgsd.measure.heads import evaluate_heads
from mmgsd.measure.metrics import aggregate, compute_query_errors
from mmgsd.measure.photographs import measure_answers, measure_photographs, read_photographs
from mmgsd.measure.questions import choose_points, describe, draw_pairs
from mmgsd.measure.regions import SIDE
from mmgsd.model.calibration import Calibration
from mmgsd.model.network import compute_cell_centres, name_hardware
from mmgsd.paths import Paths
from mmgsd.symmetry import load_group

SETS = ("paper", "workspace")  # presets whose test images are asked about
LEVEL = 0.9  # of the radii whose promise is checked
HEAD_PAIRS = 100  # of images whose modes are judged
NAMED_PAIRS, NAMED_POINTS = 60, 40  # of images, and material points that are asked about by a picture and by name
TIMED = 9  # questions, of which the median counts
PLAIN = ("flat", "straight")  # states of the objects
CLOTH_LABELS, CLOTH_PICTURES = "knots_info.json", "*_rgb.png"  # of others' renders
STEP = 2  # of the rows and columns of a cloth's points that are asked about in these
SIDE_POINTS = {"cloth": 25, "rope": 625}  # material points, the first ones, that lie along it


def measure_weights(
    name: str, root: Path, *, weights: Path | None = None, photographs: Path | None = None,
    cloth_renders: Path | None = None, presets: Sequence[str] = SETS, progress: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """The row of ``weights``, or of shipped ones: a dictionary a set of `SETS`, ``photographs``, ``milliseconds``.

    Of a set: `mmgsd.measure.metrics.aggregate` over visible sources, `mmgsd.measure.uncertainty.summarise_uncertainty`
    by the weights' own calibration, its ``reliability`` beside a Gaussian's, ``within_radius``, the share of modes with
    a true match within `Match.radius_px` (level 0.9), ``heads`` (`measure_heads`), and of weights that know their
    places ``asked`` (`measure_by_name`). ``milliseconds``: of one question about two images, and about
    two that are described already.
    ``presets`` are those whose images stand for `SETS`; without any, neither they nor the time are measured.
    ``cloth_renders`` of a cloth's weights: `measure_cloth_renders`.
    """
    file = weights or find_weights(name)
    matcher = Matcher.load(file)
    row = _describe_weights(file, matcher, calibrated=matcher.calibration is not None)
    for kind, preset in zip(SETS, presets, strict=bool(presets)):
        paths = Paths(root, preset)
        data, config = paths.dataset(matcher.object), load_preset(preset).evaluate
        table = evaluate_model(file, data, config, paths.queries(f"shipped-{name}"), progress=progress)
        heads = evaluate_heads(file, data, EvaluateConfig(pairs=HEAD_PAIRS), paths.queries(f"heads-{name}"),
                               progress=progress)  # fmt: skip
        row[kind] = _summarise(table, matcher) | {"heads": {key: read_json(heads)[key] for key in HEADS}}
        if matcher.places is not None:
            row[kind]["asked"] = measure_by_name(matcher, load_dataset(data, "test"))
    if photographs:
        row["photographs"] = measure_photographs(file, photographs, progress=progress)
    if cloth_renders and matcher.object == "cloth":
        row["cloth_renders"] = measure_cloth_renders(matcher, cloth_renders)
    return row | (_time_question(matcher, root) if presets else {})


def measure_by_name(
    matcher: Matcher, data: Dataset, *, pairs: int = NAMED_PAIRS, points: int = NAMED_POINTS
) -> dict[str, float]:
    """Mean RMSE (px) of the same questions ``by_picture``, of a first image that shows the point, and ``by_name``.

    Of the material points of `NAMES`, and ``points`` others. ``pairs`` are of images that show the object.
    """
    group, flat, errors = data.group(matcher.config.group), matcher.lay_flat(), {"by_picture": [], "by_name": []}
    numbers = np.unique([*NAMES[data.object].values(), *choose_points(points, data.n_points)])
    chosen = draw_pairs(data, EvaluateConfig(pairs=pairs))
    outputs = describe(matcher, data, np.unique(chosen))
    for first, second in chosen:
        seen = numbers[data.visible[first, numbers]]
        count = group.count_modes(seen)
        for n in np.unique(count):
            some = seen[count == n]
            true = data.xy[second][np.stack([group.distinct_modes(int(point)) for point in some])].astype(float)
            ways = {"by_picture": (outputs[first], data.xy[first, some], data.size),
                    "by_name": (flat.outputs, flat.look_up(some.tolist())[0], flat.image.shape[1::-1])}  # fmt: skip
            for name, (source, xy, size) in ways.items():
                heatmap = matcher.compute_heatmaps(source, outputs[second], torch.from_numpy(xy), size)
                centres = compute_cell_centres(data.size, heatmap.shape[-2:])
                fit, _ = read_heatmap(heatmap, int(n), centres, readout=matcher.readout)
                modes, covariances = (values.double().cpu().numpy() for values in (fit.modes, fit.covariances))
                errors[name].extend(compute_query_errors(modes, covariances, true)["rmse_px"])
    return {name: round(float(np.mean(values)), 2) for name, values in errors.items()}


def measure_read(
    name: str, root: Path, *, photographs: Path | None = None, cloth_renders: Path | None = None,
    presets: Sequence[str] = SETS, progress: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """The row of shipped weights whose modes are read otherwise: "cloth@1,1" with power 1 and sharpness 1, at means.

    A third number is the ``shrinkage`` of sources: "cloth@1,1,0" without any.
    `mmgsd.measure.metrics.aggregate` over visible sources of each of ``presets``, photographs and others' renders.
    ValueError for other numbers, FileNotFoundError for other weights.
    """
    weights, _, numbers = name.partition("@")
    file = find_weights(weights)
    matcher = Matcher.load(file)
    readout, matcher.shrinkage = parse_readout(numbers, matcher.readout, matcher.shrinkage)
    matcher.readout = readout
    row = _describe_weights(file, matcher)
    for preset in presets:
        paths = Paths(root, preset)
        data, out = paths.dataset(matcher.object), paths.queries(f"shipped-{name}")
        queries = load_queries(evaluate_model(file, data, load_preset(preset).evaluate, out, readout=readout,
                                              shrinkage=matcher.shrinkage, progress=progress))  # fmt: skip
        row[preset] = aggregate(queries[queries.visible])
    if photographs:
        row["photographs"] = measure_answers(matcher, read_photographs(photographs, matcher.object), progress=progress)
    if cloth_renders and matcher.object == "cloth":
        row["cloth_renders"] = measure_cloth_renders(matcher, cloth_renders)
    return row


def _describe_weights(file: Path, matcher: Matcher, **columns: Any) -> dict[str, Any]:
    """What a row says of its weights, and how they are read."""
    weights = {"object": matcher.object, "sha256": hashlib.sha256(file.read_bytes()).hexdigest(), **columns}
    readout = {"power": matcher.readout.exponent, "sharpness": matcher.readout.mean_exponent}
    return weights | readout | {"shrinkage": matcher.shrinkage}


def name_read(name: str, row: Mapping[str, Any]) -> str:
    """What a row read with its power and sharpness is called: "cloth-orb@1,6"; at means, by its name alone."""
    power, sharpness = row["power"], row["sharpness"]
    return name if power == sharpness == 1 else f"{name}@{power:g},{sharpness:g}"


def parse_readout(text: str, like: ModeReadout, shrinkage: float = 0.0) -> tuple[ModeReadout, float]:
    """The reading that "power,sharpness" says, as round as ``like``, and the shrinkage that a third number says.

    Without one ``shrinkage`` it is. ValueError for anything else.
    """
    try:
        power, sharpness, share = map(float, [*text.split(","), *([shrinkage] if text.count(",") == 1 else [])])
        if not 0 <= share <= 1:
            raise ValueError("no share")
    except ValueError:
        raise ValueError("a reading must be POWER,SHARPNESS, two numbers from 1 on, or with SHRINKAGE, one from 0 to "
                         f"1, got {text!r}") from None  # fmt: skip
    return dataclasses.replace(like, exponent=power, mean_exponent=sharpness), share


def _summarise(table: Path, matcher: Matcher) -> dict[str, Any]:
    queries = load_queries(table)
    modes, calibration = uncertainty.get_modes(queries), matcher.calibration
    within, promises = None, {"Gaussian": None, "calibrated": calibration}
    if calibration is not None:
        radius = calibration.compute_radius(LEVEL, uncertainty.measure_modes(modes))
        within = round(float(np.mean(modes.distance_px.to_numpy() <= radius)), 4)
    summary = aggregate(queries[queries.visible])
    summary |= uncertainty.summarise_uncertainty(queries, calibration=calibration)
    reliability = {name: _list_reliability(modes, promise) for name, promise in promises.items()}
    return summary | {"within_radius": within, "reliability": reliability}


def _list_reliability(modes: pd.DataFrame, promise: Calibration | None) -> dict[str, list[float]]:
    """The columns of `uncertainty.compute_reliability` at the radius that `Match.confidence` has by default."""
    confidences = uncertainty.compute_confidences(modes, RADIUS_PX, promise)
    rows = uncertainty.compute_reliability(*confidences, modes["pair"].to_numpy())
    return {name: values.round(4).tolist() for name, values in rows.items()}


def _time_question(matcher: Matcher, root: Path) -> dict[str, Any]:
    """Median times of a question about two new images, and about described ones; what it ran on, the object's size."""
    data = load_dataset(root / "data" / "sample" / matcher.object, "test")
    images, xy = [data.load_image(index) for index in range(2)], [[s / 2 for s in data.size]]
    pair = matcher.prepare(*images)
    ways = {"milliseconds": lambda: matcher.match(*images, xy), "milliseconds_described": lambda: pair.match(xy)}
    return {**{name: _time(way) for name, way in ways.items()}, "hardware": name_hardware(matcher.device),
            "side_px": measure_side(data.folder)}  # fmt: skip


def _time(way: Callable[[], Any]) -> float:
    """Milliseconds of a call, the median of `TIMED`."""
    seconds = []
    for _ in range(TIMED):
        start = time.perf_counter()
        way()
        seconds.append(time.perf_counter() - start)
    return round(1000 * statistics.median(seconds), 1)


def measure_side(folder: Path) -> float:
    """px of a flat cloth's side, or a straight rope's length: the median over a data set's images of these."""
    lengths = []
    for data in (load_dataset(folder, split) for split in SPLITS):
        along = data.xy[data.labels.state.isin(PLAIN).to_numpy(), : SIDE_POINTS[data.object]]
        lengths.extend(np.linalg.norm(np.diff(along, axis=1), axis=-1).sum(1))
    return round(float(np.median(lengths)), 1)


def read_cloth_renders(folder: Path | str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Square pictures (s, s, 3) uint8 and their points (625, 2) px; DamagedFileError, which names what is wrong."""
    path = Path(folder) / CLOTH_LABELS
    labels, renders = read_json(path), []
    for file in sorted(Path(folder).glob(CLOTH_PICTURES)):
        image, number = read_image(file), str(int(file.name.partition("_")[0]))
        try:
            xy = np.array(labels[number], float).reshape(N_POINTS, 2)
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedFileError(f"{path} must hold {N_POINTS} pixels [[x, y]] of {file.name} ({error!r})") from error
        renders.append((image[:, : image.shape[0]], xy))
    if len(renders) < 2:
        raise DamagedFileError(f"{folder} must hold at least two pictures {CLOTH_PICTURES}, got {len(renders)}")
    return renders


def measure_cloth_renders(matcher: Matcher, folder: Path | str) -> dict[str, Any]:
    """`mmgsd.measure.metrics.aggregate` over all queries, and the number of ``pictures``."""
    group, renders = load_group("cloth", DEFAULT_GROUP["cloth"]), read_cloth_renders(folder)
    points = np.arange(N_POINTS).reshape(SIDE, SIDE)[::STEP, ::STEP].ravel()
    count = group.count_modes(points)
    frames = []
    for (image0, xy0), (image1, xy1) in permutations(renders, 2):
        prepared = matcher.prepare(image0, image1)
        for n in np.unique(count):
            subset = points[count == n]
            match = prepared.match(xy0[subset], n=int(n))
            true = xy1[np.stack([group.distinct_modes(int(point)) for point in subset])]  # (S, n, 2)
            frames.append(pd.DataFrame(compute_query_errors(match.modes, match.covariances, true)))
    return aggregate(pd.concat(frames, ignore_index=True)) | {"pictures": len(renders)}


class Masked:
    """A baseline that is told where a segmenter, whatever has ``segment(image)``, sees the object."""

    def __init__(self, baseline: FeatureMatcher, segmenter: Any, *, modes: int) -> None:
        self.baseline, self.segmenter, self.modes = baseline, segmenter, modes

    def match_many(self, questions: Iterable[tuple[np.ndarray, np.ndarray, Any]]) -> Iterator[Match]:
        """As `Matcher.match_many`; where no object is seen it may be anywhere."""
        for image0, image1, xy in questions:
            mask = self.segmenter.segment(image1) > 0.5
            yield self.baseline.match(image0, image1, xy, n=self.modes, mask1=mask if mask.any() else None)


def measure_baseline(
    method: str, object: str, root: Path, *, photographs: Path | None = None, presets: Sequence[str] = SETS,
    progress: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """The row of a baseline: `mmgsd.measure.metrics.aggregate` over visible sources of each preset, photographs.

    Its modes are read as the shipped weights of the object are.
    """
    segmenter = Matcher.load(find_weights(object))
    power, sharpness = segmenter.readout.exponent, segmenter.readout.mean_exponent
    readout = dataclasses.replace(AS_IT_IS, exponent=power, mean_exponent=sharpness)
    row: dict[str, Any] = {"object": object, "power": power, "sharpness": sharpness}
    for preset in presets:
        paths = Paths(root, preset)
        out = paths.queries(name_read(f"{object}-{method}", row))
        queries = load_queries(evaluate_baseline(method, paths.dataset(object), load_preset(preset).evaluate, out,
                                                 readout=readout, progress=progress))  # fmt: skip
        row[preset] = aggregate(queries[queries.visible])
    if photographs:
        masked = Masked(BaselineMatcher(method, readout=readout), segmenter, modes=segmenter.num_modes)
        row["photographs"] = measure_answers(masked, read_photographs(photographs, object), progress=progress)
    return row
