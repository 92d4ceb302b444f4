"""Training images put together from an object and another background: cheap clutter, and the labels follow.

An object is cut out by its mask and laid, with a soft shadow, on a background that it was not rendered with: a
procedural texture, or what surrounds the object in another training image. Things lie behind it (sheets of its own
size among them: a board's corners are not the cloth's) and in front of it, where they hide material points. All of it
is drawn at the network's own small size, by OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

REPLACED = 0.7  # share of the images whose background is replaced, where pasting is on
REMOVED = 0.05  # share that lose their object: there is nothing to be found
COVERED = 0.3  # share with things in front of the object
THINGS = 5  # fewer than so many lie behind the object
BORROWED = 0.5  # share of the new backgrounds that come from other training images
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # of a square
ALIKE, UNDER = 0.25, 0.5  # of the object's area: a thing so large is like it, one that has so much of it lies under it
NATURAL, FLAT = 0.35, 0.2  # of the procedural ones: noise of all scales, and one colour


@dataclass(frozen=True)
class Picture:
    """An image in the making."""

    image: np.ndarray  # (h, w, 3) uint8
    mask: np.ndarray  # (h, w) uint8, 255 on the object where it is seen
    covered: np.ndarray  # (h, w) bool, where something lies in front
    present: bool = True  # whether the object is in it at all


def composite(
    image: np.ndarray, mask: np.ndarray, borrow: Callable[[], tuple[np.ndarray, np.ndarray]],
    rng: np.random.Generator, *, lookalikes_beside: bool = True,
) -> Picture:  # fmt: skip
    """Give an image (h, w, 3) uint8 with its object's ``mask`` (h, w) uint8 another background, things and occluders.

    ``borrow`` draws another image with its mask, of any size. What happens is up to ``rng``, see the constants. Without
    ``lookalikes_beside`` nothing as large as a cloth lies beside the object, only under it: which of two is the cloth?
    """
    present, replaced = rng.random() >= REMOVED, rng.random() < REPLACED
    if replaced or not present:
        ground = _draw_ground(image.shape[:2], borrow, rng)
        under = None if lookalikes_beside or not present else mask
        draw_things(ground, rng, int(rng.integers(THINGS)), size=(0.15, 1.1) if present else (0.05, 0.3), under=under)
        image, mask = (_paste(ground, image, mask, rng), mask) if present else (ground, np.zeros_like(mask))
    covered = np.zeros(mask.shape, bool)
    if rng.random() < COVERED:
        image = image.copy()
        covered = draw_things(image, rng, int(rng.integers(1, 3)), size=(0.06, 0.35))
        mask = np.where(covered, 0, mask)
    return Picture(image, mask, covered, present)


def draw_things(
    image: np.ndarray, rng: np.random.Generator, count: int, *, size: tuple[float, float] = (0.15, 1.1),
    under: np.ndarray | None = None, shadows: bool = True,
) -> np.ndarray:  # fmt: skip
    """Draw sheets, boxes, discs and bars with soft shadows into ``image`` (h, w, 3) uint8, in place.

    Their sides are ``size`` of the image's longer side. ``under`` is the mask (h, w) uint8 of an object that
    will be laid on top: things as large that would lie beside it are left out. Returns where they lie, (h, w) bool.
    """
    covered = np.zeros(image.shape[:2], bool)
    for _ in range(count):
        shape = _draw_shape(image.shape[:2], rng, size)
        x, y, width, height = cv2.boundingRect(shape)
        if not width:
            continue  # it lies out of the picture
        if under is not None and _lies_beside(shape > 0, under > 0):
            continue
        if shadows:
            _cast_shadow(image, shape, rng)
        part = slice(y, y + height), slice(x, x + width)
        cv2.copyTo(fill_area((height, width), rng), shape[part], image[part])
        covered |= shape > 0
    return covered


def disturb(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a camera does to an image (h, w, 3) uint8, each now and then: grey, blurred, vignetted, hard JPEG."""
    if rng.random() < 0.12:
        image = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    if rng.random() < 0.03:
        image = _look_like_depth(image, rng)
    if rng.random() < 0.2:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.6))
    if rng.random() < 0.15:
        image = _darken_corners(image, rng)
    if rng.random() < 0.2:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(15, 80))]
        image = cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR)
    return image


