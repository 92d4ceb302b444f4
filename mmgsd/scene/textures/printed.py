"""Pictures for a workspace's materials: what is printed, woven or stuck on a cloth, a rope, a board or a book.

All are (H, W, 3) uint8 sRGB, painted from an explicit ``rng``; the photographs are those that scikit-image,
scikit-learn and Matplotlib carry, and parts of Blender's environment maps.
"""

from __future__ import annotations

import functools
import importlib.util
import string
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mmgsd.scene.geometry import choose, log_uniform
from mmgsd.scene.lighting import draw_part
from mmgsd.scene.textures.colours import RGB, draw_colour, draw_other_rgb, draw_rgb, to_linear, to_srgb, vary_rgb
from mmgsd.scene.textures.procedural import draw_clutter

SIDE = 512  # px of a picture
PHOTOGRAPHS = {  # package: files of its own
    "skimage/data": (
        "astronaut.png", "brick.png", "chelsea.png", "coffee.png", "grass.png", "gravel.png", "hubble_deep_field.jpg",
        "ihc.png", "motorcycle_left.png", "page.png", "retina.jpg", "rocket.jpg", "text.png", "color.png", "camera.png",
        "coins.png", "motorcycle_right.png",
    ),
    "sklearn/datasets/images": ("china.jpg", "flower.jpg"),
    "matplotlib/mpl-data/sample_data": ("grace_hopper.jpg",),
}  # fmt: skip
FILES = tuple(f"{folder}/{name}" for folder, names in PHOTOGRAPHS.items() for name in names)

Paint = Callable[[np.random.Generator, RGB], np.ndarray]


# Pictures. ------------------------------------------------------------------------------------------------------------


@functools.cache
def load_photograph(name: str) -> np.ndarray:
    """One of `FILES`, square."""
    package, _, inside = name.partition("/")
    image = Image.open(Path(importlib.util.find_spec(package).origin).parent / inside).convert("RGB")
    side = min(image.size)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    return np.asarray(image.crop((left, top, left + side, top + side)).resize((SIDE, SIDE)))


