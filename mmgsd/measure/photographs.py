"""How much of what is visible in photographs does a matcher find? Measured at marked corners, ends or like places.

The photographs are described by a JSON file, a list of dictionaries, one a photograph; other keys are ignored::

    file      relative to the JSON file
    kind      what it shows: "cloth", "rope", the name of an object of yours; without it, what the model was taught
    repo      where it is from, shown as its source; default: "own"
    corners   of a cloth, [[x, y], …] px in order around it, null for one that is not seen
    visible_corner_stickers, visible_corners_unordered    those of a cloth that are seen, in any order
    ends      of a rope
    marks     of another object: places that look alike
    size_px   of the object; default: the mean of a cloth's sides where all corners are seen, else half the image's
              longer side, or 0.65 of it where stickers mark the corners or lie near them (``stickers``, px): these
              photographs are cropped to the cloth

The first of the five that is there counts. Each place of `SOURCES` photographs, evenly spread over the file (of cloths
only those with all corners), is asked for in every other photograph with places::

    found@5%, found@10%   share of the marked places that have a mode nearer than 5, 10 % of the object's size
    spurious              share of the k modes most probably seen (`Match.seen_first`; the surest ones where that is not
                          known), k the marked places, farther than 10 % from all of them
    best                  distance of `Match.best` to the nearest marked place, % of the size; of answers that give one

Of a cloth's corners and a rope's ends all but the last is also counted of `Matcher.find`, "by_name": there no other
picture is asked about, so every photograph is one query.

All are means over queries; their 95 % intervals are by bootstrap over the photographs, each with all its queries.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mmgsd.dataset import load_dataset
from mmgsd.files import DamagedFileError, read_json, write_json, write_text
from mmgsd.images import check_pixels, find_beside, list_images, read_image
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.paths import find_root
from mmgsd.progress import ProgressBar

SOURCES = 4  # photographs whose places are asked for
INDEX = "index.json"  # of a folder of photographs
PLACES = ("corners", "visible_corner_stickers", "visible_corners_unordered", "ends", "marks")
MEASURES = ("found@5%", "found@10%", "spurious", "best")
DRAWS = 2000  # of a bootstrap
SIZE_SHARE, STICKERED_SHARE = 0.5, 0.65  # of the image's longer side: an object whose size is not known
ENDS = {"cloth": ("corners", (0, 24, 624, 600)), "rope": ("ends", (0, 624))}  # material points to mark


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph's file and its marked places; the pixels are read when they are needed."""

    path: Path
    source: str
    xy: np.ndarray  # (k, 2) px of places that look alike
    size_px: float | None  # of the object; None: to be estimated from the image's size
    share: float  # of the image's longer side that is its size then
    askable: bool  # all of the object's places are marked
    by: str = ""  # the key of `PLACES` that its marks have

    def read(self) -> np.ndarray:
        """(H, W, 3) uint8; ValueError, which names the file, where a mark is outside or the file cannot be read."""
        image = read_image(self.path)
        try:
            check_pixels(self.xy, image.shape[1::-1], image="the image")
        except ValueError as error:
            raise ValueError(f"{self.path}: of its marks, {error}") from error
        return image


def read_photographs(place: Path | str, kind: str) -> list[Photograph]:
    """The photographs of a ``kind`` with marked places, of a folder with an ``index.json`` or of such a file.

    ValueError, or DamagedFileError, which names the file, for one of another format, and where there are not two.
    """
    path = Path(place) / INDEX if Path(place).is_dir() else Path(place)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: give a folder with {INDEX}, or such a file")
    photographs = [photograph for photograph in _read_index(path, kind) if len(photograph.xy)]
    if len(photographs) < 2 or not any(photograph.askable for photograph in photographs):
        raise ValueError(f"{path} must mark at least two photographs of kind {kind!r}, and all corners of one cloth, "
                         f"got {len(photographs)} marked")  # fmt: skip
    return photographs


