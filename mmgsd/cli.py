"""What answers from a shell: the commands of ``python -m mmgsd`` that ask weights, a function each."""

from __future__ import annotations

import argparse
import itertools
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from csv import DictWriter
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from tqdm import tqdm

import mmgsd
from mmgsd.command import Option, describe_error
from mmgsd.config import MAX_MODES, OBJECTS
from mmgsd.files import atomic_write, write_bytes
from mmgsd.images import check_pixels, list_images
from mmgsd.match.camera import read_intrinsics
from mmgsd.match.describe import describe_answer, format_query
from mmgsd.match.match import LIKELY

PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg")
DPI = 150  # of a picture
NAMED = 10  # of what is left out of a folder
COLUMNS = (
    "image1", "x", "y", "mode", "x1", "y1", "weight", "spread_px", "confidence", "visible", "entropy", "outside",
    "on_object", "absent", "said",
)  # fmt: skip


def parse_image(text: str) -> Path:
    """The path of an image, - for what is piped in."""
    return Path("/dev/stdin" if text == "-" else text)


def parse_pixel(text: str) -> tuple[float, float]:
    """(column, row)."""
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"must be column,row such as 212,148, got {text!r}")
    try:
        return float(parts[0]), float(parts[1])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be two numbers such as 212,148, got {text!r}") from error


def parse_place(text: str) -> Any:
    """A name, the number of a point, a fraction, or two of these."""
    if re.fullmatch(r"[A-Za-z_]+", text):
        return text
    try:
        parts = tuple(map(float, text.split(",")))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be a name, a number or U,V, got {text!r}") from error
    return int(text) if text.isdecimal() else parts[0] if len(parts) == 1 else parts


def parse_picture(text: str) -> Path:
    """The path of a picture to draw."""
    if Path(text).suffix.lower() not in PICTURES:
        raise argparse.ArgumentTypeError(f"must end with .png, .jpg, .pdf or .svg, got {text!r}")
    return Path(text)


