"""A track as files, written frame by frame: a table, JSON, and a video with the points drawn into it."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mmgsd.checks import check_choice
from mmgsd.files import atomic_write
from mmgsd.match.match import LIKELY
from mmgsd.match.track import Tracked
from mmgsd.video import CODECS, writing_video

COLUMNS = ("frame", "time_s", "point", "x", "y", "visible", "confidence", "absent")
COLOURS = ((213, 94, 0), (86, 180, 233), (255, 225, 0), (0, 158, 115), (204, 121, 167), (240, 240, 240))

Record = Callable[[np.ndarray, Tracked], None]  # takes a frame (H, W, 3) uint8 and its answer


def list_outputs(out: Path) -> list[Path]:
    """The files that ``out`` asks for: itself where its name ends as a kind's does, else all kinds in that folder.

    ValueError for another ending.
    """
    if not out.suffix or out.is_dir():
        return [out / f"track{ending}" for ending in (".csv", ".json", ".mp4")]
    check_choice("--out's ending", out.suffix.lower(), (*WRITERS, *CODECS))
    return [out]


@contextmanager
def recording(paths: list[Path], rate: float) -> Iterator[Record]:
    """Give what takes frames and their answers; at the end each file is there whole, after an exception none."""
    with ExitStack() as stack:
        for folder in {path.parent for path in paths if not path.parent.exists()}:
            stack.callback(_remove_empty, folder)
        writers = [stack.enter_context(WRITERS.get(path.suffix.lower(), _draw)(path, rate)) for path in paths]
        number = iter(range(2**62))

        def record(image: np.ndarray, tracked: Tracked) -> None:
            """Hand a frame (H, W, 3) and its answer to every file."""
            at = next(number)
            for write in writers:
                write(at, image, tracked)

        yield record


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # it holds files, or was never made
        folder.rmdir()


@contextmanager
def _write_csv(path: Path, rate: float) -> Iterator[Callable[..., None]]:
    with atomic_write(path) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(COLUMNS)

        def write(number: int, image: np.ndarray, tracked: Tracked) -> None:
            """A row a point."""
            for point, one in enumerate(_describe(tracked)):
                x, y = one["xy"] or ("", "")
                table.writerow([number, round(number / rate, 3), point, x, y, one["visible"], one["confidence"],
                                round(tracked.absent, 3)])  # fmt: skip

        yield write


@contextmanager
def _write_json(path: Path, rate: float) -> Iterator[Callable[..., None]]:
    """One object, a line a frame."""
    with atomic_write(path) as aside, open(aside, "w", encoding="utf-8") as file:
        file.write(f'{{"frames_per_second": {rate:g}, "frames": [')

        def write(number: int, image: np.ndarray, tracked: Tracked) -> None:
            """A line a frame."""
            values = {"frame": number, "absent": round(tracked.absent, 3), "points": _describe(tracked)}
            file.write(("," if number else "") + "\n" + json.dumps(values))

        yield write
        file.write("\n]}\n")


@contextmanager
def _draw(path: Path, rate: float) -> Iterator[Callable[..., None]]:
    with writing_video(path, rate) as write:
        yield lambda number, image, tracked: write(draw_points(image, tracked))


WRITERS = {".csv": _write_csv, ".json": _write_json}


def _describe(tracked: Tracked) -> list[dict[str, Any]]:
    """Plain values of each point, None for what is not known."""
    return [{"xy": [round(float(v), 1) for v in xy] if np.isfinite(xy).all() else None,
             "visible": round(float(seen), 3) if np.isfinite(seen) else None, "confidence": round(float(sure), 3)}
            for xy, seen, sure in zip(tracked.xy, tracked.visible, tracked.confidence, strict=True)]  # fmt: skip


def draw_points(image: np.ndarray, tracked: Tracked) -> np.ndarray:
    """An image (H, W, 3) uint8 with its points and their numbers: filled where seen, rings where hidden."""
    drawn, size = image.copy(), max(2, round(max(image.shape) / 110))
    for number, (xy, seen) in enumerate(zip(tracked.xy, tracked.visible, strict=True)):
        if not np.isfinite(xy).all():
            continue
        place, colour = tuple(np.rint(xy).astype(int).tolist()), COLOURS[number % len(COLOURS)]
        thickness = max(1, size // 3) if seen < LIKELY else -1
        cv2.circle(drawn, place, size + 1, (0, 0, 0), max(1, thickness + 2) if thickness > 0 else -1, cv2.LINE_AA)
        cv2.circle(drawn, place, size, colour, thickness, cv2.LINE_AA)
        beside = place[0] + size + 2, place[1] - size
        for shade, width in ((0, 0, 0), 3), (colour, 1):  # read on any ground
            cv2.putText(drawn, str(number + 1), beside, cv2.FONT_HERSHEY_SIMPLEX, size / 9, shade, width, cv2.LINE_AA)
    return drawn