def read_all_photographs(place: Path | str, kind: str) -> list[Photograph]:
    """The photographs of a ``kind`` in a folder or a file that describes some, those without a mark as well.

    The images of a folder that its ``index.json`` does not name, or that has none, have no mark. Errors are those of
    `read_photographs`, but for their number, and of `mmgsd.images.list_images`.
    """
    folder, path = Path(place), Path(place) / INDEX if Path(place).is_dir() else Path(place)
    if not folder.is_dir():
        return _read_index(path, kind)
    if not path.is_file():
        return [_leave_unmarked(file) for file in list_images(folder)]
    named, files = {find_beside(path, str(entry.get("file"))).resolve() for entry in _read_entries(path)}, []
    with suppress(ValueError):  # they may all lie elsewhere
        files = list_images(folder)
    return [*_read_index(path, kind), *(_leave_unmarked(file) for file in files if file.resolve() not in named)]


def _leave_unmarked(file: Path) -> Photograph:
    return Photograph(file, "own", np.zeros((0, 2)), None, SIZE_SHARE, False)


def _read_index(path: Path, kind: str) -> list[Photograph]:
    return [_read_entry(path, k, e) for k, e in enumerate(_read_entries(path)) if e.get("kind", kind) == kind]


def _read_entries(path: Path) -> list[dict[str, Any]]:
    entries = read_json(path)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DamagedFileError(f"{path} must be a list of dictionaries, one a photograph")
    return entries


def _read_entry(path: Path, number: int, entry: dict[str, Any]) -> Photograph:
    name, where = entry.get("file"), f"{path}, photograph {number}"
    if not isinstance(name, str) or not name:
        raise DamagedFileError(f"{where}: file must be a path, got {name!r}")
    by, marked = next(((key, seen) for key in PLACES if (seen := _list_seen(entry.get(key), where, key))), ("", []))
    whole = by == "corners" and 0 < len(marked) == len(entry[by])
    size_px = entry.get("size_px")
    if size_px is not None and not (isinstance(size_px, int | float) and 0 < size_px < np.inf):
        raise DamagedFileError(f"{where}: size_px must be a number above 0, got {size_px!r}")
    xy = np.array(marked, float).reshape(-1, 2)
    if size_px is None and whole:
        size_px = float(np.linalg.norm(xy - np.roll(xy, 1, 0), axis=1).mean())
    share = STICKERED_SHARE if entry.get("visible_corner_stickers") or entry.get("stickers") else SIZE_SHARE
    askable = whole or by in ("ends", "marks")
    return Photograph(find_beside(path, name), str(entry.get("repo") or "own"), xy, size_px, share, askable, by)


def _list_seen(places: Any, where: str, key: str) -> list[list[float]]:
    """The pixels of a list that are not null."""
    try:
        seen = [place for place in places or [] if place]
        if np.array(seen, float).shape in ((0,), (len(seen), 2)):
            return seen
    except (TypeError, ValueError):
        pass
    raise DamagedFileError(f"{where}: {key} must be a list of [x, y] px or null, got {places!r:.80}")


def measure_photographs(
    weights: Path | str, place: Path | str, *, progress: bool = True,
    seen: Callable[[Photograph, Match], None] = lambda *_: None,
) -> dict[str, Any]:  # fmt: skip
    """What shipped or trained ``weights`` find in the photographs of a folder, or file, as `summarise_photographs`.

    Also weights' name and sha256, object and number of photographs. ``seen`` is called with each photograph and answer.
    Errors are those of `mmgsd.load` and `read_photographs`.
    """
    file = find_weights(weights)
    matcher = Matcher.load(file)
    kind = matcher.object or matcher.config.object
    about = {"weights": file.name, "sha256": hashlib.sha256(file.read_bytes()).hexdigest(), "object": kind}
    return about | measure_answers(matcher, read_photographs(place, kind), progress=progress, seen=seen)