def parse_intrinsics(text: str) -> np.ndarray:
    """The camera's matrix."""
    try:
        return read_intrinsics([float(number) for number in text.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be FX,FY,CX,CY, or nine numbers: {error}") from error


def parse_number(text: str) -> int | str:
    """A number of modes, or auto."""
    if text == "auto" or (text.isdecimal() and len(text) < 4 and 1 <= int(text) <= MAX_MODES):
        return text if text == "auto" else int(text)
    raise argparse.ArgumentTypeError(f"must be a number from 1 to {MAX_MODES}, or auto, got {text!r}")


Weights = Annotated[str, Option("a trained model (safetensors), or a name in data/weights, like cloth", metavar="FILE")]
Trained = Annotated[Path, Option("a trained model (safetensors)")]
Image = Annotated[Path, Option(type=parse_image)]
Mask = Annotated[Path, Option(type=parse_image, metavar="FILE")]
Picture = Annotated[Path, Option("draw the answer (png, jpg, pdf or svg)", type=parse_picture, metavar="FILE")]
Printed = Annotated[bool, Option("print the answer as JSON")]
Folder = Annotated[Path, Option(metavar="FOLDER")]


def match(
    image0: Annotated[Image, Option("the image that the pixels are in, - for what is piped in")],
    image1: Annotated[Image, Option("the image to find them in, or a folder of such images")],
    *,
    xy: Annotated[list, Option("column,row px in image0, the top left one is 0,0; may be given several times",
                               type=parse_pixel, action="append", metavar="X,Y")],
    weights: Weights,
    n: Annotated[Any, Option("modes, or auto (default: its symmetry's)", type=parse_number, metavar="N")] = None,
    joint: Annotated[bool, Option("answer all pixels together: the modes of one number belong together")] = False,
    seen_first: Annotated[bool, Option("list matches that are seen before hidden ones")] = False,
    mask0: Annotated[Mask, Option("an image as large as image0, brighter than half on the object")] | None = None,
    mask1: Annotated[Mask, Option("an image as large as image1, brighter than half on the object")] | None = None,
    out: Picture | None = None,
    pictures: Annotated[Folder, Option("draw the answer of each image of a folder")] | None = None,
    csv: Annotated[Path, Option("write a table, a row a mode", metavar="FILE")] | None = None,
    json: Annotated[bool, Option("print the answer as JSON, of a folder a line an image")] = False,
) -> None:  # fmt: skip
    """Find all matches of pixels of an image in another, or in each of a folder; those that cannot be read are named.

    example: %(prog)s towel1.jpg towel2.jpg --xy 212,148 --weights FILE --out match.png
    """
    many = image1.is_dir()
    if many and (out or mask0 or mask1):
        raise ValueError(f"--out, --mask0 and --mask1 must be given with one image1, got the folder {image1}: "
                         "use --pictures")  # fmt: skip
    if pictures and not many:
        raise ValueError(f"--pictures must be given with a folder as image1, got {image1}: use --out")
    _check_order(joint, seen_first)
    paths = list_images(image1) if many else [image1]
    _check_written([path for path in (image0, mask0, mask1, *paths) if path], out=out, csv=csv, pictures=pictures)
    _check_drawn(xy, "--out" if out else "--pictures" if pictures else "")
    reference, failed = mmgsd.read_image(image0), []
    check_pixels(xy, reference.shape[1::-1])
    matcher = mmgsd.load(weights)
    matcher.compute_input_size(reference, "image0")
    if many:
        _say_left_out(image1, paths)
    images = _read_readable(matcher, paths, failed) if many else [(image1, mmgsd.read_image(image1))]
    named, images = itertools.tee(images)
    answers = matcher.match_many(((reference, image, xy, mask0, mask1) for _, image in images), n=n, joint=joint)
    plain = len({path.stem.casefold() for path in paths}) == len(paths)  # a.png and a.jpg are two pictures
    with _writing_rows(csv) if csv else nullcontext() as table:
        for (path, _), answer in zip(named, answers, strict=True):
            answer = answer.seen_first() if seen_first else answer
            described = describe_answer(answer)
            if table:
                table.writerows(_list_rows(path.name, described))
            if out or pictures:
                draw_answer(answer, out or pictures / f"{path.stem if plain else path.name}.png")
            if many:
                with tqdm.external_write_mode():
                    _print_answer(path.name, described, as_json=json)
    if not many:  # once the table is written, which may be to the same terminal
        _print_answer("", described, as_json=json)
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(paths)} images could not be answered for: {', '.join(failed)}")


def find(
    image: Annotated[Image, Option("the image to find them in")],
    *places: Annotated[Any, Option("corners, edges, centre or U,V in [0, 1] of a cloth; ends, middle or a fraction "
                                   "such as 0.25 of a rope; of any object the number of a material point",
                                   type=parse_place, metavar="PLACE")],
    weights: Weights,
    joint: Annotated[bool, Option("answer all places together")] = False,
    seen_first: Annotated[bool, Option("list places that are seen before hidden ones")] = False,
    mask: Annotated[Mask, Option("brighter than half on the object")] | None = None,
    out: Picture | None = None,
    json: Printed = False,
) -> None:  # fmt: skip
    """Find places of the object by name, without a first image."""
    _check_order(joint, seen_first)
    answer = mmgsd.load(weights).find(mmgsd.read_image(image), list(places), joint=joint, mask=mask)
    answer = answer.seen_first() if seen_first else answer
    described = [{"place": place, **query} for place, query in zip(places, describe_answer(answer), strict=True)]
    if out:
        draw_answer(answer, out, [*map(_name_place, places)])
    lines = (f"{_name_place(query['place'])} -> {format_query(query).partition(' -> ')[2]}" for query in described)
    print(dumps(described) if json else "\n".join(lines), flush=True)


def track(
    video: Annotated[Path, Option("a video, an animated GIF or WebP, or a folder of frames")],
    *,
    xy: Annotated[list, Option("column,row px in the first frame; may be given several times", type=parse_pixel,
                               action="append", metavar="X,Y")] = None,
    find: Annotated[list, Option("instead, places as the command find takes them, such as corners", type=parse_place,
                                 action="append", metavar="PLACE")] = None,
    weights: Weights,
    mask0: Annotated[Mask, Option("brighter than half on the first frame's object")] | None = None,
    out: Annotated[Path, Option("what to write: .csv, .json, .mp4, .webm or .avi, or a folder for several",
                                metavar="PLACE")],
) -> None:  # fmt: skip
    """Follow points through a video; what is interrupted keeps the frames that were finished."""
    if bool(xy) == bool(find):
        raise ValueError(f"one of --xy and --find must be given, got {'both' if xy else 'neither'}")
    from mmgsd.match.recording import list_outputs, recording
    from mmgsd.progress import ProgressBar
    from mmgsd.video import open_video

    clip, outputs = open_video(video), list_outputs(out)
    if video.resolve() in (path.resolve() for path in outputs):
        raise ValueError(f"--out must not be the video itself, got {out}")
    images, frames = itertools.tee(clip)
    followed = mmgsd.load(weights).follow(frames, xy, find=find, mask0=mask0)
    absent, stopped = [], None
    written = " and ".join(map(str, outputs))
    with recording(outputs, clip.rate) as record:
        try:
            for one in ProgressBar(followed, desc="track", unit="frame", total=clip.count):
                record(next(images), one)
                absent.append(one.absent > LIKELY)
        except (Exception, KeyboardInterrupt) as error:
            if not absent:
                raise
            stopped = error
    if isinstance(stopped, KeyboardInterrupt):
        raise KeyboardInterrupt(f"{written} hold the first {len(absent)} frames")
    print(f"{written}: {len(absent)} frames, the object is not seen in {sum(absent)} of them", flush=True)
    if stopped:
        raise stopped
    if all(absent):
        raise RuntimeError(f"none of the frames shows the object that {weights} knows")


def segment(
    image: Annotated[Image, Option("the image to look at")],
    *,
    out: Annotated[Path, Option("the mask to write, .png: brighter than half on the object", metavar="FILE")],
    weights: Weights,
) -> None:
    """Write where an image shows the object: a grey PNG, white where that is certain."""
    if out.suffix.lower() != ".png":
        raise ValueError(f"--out must end with .png, got {out}")
    _check_written([image], out=out)
    mask = mmgsd.load(weights).segment(mmgsd.read_image(image))
    grey = np.rint(255 * mask).astype(np.uint8)
    write_bytes(out, cv2.imencode(".png", grey)[1].tobytes())
    print(f"{out}: brighter than half on the object, {np.mean(mask > 0.5):.0%} of the image")


def measure(
    place: Annotated[Folder, Option("with index.json, or such a file; its format: mmgsd/measure/photographs.py")],
    *,
    weights: Weights = "cloth",
    out: Annotated[Picture, Option("draw an answer about each photograph")] | None = None,
    store: Annotated[str, Option("write the numbers to data/results/photographs_NAME.json", metavar="NAME")] = "",
    json: Annotated[bool, Option("print the numbers as JSON")] = False,
) -> None:
    """Measure on photographs with marked corners or ends."""
    from mmgsd.measure.photographs import check_name, make_photographs_table, measure_photographs, store_photographs

    if store:
        check_name(store)
    if out and out.exists() and out.resolve().is_relative_to(place.resolve()):
        raise ValueError(f"--out must not replace a file among the photographs, got {out}")
    from mmgsd.figures.photographs import ContactSheet  # last: its hint would name the extra of pictures alone

    sheet = ContactSheet()
    looking = {"seen": sheet.add} if out else {}
    results = measure_photographs(weights, place, progress=sys.stderr.isatty(), **looking)
    if out:
        save_picture(sheet.plot(), out)
    if store:
        store_photographs(results, store)
    print(dumps(results) if json else make_photographs_table(results), flush=True)


def adapt(
    folder: Annotated[Folder, Option("photographs, with marks in an index.json as measure reads it, or such a file")],
    *,
    weights: Weights = "cloth",
    out: Annotated[Path, Option("the weights to write (safetensors)", metavar="FILE")],
    renders: Annotated[Folder, Option("a data set of the object: it keeps what is known (default: the sample)")]
    | None = None,
    overwrite: Annotated[bool, Option("replace weights that were made of anything else")] = False,
) -> None:
    """Go on from weights with photographs, and print the card of what that did."""
    written = mmgsd.adapt(folder, weights, out, renders=renders, overwrite=overwrite)
    print(written.with_suffix(".md").read_text("utf-8"), end="")


def fold(
    demonstration: Annotated[Path, Option("see docs/folding.md", metavar="DEMO.json")],
    image: Annotated[Image, Option("a picture of the present state")],
    *,
    weights: Weights,
    look: Annotated[int, Option("which of the demonstration's looks (default: 0, the first)")] = 0,
    chosen: Annotated[str, Option("which like modes are taken: those that one motion agrees with (the default), each "
                                  "pixel's surest, or the surest that belong together",
                                  choices=("agree", "best", "joint"))] = "agree",
    by_name: Annotated[bool, Option("look for the places that the demonstration names, not for its pixels")] = False,
    intrinsics: Annotated[Any, Option("px, or the nine numbers of the matrix; prints rays too", type=parse_intrinsics,
                                      metavar="FX,FY,CX,CY")] = None,
    out: Annotated[Picture, Option("draw the moves (png, jpg, pdf or svg)")] | None = None,
    json: Printed = False,
) -> None:  # fmt: skip
    """Say where to pick and place in a picture, as a demonstration did."""
    from mmgsd.fold.demonstration import read_demonstration
    from mmgsd.fold.moves import answer_picture
    from mmgsd.match.camera import compute_rays

    demo, now = read_demonstration(demonstration), mmgsd.read_image(image)
    _check_written([image], out=out)
    answer = answer_picture(mmgsd.load(weights), demo, now, look=look, chosen=chosen, by_name=by_name)
    if out:
        from mmgsd.figures.folding import plot_moves

        reference = demo.looks[look]
        pictures = {"demonstration": (reference.image, reference.moves), "now": (now, answer.moves)}
        save_picture(plot_moves(pictures), out)
    columns = {"pick": answer.moves[:, 0].round(1), "place": answer.moves[:, 1].round(1)}
    if intrinsics is not None:
        rays = compute_rays(answer.moves, intrinsics).round(5)
        columns |= {"pick_ray": rays[:, 0], "place_ray": rays[:, 1]}
    moves = [{name: values[k].tolist() for name, values in columns.items()} for k in range(len(answer.moves))]
    if json:
        print(dumps({"moves": moves, "agreement": round(answer.share, 3)}), flush=True)
        return
    for move in moves:
        texts = {name: ",".join(f"{number:g}" for number in numbers) for name, numbers in move.items()}
        rays = f" (rays {texts['pick_ray']} and {texts['place_ray']})" if "pick_ray" in texts else ""
        print(f"pick {texts['pick']} place {texts['place']}{rays}")
    print(f"{answer.share:.0%} of the demonstration's pixels agree", flush=True)


def export(*, out: Annotated[Path, Option("the file to write, .onnx", metavar="FILE")], weights: Weights) -> None:
    """Write a network as ONNX: image in, descriptors out."""
    from mmgsd.extras.exporting import export_onnx

    difference = export_onnx(mmgsd.load(weights), out)
    print(f"{out}: images in, what Matcher.describe says of them out, the mean over quarter turns included; it "
          f"differs from torch's single precision by {difference:.1e} at most, and from Matcher.describe, which takes "
          "bfloat16 for some layers on a CPU, by up to 1e-2")  # fmt: skip


def page(
    out: Annotated[Path, Option("the folder to write; docs/page.md says how to host it", metavar="OUT")],
    *,
    weights: Weights = "cloth",
    runtime: Annotated[Folder, Option("the npm package onnxruntime-web, unpacked; by default npm downloads it")]
    | None = None,
) -> None:
    """Write a page that matches in a browser."""
    from mmgsd.extras.page import make_page

    folder = make_page(mmgsd.load(weights), out, name=Path(weights).stem, runtime=runtime)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {size / 1e6:.0f} MB; to try it: python -m http.server --directory {folder}")


def calibrate(
    weights: Trained,
    *,
    data: Annotated[Folder, Option("the data set trained on")] | None = None,
    unseen: Annotated[list[Path], Option("data sets whose test images were not trained on: by them how modes are read "
                                         "is chosen, too", nargs="+", metavar="FOLDER")] | None = None,
    overwrite: Annotated[bool, Option("fit it anew where the weights have it")] = False,
) -> None:  # fmt: skip
    """Fit what ellipses, radii and confidences promise, by either --data or --unseen, and keep it in the weights."""
    if bool(data) == bool(unseen):
        raise ValueError(f"one of --data and --unseen must be given, got {'both' if data else 'neither'}")
    from mmgsd.measure.calibration import calibrate_unseen, calibrate_weights

    calibrated = calibrate_weights if data else calibrate_unseen
    matcher = mmgsd.load(calibrated(weights, data or unseen, overwrite=overwrite))
    calibration, readout = matcher.calibration, matcher.readout
    print(f"{weights}: modes read with power {readout.exponent:g} and sharpness {readout.mean_exponent:g}, "
          f"sources with shrinkage {matcher.shrinkage:g}; "
          f"calibrated on {calibration.pairs} pairs of held-out simulations; each half by the other: ECE "
          f"{calibration.ece_ellipse:.3f} of ellipses, {calibration.ece_confidence:.3f} of confidences")  # fmt: skip


def heads(
    weights: Trained,
    *,
    data: Annotated[Folder, Option("the data set trained on")],
    out: Annotated[Path, Option("the results to write (JSON)", metavar="FILE")],
) -> None:
    """Measure the masks, hidden matches and absence that weights tell beside their matches, and store it."""
    from mmgsd.config import EvaluateConfig
    from mmgsd.files import read_json
    from mmgsd.match.matcher import find_weights
    from mmgsd.measure.heads import evaluate_heads

    print(dumps(read_json(evaluate_heads(find_weights(weights), data, EvaluateConfig(pairs=100), out))))


def samples(object: Annotated[str, Option(choices=OBJECTS)] = "cloth") -> None:
    """Print the paths of two sample images of an object, a line each."""
    print(*mmgsd.find_samples(object), sep="\n")


def draw_answer(answer: Any, path: Path, names: Sequence[str] = ()) -> None:
    """One query as two large panels, several as a page, those for places with their ``names``."""
    from mmgsd.figures.plots import plot_page

    save_picture(answer.plot() if len(answer) == 1 else plot_page(answer, names), path)


def save_picture(figure: Any, path: Path) -> None:
    """A figure, as a file of the kind that its name ends with."""
    with atomic_write(path) as aside:
        figure.savefig(aside, format=path.suffix[1:].lower(), dpi=DPI, bbox_inches="tight", pad_inches=0.05)


def _check_order(joint: bool, seen_first: bool) -> None:
    if joint and seen_first:
        raise ValueError("--seen-first must not be given with --joint, which has an order of its own")


def _check_written(read: Iterable[Path], *, pictures: Path | None = None, **written: Path | None) -> None:
    """ValueError for a result that would replace one of the images that are ``read``."""
    images = {path.resolve() for path in read}
    for name, path in written.items():
        if path and path.resolve() in images:
            raise ValueError(f"--{name} must not be one of the images, got {path}")
    if pictures and pictures.resolve() in {path.parent for path in images}:
        raise ValueError(f"--pictures must not be a folder of the images, got {pictures}")


def _check_drawn(xy: list, how: str) -> None:
    """ValueError for more queries than a page holds, where an option draws them."""
    if how:
        from mmgsd.figures.plots import PAGE_QUERIES

        if len(xy) > PAGE_QUERIES:
            raise ValueError(f"--xy must be given at most {PAGE_QUERIES} times with {how}, got {len(xy)}")


def _say_left_out(folder: Path, paths: list[Path]) -> None:
    names = [path.name for path in sorted({*folder.iterdir()}.difference(paths)) if not path.name.startswith(".")]
    if names:
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        print(f"left out, as they do not end as images do: {', '.join(names[:NAMED])}{more}", file=sys.stderr)


def _read_readable(matcher: Any, paths: list[Path], failed: list[str]) -> Iterator[tuple[Path, np.ndarray]]:
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


def _print_answer(name: str, described: list[dict[str, Any]], *, as_json: bool) -> None:
    """Of an image of a folder with its ``name``."""
    if as_json:
        print(dumps({"image1": name, "queries": described} if name else described), flush=True)
    else:
        print("\n".join(f"{name} {format_query(query)}".lstrip() for query in described), flush=True)


def _name_place(place: Any) -> str:
    return ",".join(f"{value:g}" for value in place) if isinstance(place, tuple) else f"{place}"


def _list_rows(name: str, described: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """A row a mode, its pixels as x1, y1."""
    for query in described:
        shared = {key: value for key, value in query.items() if key not in ("xy", "modes")}
        shared |= {"image1": name, **dict(zip("xy", query["xy"], strict=True))}
        for k, mode in enumerate(query["modes"]):
            x1, y1 = mode["xy"]
            columns = {name: value for name, value in mode.items() if name not in ("xy", "answer")}
            yield {**shared, "mode": mode.get("answer", k + 1), "x1": x1, "y1": y1, **columns}


@contextmanager
def _writing_rows(path: Path) -> Iterator[DictWriter]:
    """A writer of `COLUMNS` to a file that appears whole or not at all."""
    with atomic_write(path) as aside, open(aside, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        yield table
