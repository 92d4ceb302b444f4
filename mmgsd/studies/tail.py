"""What the large errors are: every true match by what may explain its error, and what outlines leave open.

    python -m mmgsd run tail --preset round2 --set weights=cloth --set split=train    -> data/results/tail.json

Half of all error is in a few queries. A true match has the first cause of `CAUSES` that applies to it. Beside the
measured errors stands that of the better way round where the outline alone decides: where a turn or a mirror image of
the outline is the outline itself, a fold may lie either way round (`find_outline_symmetries`). Shading tells more.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import torch

from mmgsd.checks import check
from mmgsd.config import OBJECTS, EvaluateConfig
from mmgsd.dataset import Dataset
from mmgsd.match.matcher import Matcher
from mmgsd.measure.metrics import compute_mode_errors
from mmgsd.measure.questions import choose_points, describe, draw_pairs, read_modes
from mmgsd.paths import Paths
from mmgsd.progress import ProgressBar
from mmgsd.studies.by_weights import list_parts, list_rows, measure_weights
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Column, Table

TAIL_PX = 40.0  # a query with more RMSE is in the tail
CELL_PX = 15.0  # about the side of a heatmap's cell of the shipped models, px of the image
STRANDS = 40  # material points along a rope that tell another strand from the same one
THIN_PX = 3.0  # width of a rope as the network sees it
ALIKE = 0.94  # overlap over union of an outline with its turn or mirror image
OUTLINE_PX = 64  # side of the outlines that are compared
RESULTS = "tail.json"
QUESTIONS = EvaluateConfig(pairs=200, points=125)
CAUSES = {
    "hidden": "match is hidden",
    "source_fold": "asked beside a fold or a crossing",
    "target_fold": "match beside a fold or a crossing",
    "thin": "rope thinner than 3 px to the network",
    "twice": "target folded twice",
    "other": "none of these",
}


def run(paths: Paths, *, weights: str = "cloth", split: str = "test") -> Path:
    """Ask one model about a preset's images and the cluttered ones that go with them; tail.json."""
    return measure_weights(paths, RESULTS, weights, split, measure_tail)


def measure_tail(matcher: Matcher, data: Dataset) -> Results:
    """What large errors are, and what outlines leave open; ValueError for weights of an object of one's own."""
    check("weights", matcher.object, f"of {' or '.join(OBJECTS)}", matcher.object in OBJECTS)
    return summarise_tail(list_matches(matcher, data), measure_floors(data, QUESTIONS, matcher.config.group))


def list_matches(matcher: Matcher, data: Dataset, *, config: EvaluateConfig = QUESTIONS) -> pd.DataFrame:
    """A row a true match of every query with a visible source.

    ``query``, ``rmse_px`` of the query, ``error_px`` of the match from the mode that is paired with it, ``seen``, and
    ``cause``, a key of `CAUSES`.
    """
    pairs, points = draw_pairs(data, config), choose_points(config.points, data.n_points)
    described, symmetry = describe(matcher, data, np.unique(pairs)), data.group(matcher.config.group)
    orbits = [symmetry.distinct_modes(int(point)) for point in points]
    mixed = [find_mixed(data, image) for image in range(len(data))]
    widths, frames = measure_widths(data, matcher), []
    for pair, (first, second) in enumerate(ProgressBar(pairs, desc=f"tail of {data.object}", leave=False)):
        indices = [k for k, point in enumerate(points) if data.visible[first, point]]
        counts = torch.tensor([len(orbits[k]) for k in indices])
        if not indices:
            continue
        xy = torch.from_numpy(data.xy[first, points[indices]])
        fit, _ = read_modes(matcher, described[first], described[second], xy, data.size, counts)
        for k, modes in zip(indices, fit.modes.double().numpy(), strict=True):
            orbit = np.asarray(orbits[k])
            error = compute_mode_errors(modes[None, : len(orbit)], data.xy[second, orbit][None].astype(float))[0]
            seen = data.visible[second, orbit]
            causes = {
                "hidden": ~seen, "source_fold": np.full(len(orbit), mixed[first][points[k]]),
                "target_fold": mixed[second][orbit], "thin": np.full(len(orbit), widths[second] < THIN_PX),
                "twice": np.full(len(orbit), data.labels.state.iloc[second] == "folded twice"),
                "other": np.ones(len(orbit), bool),
            }  # fmt: skip
            first_cause = np.stack(list(causes.values())).argmax(0)
            frames.append(pd.DataFrame({
                "query": pair * len(points) + k, "rmse_px": np.sqrt(np.square(error).mean()), "error_px": error,
                "seen": seen, "cause": np.array(list(causes))[first_cause]}))  # fmt: skip
    return pd.concat(frames, ignore_index=True)


