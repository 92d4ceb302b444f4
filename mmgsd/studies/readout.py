"""What else the same weights answer where they are read in another way: error that costs no training.

    python -m mmgsd run readout --preset round2 --set weights=cloth --set split=train    -> data/results/readout.json

Every way is asked the same questions, about clean images and about the cluttered ones that go with them; neither may
have been trained on. Half of the pairs choose the temperature; the errors are those of the other half.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset
from mmgsd.match.em import AS_IT_IS
from mmgsd.match.heatmap import read_heatmap
from mmgsd.match.joint import join, predict, spread_places
from mmgsd.match.matcher import QUARTERS, Matcher
from mmgsd.match.mixture import Mixture, find_peaks
from mmgsd.measure.metrics import aggregate
from mmgsd.measure.questions import AnswerFunction, ask, choose_points, draw_pairs
from mmgsd.model.heads import Outputs
from mmgsd.model.network import compute_cell_centres
from mmgsd.paths import Paths
from mmgsd.progress import ProgressBar
from mmgsd.studies.by_weights import list_parts, list_rows, measure_weights
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import ERRORS, Table

TEMPERATURES = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)  # times the calibrated one
RESULTS = "readout.json"  # beside the presets' folders: shipped weights are of none
QUESTIONS = EvaluateConfig(pairs=120, points=125)


@dataclass(frozen=True)
class Way:
    """How weights are read, where it is not as they are shipped."""

    label: str
    temperature: float | None = None  # of the heatmaps; 0: that with the least error on half of the pairs
    shrinkage: float | None = None  # of sources towards the places that they look like
    means: bool = False  # modes at the means of their shares, however the weights are read
    turned: bool = False  # heatmaps of the target's quarter turns are averaged, not descriptors
    flipped: bool = False  # and those of both images' mirror images
    median: bool = False  # modes are a priori as wide as the median of them, not as the mean
    peaks: bool = False  # of a second fit, from the heatmap's peaks, the likelier counts
    joint: bool = False  # of a second fit, from where the joint answer's maps lead, the likelier counts
    truth: bool = False  # the fit starts at the true matches: what no start can better


WAYS = {
    "shipped": Way("as it is shipped"),
    "temperature 1": Way("temperature 1", temperature=1.0),
    "least error": Way("temperature of the least error", temperature=0.0),
    "unshrunk": Way("sources as they are described", shrinkage=0.0),
    "places": Way("sources as their places are on average", shrinkage=1.0),
    "means": Way("modes at the means of their shares", means=True),
    "turned": Way("heatmaps of four turns averaged", turned=True),
    "flipped": Way("heatmaps of both mirror images averaged", flipped=True),
    "median": Way("median width as the prior", median=True),
    "peaks": Way("likelier of two fits: the peaks", peaks=True),
    "joint": Way("likelier of two fits: the joint answer, told image0's mask", joint=True),
    "starts": Way("likeliest of all three, told it, too", peaks=True, joint=True),
    "truth": Way("fit started at the truth", truth=True),
}


def run(paths: Paths, *, weights: str = "cloth", split: str = "test") -> Path:
    """Ask one model in every way about a preset's images and the cluttered ones that go with them; readout.json."""
    return measure_weights(paths, RESULTS, weights, split, measure_ways)


def measure_ways(
    matcher: Matcher, data: Dataset, *, config: EvaluateConfig = QUESTIONS, ways: Mapping[str, Way] = WAYS
) -> dict[str, dict[str, float]]:
    """{way: its errors} over the queries with a visible source of every second pair."""
    errors, before, shrinkage = {}, matcher.temperature, matcher.shrinkage
    images = _describe_all(matcher, data, config)
    for name, way in ProgressBar(ways.items(), desc=f"ways of {matcher.config.object}", total=len(ways)):
        scales = [before * factor for factor in TEMPERATURES] if way.temperature == 0 else [way.temperature or before]
        tables, matcher.shrinkage = {}, shrinkage if way.shrinkage is None else way.shrinkage
        for scale in scales:
            matcher.temperature = scale
            table = ask(_make_answer(matcher, data, config, way, images), data, config, matcher.config.group, False, "")
            tables[scale] = table[table.visible]
        best = min(tables, key=lambda scale: tables[scale].rmse_px[tables[scale].pair % 2 == 1].mean())
        queries = tables[best][tables[best].pair % 2 == 0]
        errors[name] = {**aggregate(queries), "temperature": best}
    matcher.temperature, matcher.shrinkage = before, shrinkage
    return errors


