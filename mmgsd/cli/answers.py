"""The commands that answer about images: matches, places, tracks, masks, moves."""

from __future__ import annotations

import itertools
from contextlib import nullcontext
from json import dumps
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from tqdm import tqdm

import mmgsd
from mmgsd.cli.arguments import (
    Folder,
    Image,
    Mask,
    Picture,
    Printed,
    Weights,
    parse_intrinsics,
    parse_number,
    parse_pixel,
    parse_place,
)
from mmgsd.cli.outputs import (
    check_drawn,
    check_order,
    check_written,
    draw_answer,
    list_rows,
    name_place,
    print_answer,
    read_readable,
    save_picture,
    say_left_out,
    writing_rows,
)
from mmgsd.command import Option
from mmgsd.config import OBJECTS
from mmgsd.files import write_bytes
from mmgsd.images import check_pixels, list_images
from mmgsd.match.describe import describe_answer, format_query
from mmgsd.match.match import LIKELY


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
    check_order(joint, seen_first)
    paths = list_images(image1) if many else [image1]
    check_written([path for path in (image0, mask0, mask1, *paths) if path], out=out, csv=csv, pictures=pictures)
    check_drawn(xy, "--out" if out else "--pictures" if pictures else "")
    reference, failed = mmgsd.read_image(image0), []
    check_pixels(xy, reference.shape[1::-1])
    matcher = mmgsd.load(weights)
    matcher.compute_input_size(reference, "image0")
    if many:
        say_left_out(image1, paths)
    images = read_readable(matcher, paths, failed) if many else [(image1, mmgsd.read_image(image1))]
    named, images = itertools.tee(images)
    answers = matcher.match_many(((reference, image, xy, mask0, mask1) for _, image in images), n=n, joint=joint)
    plain = len({path.stem.casefold() for path in paths}) == len(paths)  # a.png and a.jpg are two pictures
    with writing_rows(csv) if csv else nullcontext() as table:
        for (path, _), answer in zip(named, answers, strict=True):
            answer = answer.seen_first() if seen_first else answer
            described = describe_answer(answer)
            if table:
                table.writerows(list_rows(path.name, described))
            if out or pictures:
                draw_answer(answer, out or pictures / f"{path.stem if plain else path.name}.png")
            if many:
                with tqdm.external_write_mode():
                    print_answer(path.name, described, as_json=json)
    if not many:  # once the table is written, which may be to the same terminal
        print_answer("", described, as_json=json)
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
    check_order(joint, seen_first)
    answer = mmgsd.load(weights).find(mmgsd.read_image(image), list(places), joint=joint, mask=mask)
    answer = answer.seen_first() if seen_first else answer
    described = [{"place": place, **query} for place, query in zip(places, describe_answer(answer), strict=True)]
    if out:
        draw_answer(answer, out, [*map(name_place, places)])
    lines = (f"{name_place(query['place'])} -> {format_query(query).partition(' -> ')[2]}" for query in described)
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
    check_written([image], out=out)
    mask = mmgsd.load(weights).segment(mmgsd.read_image(image))
    grey = np.rint(255 * mask).astype(np.uint8)
    write_bytes(out, cv2.imencode(".png", grey)[1].tobytes())
    print(f"{out}: brighter than half on the object, {np.mean(mask > 0.5):.0%} of the image")


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
    check_written([image], out=out)
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


def samples(object: Annotated[str, Option(choices=OBJECTS)] = "cloth") -> None:
    """Print the paths of two sample images of an object, a line each."""
    print(*mmgsd.find_samples(object), sep="\n")
