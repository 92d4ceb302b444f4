"""What the commands write: answers as text, tables and pictures, and nothing over what they read."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from csv import DictWriter
from json import dumps
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import mmgsd
from mmgsd.command import describe_error
from mmgsd.files import atomic_write
from mmgsd.match.describe import format_query

DPI = 150  # of a picture
NAMED = 10  # of what is left out of a folder
COLUMNS = (
    "image1", "x", "y", "mode", "x1", "y1", "weight", "spread_px", "confidence", "visible", "entropy", "outside",
    "on_object", "absent", "said",
)  # fmt: skip


def draw_answer(answer: Any, path: Path, names: Sequence[str] = ()) -> None:
    """One query as two large panels, several as a page, those for places with their ``names``."""
    from mmgsd.figures.plots import plot_page

    save_picture(answer.plot() if len(answer) == 1 else plot_page(answer, names), path)


def save_picture(figure: Any, path: Path) -> None:
    """A figure, as a file of the kind that its name ends with."""
    with atomic_write(path) as aside:
        figure.savefig(aside, format=path.suffix[1:].lower(), dpi=DPI, bbox_inches="tight", pad_inches=0.05)


def check_order(joint: bool, seen_first: bool) -> None:
    """ValueError for two orders at once."""
    if joint and seen_first:
        raise ValueError("--seen-first must not be given with --joint, which has an order of its own")


def check_written(read: Iterable[Path], *, pictures: Path | None = None, **written: Path | None) -> None:
    """ValueError for a result that would replace one of the images that are ``read``."""
    images = {path.resolve() for path in read}
    for name, path in written.items():
        if path and path.resolve() in images:
            raise ValueError(f"--{name} must not be one of the images, got {path}")
    if pictures and pictures.resolve() in {path.parent for path in images}:
        raise ValueError(f"--pictures must not be a folder of the images, got {pictures}")


def check_drawn(xy: list, how: str) -> None:
    """ValueError for more queries than a page holds, where an option draws them."""
    if how:
        from mmgsd.figures.plots import PAGE_QUERIES

        if len(xy) > PAGE_QUERIES:
            raise ValueError(f"--xy must be given at most {PAGE_QUERIES} times with {how}, got {len(xy)}")


def say_left_out(folder: Path, paths: list[Path]) -> None:
    """Name what a folder holds besides the images that are answered."""
    names = [path.name for path in sorted({*folder.iterdir()}.difference(paths)) if not path.name.startswith(".")]
    if names:
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        print(f"left out, as they do not end as images do: {', '.join(names[:NAMED])}{more}", file=sys.stderr)


def read_readable(matcher: Any, paths: list[Path], failed: list[str]) -> Iterator[tuple[Path, np.ndarray]]:
    """(path, image) of files that can be answered for; why others cannot is said, ``failed`` names them."""
    bar = tqdm(paths, desc="match", unit="image", disable=not sys.stderr.isatty())
    for path in bar:
        try:
            image = mmgsd.read_image(path)
            matcher.compute_input_size(image, str(path))
        except (ValueError, OSError) as error:
            failed.append(path.name)
            bar.write(f"skipped: {describe_error(error)}", file=sys.stderr)
        else:
            yield path, image


def print_answer(name: str, described: list[dict[str, Any]], *, as_json: bool) -> None:
    """Of an image of a folder with its ``name``."""
    if as_json:
        print(dumps({"image1": name, "queries": described} if name else described), flush=True)
    else:
        print("\n".join(f"{name} {format_query(query)}".lstrip() for query in described), flush=True)


def name_place(place: Any) -> str:
    """A place as it was given in the command: "corners", "0.5,1"."""
    return ",".join(f"{value:g}" for value in place) if isinstance(place, tuple) else f"{place}"


def list_rows(name: str, described: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """A row a mode, its pixels as x1, y1."""
    for query in described:
        shared = {key: value for key, value in query.items() if key not in ("xy", "modes")}
        shared |= {"image1": name, **dict(zip("xy", query["xy"], strict=True))}
        for k, mode in enumerate(query["modes"]):
            x1, y1 = mode["xy"]
            columns = {name: value for name, value in mode.items() if name not in ("xy", "answer")}
            yield {**shared, "mode": mode.get("answer", k + 1), "x1": x1, "y1": y1, **columns}


@contextmanager
def writing_rows(path: Path) -> Iterator[DictWriter]:
    """A writer of `COLUMNS` to a file that appears whole or not at all."""
    with atomic_write(path) as aside, open(aside, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        yield table
