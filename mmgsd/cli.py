"""What the commands of ``python -m mmgsd`` do, a function a command; their words are in `mmgsd.__main__`."""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import mmgsd
from mmgsd.files import write_bytes, writing
from mmgsd.images import check_pixels, list_images, read_mask
from mmgsd.match.describe import describe_answer, format_query

DPI = 150  # of a picture
COLUMNS = (
    "image1", "x", "y", "mode", "x1", "y1", "weight", "spread_px", "confidence", "visible", "entropy", "outside",
    "on_object", "absent", "said",
)  # fmt: skip


def say_error(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def match(asked: argparse.Namespace) -> None:
    """Answer for one image, or for each of a folder."""
    if asked.image1.is_dir():
        _match_folder(asked)
        return
    _check_written(asked, [asked.image1])
    if asked.pictures:
        raise ValueError(f"--pictures must be given with a folder as image1, got {asked.image1}: use --out")
    images = [mmgsd.read_image(path) for path in (asked.image0, asked.image1)]
    files = {"mask0": asked.mask0, "mask1": asked.mask1}
    masks = {k: f and read_mask(f, im.shape[:2]) for (k, f), im in zip(files.items(), images, strict=True)}
    answer = mmgsd.load(asked.weights).match(*images, asked.xy, n=asked.n, **masks)
    described = describe_answer(answer)
    if asked.out:
        draw_answer(answer, asked.out)
    if asked.csv:
        with _writing_rows(asked.csv) as table:
            table.writerows(_list_rows(asked.image1.name, described))
    print(json.dumps(described) if asked.json else "\n".join(map(format_query, described)), flush=True)


def _match_folder(asked: argparse.Namespace) -> None:
    """Answer for one image after the other; RuntimeError at the end where some could not be answered for."""
    if asked.out or asked.mask0 or asked.mask1:
        raise ValueError(f"--out, --mask0 and --mask1 must be given with one image1, got the folder {asked.image1}: "
                         "use --pictures")  # fmt: skip
    from tqdm import tqdm

    paths, image0 = list_images(asked.image1), mmgsd.read_image(asked.image0)
    _check_written(asked, paths)
    check_pixels(asked.xy, image0.shape[1::-1])
    matcher, failed = mmgsd.load(asked.weights), []
    matcher.compute_input_size(image0, "image0")
    bar = tqdm(paths, desc="match", unit="image", disable=not sys.stderr.isatty())
    named, frames = itertools.tee(_read_readable(matcher, bar, failed))
    answers = matcher.match_many(((image0, image1, asked.xy) for _, image1 in frames), n=asked.n)
    with _writing_rows(asked.csv) if asked.csv else nullcontext() as table:
        for (path, _), answer in zip(named, answers, strict=True):
            described = describe_answer(answer)
            if table:
                table.writerows(_list_rows(path.name, described))
            if asked.pictures:
                draw_answer(answer, asked.pictures / f"{path.name}.png")
            with tqdm.external_write_mode():
                _print_answer(path.name, described, as_json=asked.json)
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(paths)} images could not be answered for: {', '.join(failed)}")


def _read_readable(matcher: Any, paths: Any, failed: list[str]) -> Iterator[tuple[Path, Any]]:
    """(path, image) of the files that can be answered for; why others cannot is said, ``failed`` takes their names."""
    for path in paths:
        try:
            image = mmgsd.read_image(path)
            matcher.compute_input_size(image, str(path))
        except (ValueError, OSError) as error:
            failed.append(path.name)
            paths.write(f"skipped: {say_error(error)}", file=sys.stderr)
        else:
            yield path, image


def _print_answer(name: str, described: list[dict[str, Any]], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"image1": name, "queries": described}), flush=True)
    else:
        print("\n".join(f"{name} {format_query(query)}" for query in described), flush=True)


