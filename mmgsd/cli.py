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
from mmgsd.match.match import LIKELY

DPI = 150  # of a picture
NAMED = 10  # of what is left out of a folder
COLUMNS = (
    "image1", "x", "y", "mode", "x1", "y1", "weight", "spread_px", "confidence", "visible", "entropy", "outside",
    "on_object", "absent", "said",
)  # fmt: skip


def say_error(error: BaseException) -> str:
    """An error in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def match(args: argparse.Namespace) -> None:
    """Answer for one image, or for each of a folder."""
    if args.image1.is_dir():
        _match_folder(args)
        return
    _check_written(args, [args.image1])
    if args.pictures:
        raise ValueError(f"--pictures must be given with a folder as image1, got {args.image1}: use --out")
    images = [mmgsd.read_image(path) for path in (args.image0, args.image1)]
    files = {"mask0": args.mask0, "mask1": args.mask1}
    masks = {k: f and read_mask(f, im.shape[:2]) for (k, f), im in zip(files.items(), images, strict=True)}
    answer = mmgsd.load(args.weights).match(*images, args.xy, n=args.n, joint=args.joint, **masks)
    answer = answer.seen_first() if args.seen_first else answer
    described = describe_answer(answer)
    if args.out:
        draw_answer(answer, args.out)
    if args.csv:
        with _writing_rows(args.csv) as table:
            table.writerows(_list_rows(args.image1.name, described))
    print(json.dumps(described) if args.json else "\n".join(map(format_query, described)), flush=True)


def find(args: argparse.Namespace) -> None:
    """Answer where places of the object are in an image."""
    image = mmgsd.read_image(args.image)
    mask = args.mask and read_mask(args.mask, image.shape[:2])
    answer = mmgsd.load(args.weights).find(image, args.places, joint=args.joint, mask=mask)
    answer = answer.seen_first() if args.seen_first else answer
    described = [{"place": place, **query} for place, query in zip(args.places, describe_answer(answer), strict=True)]
    if args.out:
        draw_answer(answer, args.out)
    lines = (f"{_name_place(query['place'])} -> {format_query(query).partition(' -> ')[2]}" for query in described)
    print(json.dumps(described) if args.json else "\n".join(lines), flush=True)


def _name_place(place: Any) -> str:
    return ",".join(f"{value:g}" for value in place) if isinstance(place, tuple) else f"{place}"


def _match_folder(args: argparse.Namespace) -> None:
    """Answer for one image after the other; RuntimeError at the end where some could not be answered for."""
    if args.out or args.mask0 or args.mask1:
        raise ValueError(f"--out, --mask0 and --mask1 must be given with one image1, got the folder {args.image1}: "
                         "use --pictures")  # fmt: skip
    from tqdm import tqdm

    paths, image0 = list_images(args.image1), mmgsd.read_image(args.image0)
    _check_written(args, paths)
    check_pixels(args.xy, image0.shape[1::-1])
    matcher, failed = mmgsd.load(args.weights), []
    matcher.compute_input_size(image0, "image0")
    bar = tqdm(paths, desc="match", unit="image", disable=not sys.stderr.isatty())
    _say_left_out(args.image1, paths)
    named, frames = itertools.tee(_read_readable(matcher, bar, failed))
    answers = matcher.match_many(((image0, image1, args.xy) for _, image1 in frames), n=args.n, joint=args.joint)
    plain = len({path.stem.casefold() for path in paths}) == len(paths)  # a.png and a.jpg are two pictures
    with _writing_rows(args.csv) if args.csv else nullcontext() as table:
        for (path, _), answer in zip(named, answers, strict=True):
            answer = answer.seen_first() if args.seen_first else answer
            described = describe_answer(answer)
            if table:
                table.writerows(_list_rows(path.name, described))
            if args.pictures:
                draw_answer(answer, args.pictures / f"{path.stem if plain else path.name}.png")
            with tqdm.external_write_mode():
                _print_answer(path.name, described, as_json=args.json)
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(paths)} images could not be answered for: {', '.join(failed)}")


def _say_left_out(folder: Path, paths: list[Path]) -> None:
    names = [path.name for path in sorted({*folder.iterdir()}.difference(paths)) if not path.name.startswith(".")]
    if names:
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        print(f"left out, as they do not end as images do: {', '.join(names[:NAMED])}{more}", file=sys.stderr)


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
            told = {name: value for name, value in mode.items() if name not in ("xy", "answer")}
            yield {**shared, "mode": mode.get("answer", k + 1), "x1": x1, "y1": y1, **told}


@contextmanager
def _writing_rows(path: Path) -> Iterator[csv.DictWriter]:
    """A writer of `COLUMNS` to a file that appears whole or not at all."""
    with writing(path) as aside, open(aside, "w", newline="", encoding="utf-8", errors="backslashreplace") as file:
        table = csv.DictWriter(file, COLUMNS, restval="")
        table.writeheader()
        yield table


def _check_written(args: argparse.Namespace, paths: list[Path]) -> None:
    """ValueError for a result that would replace an image, or a picture of more queries than a page holds."""
    read = {path.resolve() for path in (args.image0, args.mask0, args.mask1, *paths) if path}
    for name in ("out", "csv"):
        place = getattr(args, name)
        if place and place.resolve() in read:
            raise ValueError(f"--{name} must not be one of the images, got {place}")
    if args.pictures and args.pictures.resolve() in {path.parent for path in read}:
        raise ValueError(f"--pictures must not be a folder of the images, got {args.pictures}")
    if args.out or args.pictures:
        from mmgsd.figures.plots import PAGE_QUERIES

        if len(args.xy) > PAGE_QUERIES:
            option = "--out" if args.out else "--pictures"
            raise ValueError(f"--xy must be given at most {PAGE_QUERIES} times with {option}, got {len(args.xy)}")


def draw_answer(answer: Any, path: Path) -> None:
    """One query as two large panels, several as a page."""
    from mmgsd.figures.plots import plot_page

    save_picture(answer.plot() if len(answer) == 1 else plot_page(answer), path)


def draw_moves(look: Any, image: np.ndarray, moves: np.ndarray, path: Path) -> None:
    """What a demonstration's look did, beside moves (M, 2, 2) px in an image."""
    from mmgsd.figures.folding import plot_moves

    save_picture(plot_moves({"demonstration": (look.image, look.moves), "now": (image, moves)}), path)