def fill_object(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image (h, w, 3) uint8 without its object: blurred surroundings in its place."""
    away = cv2.erode((mask < 64).astype(np.float32), np.ones((5, 5)))
    small = max(1, min(mask.shape) // 32)
    size = (mask.shape[1] // small, mask.shape[0] // small)
    weight = cv2.resize(away, size, interpolation=cv2.INTER_AREA) + 1e-4
    colours = cv2.resize(image * away[..., None], size, interpolation=cv2.INTER_AREA)
    reach = (0, 0), max(size) / 8
    filled = cv2.GaussianBlur(colours, *reach) / cv2.GaussianBlur(weight, *reach)[..., None]
    filled = cv2.resize(filled, mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    inside = cv2.dilate(mask, np.ones((5, 5), np.uint8))[..., None] > 32
    return np.where(inside, filled.clip(0, 255).astype(np.uint8), image)


def _draw_ground(
    shape: tuple[int, int], borrow: Callable[[], tuple[np.ndarray, np.ndarray]], rng: np.random.Generator
) -> np.ndarray:
    if rng.random() < BORROWED:
        other, mask = borrow()
        return crop(fill_object(other, mask), shape, rng)
    return fill_area(shape, rng, black_or_white=0.12)


def crop(image: np.ndarray, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """A turned and mirrored part of an image, resized to (h, w)."""
    image = np.rot90(image, int(rng.integers(4)))[:: 1 if rng.random() < 0.5 else -1]
    sides = [max(8, int(side * rng.uniform(0.5, 1.0))) for side in image.shape[:2]]
    y, x = (int(rng.integers(whole - part + 1)) for whole, part in zip(image.shape[:2], sides, strict=True))
    part = np.ascontiguousarray(image[y : y + sides[0], x : x + sides[1]])
    return cv2.resize(part, shape[::-1], interpolation=cv2.INTER_LINEAR)


def fill_area(shape: tuple[int, int], rng: np.random.Generator, *, black_or_white: float = 0.05) -> np.ndarray:
    """An area (h, w, 3) of one colour, noise, stripes or checks."""
    colour = draw_colour(rng)
    kind = rng.random()
    if kind < black_or_white:
        return np.full((*shape, 3), 255 * int(rng.random() < 0.4), np.uint8)
    if kind < black_or_white + FLAT:
        return np.broadcast_to(colour.astype(np.uint8), (*shape, 3)).copy()
    levels = (_draw_noise if kind < black_or_white + FLAT + NATURAL else _draw_pattern)(shape, rng)
    other = colour + rng.uniform(-1, 1, 3) * rng.choice([15, 50, 160])
    ramp = colour + np.linspace(0, 1, 256)[:, None] * (other - colour)  # (256, 3)
    return cv2.applyColorMap(levels, ramp.clip(0, 255).astype(np.uint8)[:, None])


def draw_colour(rng: np.random.Generator) -> np.ndarray:
    """(3,) in 0 to 255: as many greys as colours."""
    grey = rng.uniform(0, 255)
    return (grey + rng.uniform(-1, 1, 3) * rng.choice([4, 30, 120])).clip(0, 255).astype(np.float32)


def _draw_noise(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Smooth noise (h, w) uint8 of two scales."""
    fields = []
    for _ in range(2):
        cells = int(np.exp(rng.uniform(np.log(2), np.log(60))))
        coarse = rng.integers(256, size=(cells, cells), dtype=np.uint8)
        fields.append(cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC))
    return cv2.addWeighted(fields[0], 0.65, fields[1], 0.35, 0)


