"""The one place that reads, encodes and checks images, and the pixels that are asked about."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, ImageSequence, UnidentifiedImageError

CHANNELS = (1, 3, 4)  # grey, RGB, RGBA
MAX_ASPECT = 16  # longer side by shorter side, beyond which too few of the network's cells lie across
HEIC = (".heic", ".heif")
NO_PICTURES = {"BUFR", "EPS", "GRIB", "HDF5", "MPEG", "WMF"}  # kinds whose pixels Pillow alone does not read
LOSSLESS = {"lossless": True, "quality": 20, "method": 0}  # WebP, 25 ms an image; more effort saves a few per cent
WHITE = 255
DEEP = 257  # steps of 16 bits to a step of 8: 65535 becomes 255
OVERSHOOT = 0.01  # beyond [0, 1] that an antialiased or bicubic resize leaves, and that is clipped


def read_image(path: Path | str) -> np.ndarray:
    """(H, W, 3) uint8 RGB of an image file, upright as its camera noted.

    16 bits and floats in [0, 1] are scaled to 8 bits and rounded; of a file with several pictures the first is read;
    transparency is left out: what counts are the colours beneath it; a pipe is read to its end. FileNotFoundError,
    PermissionError, or ValueError for a file that is no image, is damaged, or has other values.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder: give the path of an image file in it")
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: give the path of an image file")
    source = path if path.is_file() else io.BytesIO(path.read_bytes())
    if not (path.stat().st_size if source is path else source.getbuffer().nbytes):
        raise ValueError(f"{path} is empty: get the image anew")
    return decode_image(source, str(path))


def read_animation(path: Path | str) -> Iterator[np.ndarray]:
    """The pictures (H, W, 3) uint8 RGB of an animated GIF, WebP or PNG, one by one; ValueError for a file of one."""
    with _naming(str(path)), Image.open(path) as image:
        if getattr(image, "n_frames", 1) < 2:
            raise _NamedError(f"{path} is a single image: give a video, or a folder of images")
        for frame in ImageSequence.Iterator(image):
            yield np.array(frame.convert("RGB"))


def find_beside(path: Path, name: str) -> Path:
    """The image that a JSON file at ``path`` names, relative to it, be its folders divided by / or as on Windows."""
    place = path.parent / name
    return place if place.exists() else path.parent / name.replace("\\", "/")


def list_images(folder: Path | str) -> list[Path]:
    """The image files of a folder, by their names' endings, in the order of their names; ValueError where it has none.

    The endings are those of all kinds that `read_image` reads. Hidden files and folders in it are left out.
    """
    paths = sorted(path for path in Path(folder).iterdir() if is_image(path))
    files = [path for path in paths if path.is_file() and not path.name.startswith(".")]
    if not files:
        raise ValueError(f"{folder} holds no image: its files must end as images do, with .png, .jpg, .webp, .tif …")
    return files


def is_image(path: Path) -> bool:
    """Whether a file's name ends as those of images do."""
    return path.suffix.lower() in _list_endings()


@cache
def _list_endings() -> set[str]:
    """Of HEIC too, so that it is said how to get it read, and of MPO, which Pillow opens as JPEG."""
    formats = Image.registered_extensions().items()
    return {ending for ending, kind in formats if kind in Image.OPEN and kind not in NO_PICTURES} | {".mpo", *HEIC}


def decode_image(source: Path | io.BytesIO, name: str) -> np.ndarray:
    """As `read_image`, from a file, or its bytes, that is called ``name``."""
    with _naming(name), Image.open(source) as image:
        return _convert(image, name)


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Let what Pillow raises about an image become a ValueError that names it, or stay where it names the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what matters of them is an error
            yield
    except UnidentifiedImageError as error:
        kind = "a HEIC image, which cannot" if name.lower().endswith(HEIC) else "no image that can"
        raise ValueError(f"{name} is {kind} be read: save it as PNG, JPEG, WebP or TIFF") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"{name} has too many pixels ({error}): make it smaller") from error
    except (PermissionError, _NamedError):
        raise
    except Exception as error:  # of a damaged file Pillow raises nearly anything: OSError, SyntaxError, struct.error
        raise ValueError(f"{name} is a damaged image ({error}): get it anew, or save it as PNG") from error