def paint_photograph(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """A part of a photograph or of an environment map, mirrored, turned and tinted at random."""
    image = draw_part(rng, SIDE) if rng.random() < 0.3 else load_photograph(str(rng.choice(FILES)))
    side = int(rng.uniform(0.25, 1.0) * SIDE)
    left, top = rng.integers(0, SIDE - side + 1, size=2)
    part = np.rot90(image[top : top + side, left : left + side][:, :: rng.choice([-1, 1])], rng.integers(4))
    if rng.random() < 0.4:
        part = part[..., rng.permutation(3)]
    return np.asarray(Image.fromarray(np.ascontiguousarray(part)).resize((SIDE, SIDE)))


def paint_collage(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """Parts of photographs and areas of one colour over each other, of all sizes: edges at every scale."""
    image = Image.fromarray(paint_photograph(rng, colour))
    for _ in range(rng.integers(4, 40)):
        reach = SIDE * log_uniform(rng, 0.03, 0.4, 2)
        left, top = (rng.uniform(-0.2, 1.0, size=2) * SIDE).astype(int)
        size = tuple(np.maximum(2, reach.astype(int)).tolist())
        part = Image.new("RGB", size, draw_rgb(rng))
        if rng.random() < 0.5:
            part = Image.fromarray(paint_photograph(rng, colour)).resize(size)
        shape = Image.new("L", size, 0)
        pen = ImageDraw.Draw(shape)
        (pen.ellipse if rng.random() < 0.5 else pen.rectangle)([0, 0, size[0] - 1, size[1] - 1], fill=255)
        turn = float(rng.uniform(0, 360))
        image.paste(part.rotate(turn, expand=True), (left, top), shape.rotate(turn, expand=True))
    return np.array(image)


def paint_clutter(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """Polygons, discs and lines of random colours."""
    return np.array(draw_clutter(rng, to_linear(colour)))


def paint_mosaic(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """A grid of patches of many colours."""
    rows, columns = rng.integers(3, 14, size=2)
    palette = np.array([draw_rgb(rng) for _ in range(rng.integers(3, 9))] + [colour])
    patches = palette[rng.integers(len(palette), size=(rows, columns))].astype(np.uint8)
    return np.array(Image.fromarray(patches).resize((SIDE, SIDE), Image.Resampling.NEAREST))


def paint_page(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """A printed page: a heading, lines of text, boxes."""
    image = Image.new("RGB", (SIDE, SIDE), colour)
    pen, ink = ImageDraw.Draw(image), draw_other_rgb(rng, colour, distance=120)
    y = rng.integers(20, 60)
    while y < SIDE - 40:
        size = int(rng.choice([14, 18, 40]))
        if rng.random() < 0.2:
            pen.rectangle([30, y, rng.integers(100, SIDE - 30), y + 3 * size], fill=draw_rgb(rng))
            y += 3 * size + 12
        else:
            pen.text((30, y), _write(rng, SIDE // size), fill=ink, font=_font(size))
            y += int(1.3 * size)
    return np.array(image)


def paint_lines(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """A cutting mat's or a graph paper's lines, both ways."""
    image = np.full((SIDE, SIDE, 3), colour, dtype=np.uint8)
    step, line = int(rng.choice([16, 32, 64, 128])), draw_other_rgb(rng, colour, distance=40)
    width = int(rng.integers(1, 4))
    for k in range(width):
        image[k::step], image[:, k::step] = line, line
    return image


def paint_gradient(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """One colour turns into another."""
    to, share = np.array(draw_rgb(rng)), np.linspace(0, 1, SIDE)[:, None, None]
    image = np.broadcast_to((1 - share) * np.array(colour) + share * to, (SIDE, SIDE, 3))
    return np.rot90(image, rng.integers(4)).astype(np.uint8)


PICTURES: dict[str, Paint] = {
    "photograph": paint_photograph, "clutter": paint_clutter, "mosaic": paint_mosaic, "page": paint_page,
    "lines": paint_lines, "gradient": paint_gradient, "collage": paint_collage,
}  # fmt: skip


def _write(rng: np.random.Generator, length: int) -> str:
    letters = np.array(list(string.ascii_letters + string.digits + "     "))
    return "".join(rng.choice(letters, size=max(2, int(length * rng.uniform(0.4, 1.6)))))


@functools.cache
def _font(size: int) -> ImageFont.ImageFont:
    return ImageFont.load_default(size)


# Cloth. ---------------------------------------------------------------------------------------------------------------


def paint_cloth(rng: np.random.Generator, colour: RGB) -> tuple[np.ndarray, str]:
    """The face of a cloth, edge to edge, and the name of its pattern; hems, embroidery and stickers on some."""
    name = choose(rng, SHARES)
    image = Image.fromarray(np.ascontiguousarray(FABRICS[name](rng, colour)))
    pen = ImageDraw.Draw(image)
    if rng.random() < 0.35:
        _hem(rng, pen, colour)
    for _ in range(int(rng.choice([0, 1, 2, 4], p=[0.6, 0.2, 0.1, 0.1]))):
        _embroider(rng, pen, colour)
    if rng.random() < 0.22:
        _stick(rng, pen)
    return np.array(image), name


def _mottled(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """Blotches from threads to stains, of one colour's shades."""
    cells = int(log_uniform(rng, 6, 250))
    noise = rng.integers(0, 256, size=(cells, cells), dtype=np.uint8)
    share = np.asarray(Image.fromarray(noise).resize((SIDE, SIDE), Image.Resampling.BICUBIC))[..., None] / 255
    return ((1 - share) * np.array(colour) + share * np.array(vary_rgb(rng, colour, 0.3))).astype(np.uint8)


def _bands(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """Colours (SIDE, 3) of stripes along a line, periodic or not."""
    palette = [colour, draw_other_rgb(rng, colour)] + [draw_rgb(rng) for _ in range(rng.integers(0, 3))]
    count = int(log_uniform(rng, 3, 40))
    widths = rng.uniform(0.2, 1.0, size=count) ** 2
    order = np.arange(count) % len(palette) if rng.random() < 0.6 else rng.integers(len(palette), size=count)
    if rng.random() < 0.6:  # as regular as a loom's
        widths = widths[: len(palette)][np.arange(count) % min(count, len(palette))]
    edges = np.cumsum(widths) / widths.sum() * SIDE
    return np.array(palette)[order[np.searchsorted(edges, np.arange(SIDE) + 0.5).clip(0, count - 1)]]


def _striped(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    image = np.broadcast_to(_bands(rng, colour)[:, None], (SIDE, SIDE, 3)).astype(np.uint8)
    return np.rot90(image, rng.integers(2))


def _plaid(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    across = _bands(rng, colour)
    along = across if rng.random() < 0.5 else _bands(rng, colour)
    return ((across[:, None] + along[None]) // 2).astype(np.uint8)


def _printed(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """A picture over all of the cloth."""
    names = ["photograph", "collage", "clutter", "mosaic", "page", "gradient"]
    return PICTURES[str(rng.choice(names, p=[0.35, 0.25, 0.12, 0.12, 0.08, 0.08]))](rng, colour)


def _repeated(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """A small motif again and again."""
    side = int(rng.choice([32, 64, 128]))
    image = Image.new("RGB", (side, side), colour)
    pen = ImageDraw.Draw(image)
    for _ in range(rng.integers(1, 5)):
        _draw_motif(rng, pen, rng.uniform(0.2, 0.8, size=2) * side, rng.uniform(0.06, 0.3) * side, draw_rgb(rng))
    return np.tile(np.asarray(image), (SIDE // side, SIDE // side, 1))


def _quilted(rng: np.random.Generator, colour: RGB) -> np.ndarray:
    """Panels with a border of their own on a ground of one colour."""
    image = Image.new("RGB", (SIDE, SIDE), colour)
    pen, panel, frame = ImageDraw.Draw(image), draw_rgb(rng), draw_other_rgb(rng, colour)
    rows, columns, gap = rng.integers(2, 6), rng.integers(1, 6), rng.uniform(0.03, 0.15)
    for row in range(rows):
        for column in range(columns):
            box = (np.array([column + gap, row + gap, column + 1 - gap, row + 1 - gap])
                   / [columns, rows, columns, rows] * SIDE)  # fmt: skip
            pen.rectangle(box.tolist(), fill=panel, outline=frame, width=int(rng.integers(3, 12)))
            _draw_motif(rng, pen, (box[:2] + box[2:]) / 2, np.min(box[2:] - box[:2]) / 3.5, draw_rgb(rng))
    return np.array(image)


FABRICS: dict[str, Paint] = {
    "plain": lambda rng, colour: np.full((SIDE, SIDE, 3), colour, dtype=np.uint8), "mottled": _mottled,
    "striped": _striped, "plaid": _plaid, "printed": _printed, "repeated": _repeated, "quilted": _quilted,
}  # fmt: skip
SHARES = {
    "plain": 0.3, "mottled": 0.1, "striped": 0.16, "plaid": 0.08, "printed": 0.22, "repeated": 0.08, "quilted": 0.06,
}  # fmt: skip


def _draw_motif(rng: np.random.Generator, pen: ImageDraw.ImageDraw, centre: np.ndarray, reach: float,
                colour: RGB) -> None:  # fmt: skip
    """A disc, a ring, a polygon, a cross or letters."""
    (x, y), kind = centre, rng.choice(["disc", "ring", "polygon", "cross", "letters"])
    box = [x - reach, y - reach, x + reach, y + reach]
    if kind == "disc":
        pen.ellipse(box, fill=colour)
    elif kind == "ring":
        pen.ellipse(box, outline=colour, width=max(1, int(reach / 3)))
    elif kind == "polygon":
        circle, turn = (x, y, max(1.0, reach)), int(rng.integers(360))
        pen.regular_polygon(circle, int(rng.integers(3, 8)), rotation=turn, fill=colour)
    elif kind == "cross":
        pen.rectangle([x - reach, y - reach / 3, x + reach, y + reach / 3], fill=colour)
        pen.rectangle([x - reach / 3, y - reach, x + reach / 3, y + reach], fill=colour)
    else:
        size = max(8, int(reach))
        pen.text((x - reach, y - reach / 2), _write(rng, 5), fill=colour, font=_font(size))


def _hem(rng: np.random.Generator, pen: ImageDraw.ImageDraw, colour: RGB) -> None:
    """A band along all four edges, or a braid of dashes."""
    out, width = int(rng.choice([0, rng.integers(0, 40)])), int(rng.integers(4, 34))
    trim = draw_other_rgb(rng, colour)
    pen.rectangle([out, out, SIDE - 1 - out, SIDE - 1 - out], outline=trim, width=width)
    if rng.random() < 0.4:
        dash, second = int(rng.integers(6, 24)), draw_other_rgb(rng, trim)
        for k in range(out, SIDE - out, 2 * dash):
            for box in ([k, out, k + dash, out + width], [k, SIDE - 1 - out - width, k + dash, SIDE - 1 - out]):
                pen.rectangle(box, fill=second)
                pen.rectangle([box[1], box[0], box[3], box[2]], fill=second)


def _embroider(rng: np.random.Generator, pen: ImageDraw.ImageDraw, colour: RGB) -> None:
    """A logo of a few motifs somewhere on the cloth."""
    centre, reach = rng.uniform(0.12, 0.88, size=2) * SIDE, rng.uniform(0.02, 0.16) * SIDE
    for _ in range(rng.integers(1, 6)):
        offset = rng.uniform(-1, 1, size=2) * reach
        _draw_motif(rng, pen, centre + offset, rng.uniform(0.3, 1.0) * reach, draw_other_rgb(rng, colour))


def _stick(rng: np.random.Generator, pen: ImageDraw.ImageDraw) -> None:
    """Stickers at corners, and on some cloths at the edges' middles and the centre."""
    reach, inset = rng.uniform(0.02, 0.07) * SIDE, rng.uniform(0.02, 0.09) * SIDE
    near, far, half = inset, SIDE - inset, SIDE / 2
    places = [(near, near), (near, far), (far, near), (far, far)]
    if rng.random() < 0.6:
        places += [(half, near), (half, far), (near, half), (far, half), (half, half)]
    same = draw_rgb(rng) if rng.random() < 0.4 else None
    for x, y in places:
        if rng.random() < 0.9:
            fill, box = same or to_srgb(draw_colour(rng)), [x - reach, y - reach, x + reach, y + reach]
            (pen.rectangle if rng.random() < 0.7 else pen.ellipse)(box, fill=fill)


# Rope. ----------------------------------------------------------------------------------------------------------------

ROPE_LENGTH_PX, ROPE_ROUND_PX = 1024, 16


def paint_rope(rng: np.random.Generator, colour: RGB) -> tuple[np.ndarray, str]:
    """The skin (16, 1024, 3) of a rope, along it and around it, and the name of its pattern."""
    image = np.full((ROPE_ROUND_PX, ROPE_LENGTH_PX, 3), colour, dtype=np.uint8)
    name = str(rng.choice(["plain", "flecked", "banded", "halves", "spiral"], p=[0.5, 0.16, 0.14, 0.1, 0.1]))
    along, around = np.arange(ROPE_LENGTH_PX), np.arange(ROPE_ROUND_PX)[:, None]
    second = draw_other_rgb(rng, colour)
    if name == "flecked":
        coarse = rng.random((ROPE_ROUND_PX // 2, ROPE_LENGTH_PX // 4)) < rng.uniform(0.05, 0.4)
        image[np.kron(coarse, np.ones((2, 4), dtype=bool))] = second
    elif name == "banded":  # tape, marks, heat-shrink tubes
        for _ in range(rng.integers(1, 6)):
            start = rng.integers(ROPE_LENGTH_PX)
            image[:, start : start + rng.integers(6, 60)] = draw_rgb(rng)
    elif name == "halves":
        share = 1 / (1 + np.exp(-(along - rng.uniform(0.3, 0.7) * ROPE_LENGTH_PX) / rng.uniform(1, 150)))[:, None]
        image[:] = (1 - share) * np.array(colour) + share * np.array(second)
    elif name == "spiral":
        turns = rng.integers(10, 60)
        wave = (along / ROPE_LENGTH_PX * turns + around / ROPE_ROUND_PX) % 1
        image[wave < rng.uniform(0.15, 0.5)] = second
    return image, name