def _draw_pattern(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Stripes or checks (h, w) uint8, 0 and 255, at any angle, as planks, tiles and prints are."""
    angle, wave = rng.uniform(0, np.pi), max(shape) * np.exp(rng.uniform(np.log(0.02), np.log(0.4)))
    y, x = np.ogrid[: shape[0], : shape[1]]
    across = ((x * np.cos(angle) + y * np.sin(angle)) / wave).astype(np.float32)
    along = ((y * np.cos(angle) - x * np.sin(angle)) / wave).astype(np.float32)
    width = rng.uniform(0.05, 0.95)
    stripes = (across % 1) < width
    kind = rng.random()
    if kind < 0.4:
        return 255 * stripes.astype(np.uint8)
    second = (along % 1) < width
    return 255 * (stripes ^ second if kind < 0.7 else stripes & second).astype(np.uint8)


def _draw_shape(shape: tuple[int, int], rng: np.random.Generator, size: tuple[float, float]) -> np.ndarray:
    """A convex thing, (h, w) uint8, 255 inside: two thirds quadrilaterals, else ellipses and long bars."""
    canvas, whole = np.zeros(shape, np.uint8), max(shape)
    middle = rng.uniform(-0.1, 1.1, 2) * shape[::-1]
    sides = whole * rng.uniform(*size, 2)
    kind, angle = rng.random(), 0.0 if rng.random() < 0.4 else rng.uniform(0, np.pi)
    if kind < 0.65:
        sides[1] = sides[0] if rng.random() < 0.4 else sides[1]
        corners = CORNERS * sides / 2
        corners = corners * (1 + rng.uniform(-0.12, 0.12, (4, 2)) * (rng.random() < 0.4))
    elif kind < 0.82:
        turn = np.linspace(0, 2 * np.pi, 40)[:-1]
        sides[1] = sides[0] if rng.random() < 0.6 else sides[1]
        corners = np.stack([np.cos(turn), np.sin(turn)], -1) * sides / 2
    else:
        corners = CORNERS * (whole * rng.uniform(0.3, 1.2), whole * rng.uniform(0.01, 0.08)) / 2
    c, s = np.cos(angle), np.sin(angle)
    places = corners @ np.array([[c, s], [-s, c]]) + middle
    cv2.fillConvexPoly(canvas, np.rint(places * 8).astype(np.int32), 255, cv2.LINE_8, 3)
    return canvas


def _lies_beside(thing: np.ndarray, object: np.ndarray) -> bool:
    """Whether a thing (h, w) bool is large enough to be taken for the object, and not mostly under it."""
    return thing.sum() > ALIKE * object.sum() and (thing & object).sum() < UNDER * object.sum()


def _cast_shadow(image: np.ndarray, shape: np.ndarray, rng: np.random.Generator) -> None:
    """Darken what lies around a thing (h, w) uint8, softly and a little to one side."""
    depth, width = rng.uniform(0, 0.6), max(shape.shape) * rng.uniform(0.004, 0.03)
    if depth < 0.1:
        return
    quarter = [max(4, side // 4) for side in shape.shape[::-1]]  # a shadow is soft: a sixteenth of the pixels will do
    shift = np.float32([[1, 0, rng.normal(0, width / 4)], [0, 1, rng.normal(0, width / 4)]])
    shadow = cv2.warpAffine(cv2.resize(shape, quarter, interpolation=cv2.INTER_AREA), shift, quarter)
    shade = cv2.convertScaleAbs(cv2.GaussianBlur(shadow, (0, 0), max(0.5, width / 4)), alpha=-depth, beta=255)
    shade = cv2.resize(shade, shape.shape[::-1], interpolation=cv2.INTER_LINEAR)
    cv2.multiply(image, cv2.merge([shade] * 3), image, scale=1 / 255)


def _paste(ground: np.ndarray, image: np.ndarray, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The object of ``image`` on ``ground`` with a soft shadow."""
    _cast_shadow(ground, mask, rng)
    share = cv2.merge([mask] * 3)
    return cv2.add(cv2.multiply(image, share, scale=1 / 255), cv2.multiply(ground, 255 - share, scale=1 / 255))


def _darken_corners(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    y, x = (np.linspace(-1, 1, n, dtype=np.float32) for n in image.shape[:2])
    radius = (x - rng.normal(0, 0.2)) ** 2 + (y[:, None] - rng.normal(0, 0.2)) ** 2
    return (image * (1 - rng.uniform(0.1, 0.35) * radius).clip(0, 1)[..., None]).astype(np.uint8)


def _look_like_depth(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Smooth grey with faint relief, or a colour map of it, as depth cameras' pictures are shown."""
    grey = cv2.bilateralFilter(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 7, 40, 5)
    if rng.random() < 0.5:
        return cv2.applyColorMap(grey, int(rng.choice([cv2.COLORMAP_JET, cv2.COLORMAP_TURBO, cv2.COLORMAP_VIRIDIS])))
    return cv2.merge([(rng.uniform(60, 160) + rng.uniform(0.2, 0.5) * grey).clip(0, 255).astype(np.uint8)] * 3)