def find_mixed(data: Dataset, image: int) -> np.ndarray:
    """(P,) bool, the points of an image with another layer or strand of the object within a cell of a heatmap.

    Of two points less than `CELL_PX` apart in the image, but far apart on the object: twice as far as neighbours there
    may be, or `STRANDS` along a rope.
    """
    xy = data.xy[image].astype(float)
    numbers, near = np.arange(len(xy)), np.linalg.norm(xy[:, None] - xy[None], axis=-1) < CELL_PX
    if data.object == "cloth":
        rows, columns = np.divmod(numbers, side := round(len(xy) ** 0.5))
        away = np.maximum(np.abs(rows[:, None] - rows), np.abs(columns[:, None] - columns))
        pitch = np.linalg.norm(np.diff(xy.reshape(side, side, 2), axis=1), axis=-1).max()
        return (near & (away > max(2, 2 * CELL_PX / max(pitch, 1e-6)))).any(1)
    return (near & (np.abs(numbers[:, None] - numbers) > STRANDS)).any(1)


def measure_widths(data: Dataset, matcher: Matcher) -> np.ndarray:
    """(N,) how wide a rope is, px of the network's input: its mask's area by its length in the image; else infinite."""
    if data.object != "rope":
        return np.full(len(data), np.inf)
    scale, widths = matcher.config.input_px / max(data.size), []
    for image in range(len(data)):
        length = np.linalg.norm(np.diff(data.xy[image].astype(float), axis=0), axis=-1).sum()
        widths.append(scale * data.load_mask(image).sum() / max(length, 1.0))
    return np.array(widths)


def find_outline_symmetries(mask: np.ndarray) -> list[np.ndarray]:
    """Affine maps (2, 3) of px that lay an outline (H, W) bool onto itself, the identity first.

    Turns by quarters, and mirror images across lines every 3° through its middle: of those with an overlap of `ALIKE`
    the best of each run of neighbours.
    """
    middle = np.array(mask.nonzero()[::-1], float).mean(1)
    extent = 1.05 * np.abs(np.array(mask.nonzero()[::-1]).T - middle).max() + 1
    half = (OUTLINE_PX - 1) / 2
    shrink = np.array([[half / extent, 0], [0, half / extent]])
    to_small = np.column_stack([shrink, half - shrink @ middle])
    size = (OUTLINE_PX, OUTLINE_PX)
    small = cv2.warpAffine(mask.astype(np.float32), to_small, size, flags=cv2.INTER_LINEAR)

    def measure(linear: np.ndarray) -> float:
        """Overlap over union with the outline's image under a linear map about its middle."""
        centre = np.array([half, half])
        moved = cv2.warpAffine(small, np.column_stack([linear, centre - linear @ centre]), size)
        return float(np.minimum(moved, small).sum() / np.maximum(moved, small).sum())

    turns = [np.array([[c, -s], [s, c]]) for c, s in ((0, 1), (-1, 0), (0, -1))]
    angles = np.radians(np.arange(0, 180, 3))
    mirrors = [np.array([[np.cos(2 * a), np.sin(2 * a)], [np.sin(2 * a), -np.cos(2 * a)]]) for a in angles]
    fits = np.array([measure(mirror) for mirror in mirrors])
    best = (fits >= ALIKE) & (fits >= np.roll(fits, 1)) & (fits > np.roll(fits, -1))
    maps = [np.eye(2), *(t for t in turns if measure(t) >= ALIKE), *(mirrors[k] for k in np.flatnonzero(best))]
    return [np.column_stack([linear, middle - linear @ middle]) for linear in maps]


def measure_floors(data: Dataset, config: EvaluateConfig, group: str) -> pd.DataFrame:
    """A row a target image of the questions: its ``state``, how many ways round ``ways``, and ``floor_px``.

    The floor is the mean RMSE of the best of these ways over all that the outline leaves open, each as likely:
    under a mirror image the points are those of the mirrored object.
    """
    points, symmetry = choose_points(config.points, data.n_points), data.group(group)
    orbits, rows = [symmetry.distinct_modes(int(point)) for point in points], []
    for image in np.unique(draw_pairs(data, config)[:, 1]):
        ways = list_ways(data.xy[image].astype(float), data.load_mask(int(image)), data.mirror, orbits)
        if ways:
            floor = float(np.mean([_measure_floor(ways, orbit) for orbit in orbits]))
            rows.append((data.labels.state.iloc[image], len(ways), floor))
    return pd.DataFrame(rows, columns=["state", "ways", "floor_px"])


