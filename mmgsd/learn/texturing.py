"""Another texture on the object of a training image: pictures, patches, letters and borders that lie on its surface.

A rendered data set has as many textures as simulations, other people's towels have any. Where each pixel lies on the
surface is interpolated between the material points that are seen, and the shading of the image is kept.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import scipy
from scipy.spatial import cKDTree

from mmgsd.learn.compositing import crop, draw_colour, draw_things, fill_area
from mmgsd.symmetry import locate_points

TEXTURE_PX = 160  # side of a texture
KINDS = ("picture", "filled", "patches", "motifs", "plain")
SHARES = {"cloth": (0.2, 0.15, 0.25, 0.3, 0.1), "rope": (0.05, 0.35, 0.1, 0.0, 0.5)}  # of the kinds
FRAMED = 0.4  # share of a cloth's textures with a border
BRIGHT = 80  # percentile of an object's grey values that is taken for its colour under full light
DARKEST, BRIGHTEST = 0.15, 1.3  # of the shading
GLYPHS = [chr(code) for code in range(33, 127)]

Borrow = Callable[[], tuple[np.ndarray, np.ndarray]]


def retexture(
    image: np.ndarray, mask: np.ndarray, xy: np.ndarray, visible: np.ndarray, object: str, borrow: Borrow,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """The image (h, w, 3) uint8 with another texture on the object under ``mask`` (h, w) uint8.

    ``xy`` (P, 2) are px of this image, ``visible`` (P,) bool; with fewer than four of them seen it stays as it is.
    ``borrow`` draws another image with its mask.
    """
    rows, columns = mask.nonzero()
    if visible.sum() < 4 or not len(rows):
        return image
    places = _lay_on(mask, xy[visible], locate_points(object, len(xy))[visible], object)
    texture = draw_texture(object, borrow, rng)
    colours = cv2.remap(texture, places * (TEXTURE_PX - 1), None, cv2.INTER_LINEAR)[rows, columns]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[rows, columns].astype(np.float32)
    full = max(16.0, float(np.percentile(grey, BRIGHT)))
    shade = ((grey / full) ** rng.uniform(0.5, 1.2)).clip(DARKEST, BRIGHTEST)[:, None]
    share = mask[rows, columns, None] / np.float32(255)
    printed = image.copy()
    seen = share * (colours * shade).clip(0, 255) + (1 - share) * image[rows, columns]
    printed[rows, columns] = seen.astype(np.uint8)
    return printed


def draw_texture(object: str, borrow: Borrow, rng: np.random.Generator) -> np.ndarray:
    """A square picture (T, T, 3) uint8."""
    shape = TEXTURE_PX, TEXTURE_PX
    shares = SHARES[object]
    kind = str(rng.choice(KINDS, p=shares))
    if kind == "picture":
        texture = crop(borrow()[0], shape, rng)
    elif kind == "patches":
        texture = _sew_patches(borrow, rng)
    elif kind == "filled":
        texture = fill_area(shape, rng)
    else:
        texture = np.broadcast_to(draw_colour(rng).astype(np.uint8), (*shape, 3)).copy()
    if kind == "motifs":
        _write_motifs(texture, rng)
    if object != "rope" and rng.random() < FRAMED:
        _draw_border(texture, rng)
    return texture


def _lay_on(mask: np.ndarray, xy: np.ndarray, flat: np.ndarray, object: str) -> np.ndarray:
    """(h, w, 2) float32 in [0, 1], where each pixel of a ``mask`` lies on the texture: every second, then between."""
    height, width = mask.shape
    small = cv2.resize(mask, (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA)
    small = cv2.dilate(small, np.ones((3, 3)))
    rows, columns = small.nonzero()
    there = np.zeros((*small.shape, 2), np.float32)
    there[rows, columns] = _interpolate(xy, flat, np.stack([columns, rows], -1) * 2 + 0.5, object)
    return cv2.resize(there, (width, height), interpolation=cv2.INTER_LINEAR)


def _interpolate(xy: np.ndarray, flat: np.ndarray, places: np.ndarray, object: str) -> np.ndarray:
    """(K, 2) in [0, 1], where ``places`` (K, 2) px lie on the texture; beyond points seen, where the nearest does."""
    _, nearest = cKDTree(xy).query(places)
    uv = flat[nearest]
    if object != "rope" and np.linalg.matrix_rank(xy - xy.mean(0), tol=1.0) == 2:
        between = scipy.interpolate.LinearNDInterpolator(xy, flat)(places)
        uv = np.where(np.isnan(between), uv, between)
    return uv.clip(0, 1)


def _sew_patches(borrow: Borrow, rng: np.random.Generator) -> np.ndarray:
    """A quilt: rows and columns of patches of up to four kinds, some with seams between."""
    texture = np.empty((TEXTURE_PX, TEXTURE_PX, 3), np.uint8)
    rows, columns = (_cut(rng) for _ in range(2))
    kinds = [fill_area(texture.shape[:2], rng) if rng.random() < 0.7 else crop(borrow()[0], texture.shape[:2], rng)
             for _ in range(rng.integers(2, 5))]  # fmt: skip
    seam, colour = (int(rng.integers(1, 9)) if rng.random() < 0.5 else 0), draw_colour(rng)
    for top, bottom in zip(rows, rows[1:], strict=False):
        for left, right in zip(columns, columns[1:], strict=False):
            part = slice(top, bottom), slice(left, right)
            texture[part] = kinds[rng.integers(len(kinds))][part]
            if seam:
                cv2.rectangle(texture, (int(left), int(top)), (int(right) - 1, int(bottom) - 1), colour.tolist(), seam)
    return texture


def _cut(rng: np.random.Generator) -> np.ndarray:
    """Where a side is cut into 2 to 7 parts, px, its ends included."""
    between = np.linspace(0, 1, int(rng.integers(3, 9)))
    between[1:-1] += rng.uniform(-0.3, 0.3, len(between) - 2) / len(between) * (rng.random() < 0.5)
    return np.rint(between * TEXTURE_PX).astype(int)


def _write_motifs(texture: np.ndarray, rng: np.random.Generator) -> None:
    """Letters, marks and shapes here and there, in place."""
    if rng.random() < 0.6:
        draw_things(texture, rng, int(rng.integers(1, 5)), size=(0.05, 0.4), shadows=False)
    for _ in range(int(rng.integers(6))):
        text = "".join(rng.choice(GLYPHS, int(rng.integers(1, 9))))
        x, y = rng.uniform(0, TEXTURE_PX, 2).astype(int).tolist()
        cv2.putText(texture, text, (x - 20, y), int(rng.integers(8)), float(rng.uniform(0.4, 2.5)),
                    draw_colour(rng).tolist(), int(rng.integers(1, 6)), cv2.LINE_AA)  # fmt: skip


def _draw_border(texture: np.ndarray, rng: np.random.Generator) -> None:
    """One to three lines along all edges, at the edges or inside them, in place."""
    for _ in range(int(rng.integers(1, 4))):
        inset, width = int(rng.integers(0, TEXTURE_PX // 4)), int(rng.integers(2, 14))
        low, high = inset, TEXTURE_PX - 1 - inset
        cv2.rectangle(texture, (low, low), (high, high), draw_colour(rng).tolist(), width)