class _NamedError(ValueError):
    """A ValueError that names the file, or the argument, already."""


def _convert(image: Image.Image, name: str) -> np.ndarray:
    """(H, W, 3) uint8 of a Pillow image of any mode, palettes, CMYK and 1 bit included, upright as its camera noted."""
    grey16 = image.mode.startswith("I;16") or (image.format, image.mode) == ("PPM", "I")
    image = ImageOps.exif_transpose(_round_colours(image))
    if grey16:
        return _to_channels(_to_bytes(np.asarray(image).astype(np.uint16), name))
    if image.mode in ("F", "I"):
        return _to_channels(_to_bytes(np.asarray(image), name))
    return np.array(image.convert("RGB"))


def _round_colours(image: Image.Image) -> Image.Image:
    """The same picture, colours of 16 bits rounded to 8: Pillow cuts off the lower ones, OpenCV reads them.

    An image that was loaded before, and what the two do not read alike, stays as Pillow has it.
    """
    if not any(";16" in str(tile) for tile in getattr(image, "tile", ())) or image.mode not in ("LA", "RGB", "RGBA"):
        return image
    import cv2  # only here: the rendering's child processes, which encode images, start faster without

    image.fp.seek(0)
    deep = cv2.imdecode(np.frombuffer(image.fp.read(), np.uint8), cv2.IMREAD_UNCHANGED)
    if deep is None or deep.ndim != 3 or not np.array_equal(deep[..., 2::-1] >> 8, image.convert("RGB")):
        return image
    rounded = Image.fromarray(_to_bytes(np.ascontiguousarray(deep[..., 2::-1]), ""))
    rounded.getexif().update(image.getexif())
    return rounded


def to_rgb(image: Any, name: str = "image") -> np.ndarray:
    """A copy (H, W, 3) uint8 RGB of a grey, RGB or RGBA array, tensor or Pillow image, or of a file by its path.

    (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) of uint8, uint16 (scaled), bool (black and white) or float in [0, 1].
    Transparency is left out: what counts are the colours beneath it. Pillow images are turned upright, as `read_image`
    turns files. ValueError names the argument; of a path, errors are those of `read_image`.
    """
    if isinstance(image, Image.Image):
        with _naming(name):
            return _convert(image, name)
    if isinstance(image, str | os.PathLike):
        return read_image(image)
    values = _to_array(image, name)
    _check_shape(values, name)
    return _to_channels(_to_bytes(values, name))