def save_picture(figure: Any, path: Path) -> None:
    """A figure, as a file of the kind that its name ends with."""
    with writing(path) as aside:
        figure.savefig(aside, format=path.suffix[1:].lower(), dpi=DPI, bbox_inches="tight", pad_inches=0.05)


def track(args: argparse.Namespace) -> None:
    """Follow points through a video; what is interrupted keeps the frames that were finished."""
    from mmgsd.match.recording import list_outputs, recording
    from mmgsd.progress import ProgressBar
    from mmgsd.video import open_video

    video, outputs = open_video(args.video), list_outputs(args.out)
    if args.video.resolve() in (path.resolve() for path in outputs):
        raise ValueError(f"--out must not be the video itself, got {args.out}")
    images, frames = itertools.tee(video)
    mask0 = args.mask0 and read_mask(args.mask0, next(iter(video)).shape[:2])
    followed = mmgsd.load(args.weights).follow(frames, args.xy, find=args.find, mask0=mask0)
    absent, stopped = [], None
    written = " and ".join(map(str, outputs))
    with recording(outputs, video.rate) as record:
        try:
            for one in ProgressBar(followed, desc="track", unit="frame", total=video.count):
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
        raise RuntimeError(f"none of the frames shows the object that {args.weights} knows")


def segment(args: argparse.Namespace) -> None:
    """Write the probability of the object in each pixel as a grey PNG, white where it is certain."""
    if args.out.suffix.lower() != ".png":
        raise ValueError(f"--out must end with .png, got {args.out}")
    if args.out.resolve() == args.image.resolve():
        raise ValueError(f"--out must not be the image itself, got {args.out}")
    mask = mmgsd.load(args.weights).segment(mmgsd.read_image(args.image))
    grey = np.rint(255 * mask).astype(np.uint8)
    write_bytes(args.out, cv2.imencode(".png", grey)[1].tobytes())
    print(f"{args.out}: brighter than half on the object, {np.mean(mask > 0.5):.0%} of the image")


def measure(args: argparse.Namespace) -> None:
    """Measure on marked photographs: print a table or JSON, write a contact sheet and the results where asked for."""
    from mmgsd.measure.photographs import check_name, make_photographs_table, measure_photographs, store_photographs

    if args.store:
        check_name(args.store)
    if args.out and args.out.exists() and args.out.resolve().is_relative_to(args.place.resolve()):
        raise ValueError(f"--out must not replace a file among the photographs, got {args.out}")
    from mmgsd.figures.photographs import ContactSheet  # last: its hint would name the extra of pictures alone

    sheet = ContactSheet()
    looking = {"seen": sheet.add} if args.out else {}
    results = measure_photographs(args.weights, args.place, progress=sys.stderr.isatty(), **looking)
    if args.out:
        save_picture(sheet.plot(), args.out)
    if args.store:
        store_photographs(results, args.store)
    print(json.dumps(results) if args.json else make_photographs_table(results), flush=True)