def measure_answers(
    matcher: Any, photographs: list[Photograph], *, progress: bool = True,
    seen: Callable[[Photograph, Match], None] = lambda *_: None,
) -> dict[str, Any]:  # fmt: skip
    """Number and ``marks`` of photographs, `summarise_photographs` of the answers of anything with ``match_many``."""
    rows = []
    for photograph, answer in ask_photographs(matcher, photographs, progress=progress):
        seen(photograph, answer)
        rows.append(score_answer(answer, photograph))
    about = {"photographs": len(photographs), "marks": digest_marks(photographs)}
    summary = about | summarise_photographs(pd.concat(rows, ignore_index=True))
    named = ask_by_name(matcher, photographs)
    return summary | {"by_name": summarise_photographs(pd.concat(named, ignore_index=True))} if named else summary


def ask_by_name(matcher: Any, photographs: list[Photograph]) -> list[pd.DataFrame]:
    """A row a photograph, as of `score_answer`, of the corners or ends that `Matcher.find` finds; [] if it cannot."""
    if getattr(matcher, "places", None) is None or matcher.object not in ENDS:
        return []
    return [score_answer(matcher.find(photograph.read(), ENDS[matcher.object][0]), photograph)
            for photograph in photographs]  # fmt: skip


def digest_marks(photographs: list[Photograph]) -> str:
    """What tells marks from others: what was counted by other ones cannot be compared."""
    marks = [[p.path.name, p.xy.tolist(), p.size_px, p.share, p.askable] for p in photographs]
    return hashlib.sha256(json.dumps(marks).encode()).hexdigest()[:16]


def check_name(name: str) -> None:
    """ValueError for a name of results that is no word."""
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ValueError(f"name must be of letters, digits, - and _, got {name!r}")


def store_photographs(results: dict[str, Any], name: str) -> Path:
    """Write results to ``data/results/photographs_NAME.json``; ValueError for a name that is no word."""
    check_name(name)
    return write_json(find_root() / "data" / "results" / f"photographs_{name}.json", results)


def ask_photographs(
    matcher: Any, photographs: list[Photograph], *, targets: list[Photograph] | None = None, progress: bool = True
) -> Iterator[tuple[Photograph, Match]]:
    """(photograph, answer) for the places of `SOURCES` in each other photograph, which is read and described once.

    ``matcher``: anything with ``match_many``. ``targets`` are asked about in place of the others. Where no photograph
    has all of its places marked, any is a source.
    """
    askable = [photograph for photograph in photographs if photograph.askable] or photographs
    spread = np.linspace(0, len(askable) - 1, min(SOURCES, len(askable))).round().astype(int)
    read = [(source, source.read()) for source in (askable[k] for k in np.unique(spread))]
    targets = photographs if targets is None else targets
    pairs = [(source, target) for target in targets for source in read if source[0].path != target.path]

    def ask() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Both images and the pixels of each pair; a target is read once."""
        last, image = None, None
        bar = ProgressBar(pairs, desc="measure", unit="pair", disable=not progress, leave=False)
        for (source, image0), target in bar:
            last, image = (last, image) if target is last else (target, target.read())
            yield image0, image, source.xy

    answers = matcher.match_many(ask())
    yield from ((target, answer) for (_, target), answer in zip(pairs, answers, strict=True))


def score_answer(answer: Match, target: Photograph) -> pd.DataFrame:
    """A row a query: its photograph's from and file, and `MEASURES`."""
    size_px = target.size_px or target.share * max(answer.image1.shape[:2])
    rows, k = [], len(target.xy)
    for modes, best in zip(answer.seen_first().modes, answer.best().xy, strict=True):
        present = modes[~np.isnan(modes).any(1)]
        distance = np.linalg.norm(present[:, None] - target.xy[None], axis=-1) / size_px  # (n, k)
        near, nearest = distance.min(0), np.linalg.norm(target.xy - best, axis=1).min() / size_px
        found_shares = [float((near < share).mean()) for share in (0.05, 0.1)]
        spurious = float((distance[:k].min(1) > 0.1).mean())
        rows.append([target.source, str(target.path), *found_shares, spurious, 100 * float(nearest)])
    return pd.DataFrame(rows, columns=["from", "file", *MEASURES])