def list_ways(
    xy: np.ndarray, mask: np.ndarray, mirror: np.ndarray | None, orbits: list[np.ndarray]
) -> list[np.ndarray]:  # fmt: skip
    """Where (P, 2) px the points at ``xy`` may as well lie by the outline of a ``mask`` (H, W) alone, as they do first.

    ``mirror`` (P,) are the points of the mirrored object, None where it has no mirror image; ways that the symmetry,
    whose ``orbits`` are asked for, does not tell apart are one. Empty without an outline.
    """
    ways = []
    for affine in find_outline_symmetries(mask) if mask.any() else []:
        mirrored = np.linalg.det(affine[:, :2]) < 0
        if mirrored and mirror is None:
            continue
        labels = xy[mirror] if mirrored else xy
        ways.append(labels @ affine[:, :2].T + affine[:, 2])
    return [*ways[:1], *(way for way in ways[1:] if _compare(way, xy, orbits) > CELL_PX)]


def _compare(way: np.ndarray, xy: np.ndarray, orbits: list[np.ndarray]) -> float:
    """Mean error (px) of a way's matches against the true ones: next to none where it is a symmetry of the object."""
    return float(np.mean([compute_mode_errors(way[None, orbit], xy[None, orbit]).mean() for orbit in orbits]))


def _measure_floor(ways: list[np.ndarray], orbit: np.ndarray) -> float:
    """The least mean RMSE (px) of one way's matches over all of them."""
    errors = [[np.sqrt(np.square(compute_mode_errors(answer[None, orbit], true[None, orbit])).mean()) for true in ways]
              for answer in ways]  # fmt: skip
    return float(np.mean(errors, axis=1).min())


def summarise_tail(matches: pd.DataFrame, floors: pd.DataFrame) -> dict[str, dict[str, float]]:
    """{cause: shares and errors of its matches}, "all" first, and {"floor: state": …} of the outlines.

    ``share`` of the matches, ``tail`` the share of the squared error of queries in the tail, ``error_px`` the root mean
    square over all of them, ``seen_px`` and ``hidden_px`` over those that are.
    """
    tail = matches[matches.rmse_px > TAIL_PX]
    total = np.square(tail.error_px).sum()
    summary = {"all": _summarise(matches, matches, tail, total)}
    for cause in CAUSES:
        summary[cause] = _summarise(matches[matches.cause == cause], matches, tail[tail.cause == cause], total)
    queries = matches.groupby("query").rmse_px.first()
    summary["all"] |= {"queries": round(float((queries > TAIL_PX).mean()), 4),
                       "of_error": round(float(queries[queries > TAIL_PX].sum() / queries.sum()), 4)}  # fmt: skip
    for state, rows in floors.groupby("state"):
        summary[f"floor: {state}"] = {"images": len(rows), "ways": round(float((rows.ways > 1).mean()), 4),
                                      "floor_px": round(float(rows.floor_px.mean()), 2)}  # fmt: skip
    return summary


def _summarise(rows: pd.DataFrame, every: pd.DataFrame, tail: pd.DataFrame, total: float) -> dict[str, float]:
    def root_mean(errors: pd.Series) -> float | None:
        """The root mean square, None of nothing."""
        return round(float(np.sqrt(np.square(errors).mean())), 2) if len(errors) else None

    return {
        "matches": len(rows), "share": round(len(rows) / max(1, len(every)), 4),
        "tail": round(float(np.square(tail.error_px).sum() / total), 4) if total else None,
        "error_px": root_mean(rows.error_px), "seen_px": root_mean(rows.error_px[rows.seen]),
        "hidden_px": root_mean(rows.error_px[~rows.seen]),
    }  # fmt: skip


def describe_tail(results: Results) -> Table:
    """Matches by cause, a row each; weights and their images below each other."""
    columns = [
        Column("share", page="of the matches", form=".0f", scale=100),
        Column("tail", page="of the tail's squared error", form=".0f", scale=100),
        Column("seen_px", page="RMS error, seen, px"), Column("hidden_px", page="hidden, px"),
    ]  # fmt: skip
    return Table("cause", {"": columns}, list_rows(results, {"all": "all", **CAUSES}), list(list_parts(results)))


def describe_floors(results: Results) -> Table:
    """What the outline leaves open, by state, where it fits more than one way round at all."""
    columns = [Column("images", page="images", form="d"),
               Column("ways", page="outline fits more than one way round", form=".0f", scale=100),
               Column("floor_px", page="least error by the outline alone, px")]  # fmt: skip
    keys = {key: key.removeprefix("floor: ") for summary in list_parts(results).values() for key in summary
            if key.startswith("floor: ") and summary[key]["ways"]}  # fmt: skip
    rows = list_rows(results, keys)
    parts = [part for part in list_parts(results) if any(part in row for row in rows.values())]
    return Table("state", {"": columns}, rows, parts)


STUDY = Study(
    "tail", 166, run, shows=lambda paths, **_: [paths.results.parent / RESULTS],
    tables={"tail": Shown(RESULTS, describe_tail), "tail_floor": Shown(RESULTS, describe_floors)},
)  # fmt: skip