def _describe_all(matcher: Matcher, data: Dataset, config: EvaluateConfig) -> dict[tuple[int, bool], list[Outputs]]:
    """What the network says of each image, and of its mirror image, turned by each quarter and turned back."""
    upright, described = copy.copy(matcher), {}
    upright.turns = 1
    for index in np.unique(draw_pairs(data, config)):
        image = data.load_image(int(index))
        for flipped in (False, True):
            seen = image[:, ::-1] if flipped else image
            turns = upright.describe([np.ascontiguousarray(np.rot90(seen, k)) for k in range(QUARTERS)])
            back = [outputs.turn(-k) for k, outputs in enumerate(turns)]
            described[int(index), flipped] = [_flip(outputs) for outputs in back] if flipped else back
    return described


def _flip(outputs: Outputs) -> Outputs:
    """What is said of a mirror image, laid onto the image itself."""
    values = {field.name: getattr(outputs, field.name) for field in dataclasses.fields(outputs)}
    return Outputs(**{name: x.flip(-1) if x is not None and x.ndim > 1 else x for name, x in values.items()})


def _make_answer(
    matcher: Matcher, data: Dataset, config: EvaluateConfig, way: Way, images: Mapping[tuple[int, bool], list[Outputs]]
) -> AnswerFunction:  # fmt: skip
    symmetry, points = data.group(matcher.config.group), choose_points(config.points, data.n_points)
    orbits = [symmetry.distinct_modes(int(point)) for point in points]
    readout = dataclasses.replace(AS_IT_IS if way.means else matcher.readout, median_width=way.median)

    def answer(first: int, second: int, xy: np.ndarray, n: np.ndarray) -> tuple[Mixture, Tensor]:
        """Modes and entropies (nats) of pixels ``xy`` of the first image."""
        heatmaps, others = [], []
        for flipped in (False, True)[: 1 + way.flipped]:
            source, target = Outputs.mean(images[first, flipped]), images[second, flipped]
            targets = target if way.turned else [Outputs.mean(target)]
            heatmaps += [matcher.compute_heatmaps(source, one, torch.from_numpy(xy), data.size) for one in targets]
        heatmap, count = torch.stack(heatmaps).mean(0), torch.from_numpy(n)
        centres = compute_cell_centres(data.size, heatmap.shape[-2:])
        true = [torch.from_numpy(data.xy[second, orbit]) for orbit in orbits]
        start = pad_sequence(true, batch_first=True, padding_value=torch.nan) if way.truth else None
        if way.peaks:
            others.append(find_peaks(heatmap, count, *centres))
        if way.joint:
            maps = _predict_jointly(matcher, data.load_mask(first), source, Outputs.mean(target), xy)
            others.append(maps.masked_fill(torch.arange(maps.shape[1])[:, None] >= count[:, None, None], torch.nan))
        return read_heatmap(heatmap, count, centres, readout=readout, start=start, others=others)

    return answer


def _predict_jointly(
    matcher: Matcher, mask: np.ndarray, source: Outputs, target: Outputs, xy: np.ndarray
) -> Tensor:
    """(S, n, 2) px: where each pixel of the first image has its matches by what its neighbours' say (`predict`).

    ``mask`` (H, W) bool is where it shows the object, by the data set.
    """
    size, places = mask.shape[::-1], spread_places(mask)
    everywhere = np.concatenate([xy, places])
    heatmap = matcher.compute_heatmaps(source, target, torch.from_numpy(everywhere), size)
    centres = compute_cell_centres(size, heatmap.shape[-2:])
    fit, _ = read_heatmap(heatmap, matcher.num_modes, centres, readout=matcher.readout)
    modes, spread = fit.modes.numpy(), fit.covariances.diagonal(dim1=-2, dim2=-1).mean(-1).sqrt().numpy()
    order = join(everywhere, mask, modes, fit.weights.numpy(), spread, places=len(places))
    modes, spread = np.take_along_axis(modes, order[..., None], 1), np.take_along_axis(spread, order, 1)
    return torch.from_numpy(predict(everywhere, mask, modes, spread)[: len(xy)])


def describe_ways(results: Results) -> Table:
    """The errors of every way, a row each; weights and their images beside each other."""
    labels, columns = {name: way.label for name, way in WAYS.items()}, [c for c in ERRORS if c.key != "median"]
    return Table("read", {"": columns}, list_rows(results, labels), list(list_parts(results)))


STUDY = Study(
    "readout", 165, run, shows=lambda paths, **_: [paths.results.parent / RESULTS],
    tables={"readout": Shown(RESULTS, describe_ways)},
)  # fmt: skip