def summarise_photographs(rows: pd.DataFrame) -> dict[str, Any]:
    """{queries, unanswered, measures…} of all queries, "intervals", and under "sources" of each source's photographs.

    ``unanswered``: share whose `Match.best` abstains. ``intervals``: `estimate_intervals`.
    """
    sources = {str(name): _summarise(part) for name, part in rows.groupby("from")}
    return _summarise(rows) | {"intervals": estimate_intervals(rows), "sources": sources}


def estimate_intervals(rows: pd.DataFrame) -> dict[str, list[float] | None]:
    """{measure: low and high of its mean's 95 % interval}, photographs drawn anew; None where nothing was answered."""
    each = rows.groupby("file")[list(MEASURES)].agg(["sum", "count"])
    drawn = np.random.default_rng(0).integers(len(each), size=(DRAWS, len(each)))
    intervals: dict[str, list[float] | None] = {}
    for name in MEASURES:
        total, count = (each[name][key].to_numpy()[drawn].sum(1) for key in ("sum", "count"))
        means = total[count > 0] / count[count > 0]
        intervals[name] = np.quantile(means, [0.025, 0.975]).round(4).tolist() if len(means) else None
    return intervals


def _summarise(rows: pd.DataFrame) -> dict[str, Any]:
    means = {name: None if rows[name].isna().all() else round(float(rows[name].mean()), 4) for name in MEASURES}
    return {"queries": len(rows), "unanswered": round(float(rows.best.isna().mean()), 4), **means}


def make_photographs_table(summary: dict[str, Any]) -> str:
    """Text of a summary: a source a row, all of them, what is found by name, and the 95 % intervals of these two."""
    whole = {"all": summary, **({"by name": summary["by_name"]} if "by_name" in summary else {})}
    parts = {**summary["sources"], **whole}
    rows = {name: {key: part[key] for key in ("queries", *MEASURES, "unanswered")} for name, part in parts.items()}
    lines = [pd.DataFrame.from_dict(rows, orient="index").to_string(float_format="{:.3f}".format)]
    for name, part in whole.items():
        bounds = {key: part["intervals"][key] for key in ("found@5%", "spurious") if part["intervals"].get(key)}
        intervals = [f"{key} {low:.2f} to {high:.2f}" for key, (low, high) in bounds.items()]
        lines += [f"95 % intervals, {name}: {', '.join(intervals)}"] if intervals else []
    return "\n".join(lines)


def describe_marks(file: str, pins: list[Any], kind: str = "") -> dict[str, Any]:
    """A photograph's entry from pixels that were clicked; of a cloth, four in order around it are all its corners."""
    key = {"cloth": "visible_corners_unordered", "rope": "ends"}.get(kind, "marks")
    key = "corners" if kind == "cloth" and len(pins) == len(ENDS["cloth"][1]) else key
    places = [[round(float(value), 1) for value in pin] for pin in pins]
    return {"file": file, **({"kind": kind} if kind else {}), key: places}


def mark_dataset(folder: Path | str, relative: str) -> list[dict[str, Any]]:
    """What describes a data set's test images as photographs: the visible corners of cloths, or the ends of ropes.

    ``relative`` is the folder's path from where the JSON file will lie.
    """
    data = load_dataset(folder, "test")
    key, points = ENDS[data.object]
    entries = []
    for file, xy, visible in zip(data.labels.file, data.xy, data.visible, strict=True):
        places = [xy[k].astype(float).round(1).tolist() if visible[k] else None for k in points]
        places = places if key == "corners" else [place for place in places if place]
        entries.append({"file": f"{relative}/{file}", "kind": data.object, "repo": "rendered", key: places})
    return entries


def write_sample_marks(folder: Path | str) -> Path:
    """Write ``photographs.json`` of the sample's data sets in ``folder``, which stand in for photographs of yours."""
    entries = [entry for name in ENDS for entry in mark_dataset(Path(folder) / name, name)]
    lines = ",\n".join(f" {json.dumps(entry)}" for entry in entries)
    return write_text(Path(folder) / "photographs.json", f"[\n{lines}\n]\n")