def check_question(image0: Any, image1: Any, xy: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both images as (H, W, 3) uint8 and the pixels as (S, 2) float32; ValueError names the argument that is wrong."""
    image0, image1 = to_rgb(image0, "image0"), to_rgb(image1, "image1")
    return image0, image1, check_pixels(xy, (image0.shape[1], image0.shape[0]))


def check_pixels(xy: Any, size: tuple[int, int], *, image: str = "image0") -> np.ndarray:
    """Pixels (S, 2) float32 inside ``image`` of ``size`` (width, height), copied; a pair alone is one pixel.

    ValueError otherwise.
    """
    try:
        points = np.array(_to_array(xy, "xy"))
        points = points.astype(np.float64, casting="same_kind" if points.dtype.kind in "biufc" else "unsafe")
    except (TypeError, ValueError) as error:
        raise ValueError(f"xy must be (S, 2) px, got {xy!r:.80}") from error
    if points.shape == (2,) or points.size == 0:
        points = points.reshape(-1, 2)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"xy must be (S, 2) px, got shape {points.shape}")
    inside = np.isfinite(points).all(1) & (points >= -0.5).all(1) & (points <= np.array(size) - 0.5).all(1)
    if not inside.all():
        bad = tuple(points[~inside][0].tolist())
        raise ValueError(f"xy must be finite and inside {image} of {size[0]} x {size[1]} px, got {bad}")
    return points.astype(np.float32)


def check_mask(mask: Any, shape: tuple[int, int], name: str) -> np.ndarray:
    """A copy of a mask (H, W) bool of an image of that ``shape``, or of a path's file what is brighter than half.

    ValueError, which says ``name`` or the path, for another mask, or where it is all False; of a path as `read_image`.
    """
    if isinstance(mask, str | os.PathLike):
        mask, name = read_image(mask).mean(-1) > WHITE / 2, str(mask)
    values = _to_array(mask, name)
    if values.dtype != bool:
        raise ValueError(f"{name} must be bool, True on the object, got {values.dtype}: compare it, as in mask > 127")
    if values.shape != tuple(shape):
        raise ValueError(f"{name} must have its image's shape {tuple(shape)}, got {values.shape}")
    if not values.any():
        raise ValueError(f"{name} must be True somewhere, or brighter than half, got a mask without any object")
    return np.array(values)


def check_aspect(size: tuple[int, int], name: str) -> None:
    """ValueError for an image of ``size`` (width, height) that is too narrow a strip."""
    if max(size) > MAX_ASPECT * min(size):
        raise ValueError(f"{name} must be at most {MAX_ASPECT} times as long as wide, got {size[0]} x {size[1]} px: "
                         "crop it to the object")  # fmt: skip


def _to_array(values: Any, name: str) -> np.ndarray:
    """NumPy's view of an array, a list, a tensor, wherever it lies, or a Pillow image, upright."""
    if hasattr(values, "detach"):  # a torch tensor; this module does without torch
        values = values.detach().cpu()
        values = values.float() if str(values.dtype) == "torch.bfloat16" else values
    if isinstance(values, Image.Image):
        values = ImageOps.exif_transpose(values)
    try:
        return np.asarray(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers, got {type(values).__name__}: {error}") from error


def _check_shape(values: np.ndarray, name: str) -> None:
    """ValueError unless (H, W) or (H, W, C), with what to do about the usual other orders."""
    shape, hint = values.shape, ""
    if len(shape) == 3 and shape[0] in CHANNELS and shape[2] not in CHANNELS:
        hint = ": channels go last, so transpose it (image.transpose(1, 2, 0) of an array, permute of a tensor)"
    elif len(shape) == 4:
        hint = ": give one image of the batch"
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in CHANNELS) or 0 in shape:
        raise ValueError(f"{name} must be (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), got shape {shape}{hint}")


def _to_bytes(values: np.ndarray, name: str) -> np.ndarray:
    """uint8 of the same shape; ValueError for values of which nothing says what is white."""
    kind = values.dtype
    if kind == np.uint8:
        return values
    if kind.kind == "b":
        return values * np.uint8(255)
    if kind.kind == "u" and kind.itemsize == 2:  # of either byte order
        return np.rint(values / DEEP).astype(np.uint8)
    if np.issubdtype(kind, np.floating):
        low, high = values.min(), values.max()  # NaN where one is
        if not -OVERSHOOT <= low <= high <= 1 + OVERSHOOT:
            remedy = "clip it" if -0.5 < low <= high < 1.5 else "divide it by its white"
            raise _NamedError(f"{name} of dtype {kind} must lie in [0, 1], got {low} to {high}: {remedy}")
        return np.rint(values.clip(0, 1) * 255).astype(np.uint8)
    range_ = f" from {values.min()} to {values.max()}" if np.issubdtype(kind, np.integer) else ""
    raise _NamedError(f"{name} must be uint8 or float, got {kind}{range_}: scale it to uint8, uint16 or [0, 1]")


def _to_channels(values: np.ndarray) -> np.ndarray:
    """(H, W, 3), in memory of its own, from (H, W) or (H, W, C)."""
    values = values[..., None] if values.ndim == 2 else values
    values = np.repeat(values, 3, axis=-1) if values.shape[2] == 1 else values[..., :3]
    return np.array(values, order="C")


def encode_image(image: np.ndarray, *, quality: int | None = None) -> bytes:
    """WebP bytes of an (H, W, 3) uint8 image, lossless unless a ``quality`` of 1 to 100 is given.

    The same pixels always give the same bytes.
    """
    how = LOSSLESS if quality is None else {"quality": quality, "method": 6}
    return _encode(image, "WEBP", **how)


def encode_mask(mask: np.ndarray) -> bytes:
    """1-bit PNG bytes of an (H, W) bool mask."""
    return _encode(mask, "PNG", optimize=True)


def _encode(values: np.ndarray, kind: str, **how: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, kind, **how)
    return buffer.getvalue()