def _list_rows(name: str, described: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """A row a mode, its pixels as x1, y1."""
    for query in described:
        shared = {key: value for key, value in query.items() if key not in ("xy", "modes")}
        shared |= {"image1": name, **dict(zip("xy", query["xy"], strict=True))}
        for k, mode in enumerate(query["modes"]):
            x1, y1 = mode["xy"]
            yield {**shared, "mode": k + 1, "x1": x1, "y1": y1, **{n: v for n, v in mode.items() if n != "xy"}}


@contextmanager
def _writing_rows(path: Path) -> Iterator[csv.DictWriter]:
    """A writer of `COLUMNS` to a file that appears whole or not at all."""
    with writing(path) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        yield table


def _check_written(asked: argparse.Namespace, paths: list[Path]) -> None:
    """ValueError for a result that would replace an image, or a picture of more queries than a page holds."""
    read = {path.resolve() for path in (asked.image0, asked.mask0, asked.mask1, *paths) if path}
    for name in ("out", "csv"):
        place = getattr(asked, name)
        if place and place.resolve() in read:
            raise ValueError(f"--{name} must not be one of the images, got {place}")
    if asked.pictures and asked.pictures.resolve() in {path.parent for path in read}:
        raise ValueError(f"--pictures must not be a folder of the images, got {asked.pictures}")
    if asked.out or asked.pictures:
        from mmgsd.figures.plots import PAGE_QUERIES

        if len(asked.xy) > PAGE_QUERIES:
            option = "--out" if asked.out else "--pictures"
            raise ValueError(f"--xy must be given at most {PAGE_QUERIES} times with {option}, got {len(asked.xy)}")


def draw_answer(answer: Any, path: Path) -> None:
    """One query as two large panels, several as a page."""
    from mmgsd.figures.plots import plot_page

    save_picture(answer.plot() if len(answer) == 1 else plot_page(answer), path)


def save_picture(figure: Any, path: Path) -> None:
    """A figure, as a file of the kind that its name ends with."""
    import matplotlib

    matplotlib.use("Agg")
    with writing(path) as aside:
        figure.savefig(aside, format=path.suffix[1:].lower(), dpi=DPI, bbox_inches="tight", pad_inches=0.05)


def segment(asked: argparse.Namespace) -> None:
    """Write the probability of the object in each pixel as a grey PNG, white where it is certain."""
    if asked.out.suffix.lower() != ".png":
        raise ValueError(f"out must end with .png, got {asked.out}")
    if asked.out.resolve() == asked.image.resolve():
        raise ValueError(f"out must not be the image itself, got {asked.out}")
    mask = mmgsd.load(asked.weights).segment(mmgsd.read_image(asked.image))
    grey = np.rint(255 * mask).astype(np.uint8)
    write_bytes(asked.out, cv2.imencode(".png", grey)[1].tobytes())
    print(f"{asked.out}: brighter than half on the object, {np.mean(mask > 0.5):.0%} of the image")


def measure(asked: argparse.Namespace) -> None:
    """Measure on marked photographs: print a table or JSON, write a contact sheet and the results where asked."""
    from mmgsd.figures.photographs import ContactSheet
    from mmgsd.measure.photographs import check_name, make_photographs_table, measure_photographs, store_photographs

    if asked.store:
        check_name(asked.store)
    if asked.out and asked.out.exists() and asked.out.resolve().is_relative_to(asked.place.resolve()):
        raise ValueError(f"--out must not replace a file among the photographs, got {asked.out}")
    sheet = ContactSheet()
    looking = {"seen": sheet.add} if asked.out else {}
    results = measure_photographs(asked.weights, asked.place, progress=sys.stderr.isatty(), **looking)
    if asked.out:
        save_picture(sheet.plot(), asked.out)
    if asked.store:
        store_photographs(results, asked.store)
    print(json.dumps(results) if asked.json else make_photographs_table(results), flush=True)


def export(asked: argparse.Namespace) -> None:
    """Write a network as ONNX."""
    from mmgsd.extras.exporting import export_onnx

    difference = export_onnx(mmgsd.load(asked.weights), asked.out)
    print(f"{asked.out}: images of any size in, descriptors as of Matcher.describe out, the mean over quarter turns "
          f"included; they differ from torch's by {difference:.1e} at most")  # fmt: skip


def calibrate(asked: argparse.Namespace) -> None:
    """Fit what ellipses, radii and confidences promise, and keep it in the file of weights."""
    from mmgsd.measure.calibration import calibrate_weights

    found = mmgsd.load(calibrate_weights(asked.weights, asked.data, overwrite=asked.overwrite)).calibration
    print(f"{asked.weights}: calibrated on {found.pairs} pairs of held-out simulations; each half by the other: "
          f"ECE {found.ece_ellipse:.3f} of ellipses, {found.ece_confidence:.3f} of confidences")  # fmt: skip


def heads(asked: argparse.Namespace) -> None:
    """Measure what weights tell beside their matches, and store it."""
    from mmgsd.config import EvaluateConfig
    from mmgsd.files import read_json
    from mmgsd.measure.heads import evaluate_heads

    print(json.dumps(read_json(evaluate_heads(asked.weights, asked.data, EvaluateConfig(pairs=100), asked.out))))