def adapt(args: argparse.Namespace) -> None:
    """Go on from weights with photographs, and print the card of what that did."""
    out = mmgsd.adapt(args.folder, args.weights, args.out, renders=args.renders, overwrite=args.overwrite)
    print(out.with_suffix(".md").read_text("utf-8"), end="")


def samples(args: argparse.Namespace) -> None:
    """Print the paths of the sample images of an object, a line each."""
    print(*mmgsd.find_samples(args.object), sep="\n")


def export(args: argparse.Namespace) -> None:
    """Write a network as ONNX."""
    from mmgsd.extras.exporting import export_onnx

    difference = export_onnx(mmgsd.load(args.weights), args.out)
    print(f"{args.out}: images in, what Matcher.describe says of them out, the mean over quarter turns included; it "
          f"differs from torch's single precision by {difference:.1e} at most, and from Matcher.describe, which takes "
          "bfloat16 for some layers on a CPU, by up to 1e-2")  # fmt: skip


def page(args: argparse.Namespace) -> None:
    """Write a page that matches in a browser."""
    from mmgsd.extras.page import make_page

    folder = make_page(mmgsd.load(args.weights), args.out, name=Path(args.weights).stem, runtime=args.runtime)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(f"{folder}: {size / 1e6:.0f} MB; to try it: python -m http.server --directory {folder}")


def calibrate(args: argparse.Namespace) -> None:
    """Fit what ellipses, radii and confidences promise, and keep it in the file of weights."""
    from mmgsd.measure.calibration import calibrate_unseen, calibrate_weights

    calibrated = calibrate_weights if args.data else calibrate_unseen
    matcher = mmgsd.load(calibrated(args.weights, args.data or args.unseen, overwrite=args.overwrite))
    found, reading = matcher.calibration, matcher.reading
    print(f"{args.weights}: modes read with power {reading.power:g} and sharpness {reading.sharpness:g}; "
          f"calibrated on {found.pairs} pairs of held-out simulations; each half by the other: "
          f"ECE {found.ece_ellipse:.3f} of ellipses, {found.ece_confidence:.3f} of confidences")  # fmt: skip


def heads(args: argparse.Namespace) -> None:
    """Measure what weights tell beside their matches, and store it."""
    from mmgsd.config import EvaluateConfig
    from mmgsd.files import read_json
    from mmgsd.measure.heads import evaluate_heads

    print(json.dumps(read_json(evaluate_heads(args.weights, args.data, EvaluateConfig(pairs=100), args.out))))


def fold(args: argparse.Namespace) -> None:
    """Say where to pick and place in a picture, as a demonstration did."""
    from mmgsd.fold.demonstration import read_demonstration
    from mmgsd.fold.moves import answer_picture
    from mmgsd.match.camera import compute_rays

    demonstration, image = read_demonstration(args.demonstration), mmgsd.read_image(args.image)
    if args.out and args.out.resolve() == args.image.resolve():
        raise ValueError(f"--out must not be the image itself, got {args.out}")
    answer = answer_picture(mmgsd.load(args.weights), demonstration, image, look=args.look, chosen=args.chosen)
    if args.out:
        draw_moves(demonstration.looks[args.look], image, answer.moves, args.out)
    moves = [{"pick": pick, "place": place} for pick, place in answer.moves.round(1).tolist()]
    if args.intrinsics is not None:
        rays = compute_rays(answer.moves, args.intrinsics).round(5).tolist()
        moves = [
            {**move, "pick_ray": pick, "place_ray": place} for move, (pick, place) in zip(moves, rays, strict=True)
        ]
    if args.json:
        print(json.dumps({"moves": moves, "agreement": round(answer.share, 3)}), flush=True)
        return
    for move in moves:
        told = {name: ",".join(f"{number:g}" for number in numbers) for name, numbers in move.items()}
        rays = f" (rays {told['pick_ray']} and {told['place_ray']})" if "pick_ray" in told else ""
        print(f"pick {told['pick']} place {told['place']}{rays}")
    print(f"{answer.share:.0%} of the demonstration's pixels agree", flush=True)
