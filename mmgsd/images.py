"""The one place that reads, encodes and checks images, and the pixels that are asked about."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

CHANNELS = (1, 3, 4)  # grey, RGB, RGBA
MAX_ASPECT = 16  # longer side by shorter side, beyond which too few of the network's cells lie across
ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".gif", ".heic", ".heif")
LOSSLESS = {"lossless": True, "quality": 20, "method": 0}  # WebP, 25 ms an image; more effort saves a few per cent
WHITE = 255
DEEP = 257  # steps of 16 bits to a step of 8: 65535 becomes 255


def read_image(path: Path | str) -> np.ndarray:
    """(H, W, 3) uint8 RGB of an image file, upright as its camera noted.

    16 bits and floats in [0, 1] are scaled to 8 bits; of a file with several pictures the first is read; transparency
    is left out: what counts are the colours beneath it. FileNotFoundError, PermissionError, or ValueError for a file
    that is no image, is damaged, or has other values.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder: give the path of an image file in it")
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: give the path of an image file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty: get the image anew")
    return _decode(path, str(path))


def read_mask(path: Path | str, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of a mask's file, True where it is brighter than half, for an image of that ``shape``.

    ValueError, which names the file, for one of another size or without any object, and as `read_image`.
    """
    mask = read_image(path).mean(-1) > WHITE / 2
    if mask.shape != tuple(shape):
        (height, width), (rows, columns) = shape, mask.shape
        raise ValueError(f"{path} must be a mask of its image's {width} x {height} px, got {columns} x {rows} px")
    if not mask.any():
        raise ValueError(f"{path} must be a mask that is brighter than half on the object, got one darker everywhere")
    return mask


def list_images(folder: Path | str) -> list[Path]:
    """The image files of a folder, by their names' endings, in the order of their names; ValueError where it has none.

    Hidden files and folders in it are left out.
    """
    paths = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in ENDINGS)
    found = [path for path in paths if path.is_file() and not path.name.startswith(".")]
    if not found:
        raise ValueError(f"{folder} holds no image: its files must end with one of {', '.join(ENDINGS)}")
    return found


def decode_image(data: bytes, name: str) -> np.ndarray:
    """As `read_image`, from the bytes of a file that was called ``name``."""
    return _decode(io.BytesIO(data), name)


def _decode(source: Path | io.BytesIO, name: str) -> np.ndarray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what matters of them is an error
            with Image.open(source) as image:
                return _convert(ImageOps.exif_transpose(image), name)
    except UnidentifiedImageError as error:
        kind = "a HEIC image, which cannot" if name.lower().endswith((".heic", ".heif")) else "no image that can"
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
    """(H, W, 3) uint8 of a Pillow image of any mode, palettes, CMYK and 1 bit included."""
    if image.mode.startswith("I;16"):
        return _to_channels(_to_bytes(np.asarray(image).astype(np.uint16), name))
    if image.mode in ("F", "I"):
        return _to_channels(_to_bytes(np.asarray(image), name))
    return np.array(image.convert("RGB"))


def to_rgb(image: Any, name: str = "image") -> np.ndarray:
    """A copy (H, W, 3) uint8 RGB of a grey, RGB or RGBA array, tensor or Pillow image; ValueError names the argument.

    (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) of uint8, uint16 (scaled), bool (black and white) or float in [0, 1].
    Transparency is left out: what counts are the colours beneath it.
    """
    if isinstance(image, Image.Image):
        return _convert(image, name)
    if isinstance(image, str | Path):
        raise ValueError(f"{name} must be an array, got the path {str(image)!r}: read it with mmgsd.read_image")
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
    """A copy of a mask (H, W) bool of an image of that ``shape``; ValueError for another, or where it is all False."""
    values = _to_array(mask, name)
    if values.dtype != bool:
        raise ValueError(f"{name} must be bool, True on the object, got {values.dtype}: compare it, as in mask > 127")
    if values.shape != tuple(shape):
        raise ValueError(f"{name} must have its image's shape {tuple(shape)}, got {values.shape}")
    if not values.any():
        raise ValueError(f"{name} must be True somewhere, got a mask without any object")
    return np.array(values)


def check_aspect(size: tuple[int, int], name: str) -> None:
    """ValueError for an image of ``size`` (width, height) that is too narrow a strip."""
    if max(size) > MAX_ASPECT * min(size):
        raise ValueError(f"{name} must be at most {MAX_ASPECT} times as long as wide, got {size[0]} x {size[1]} px: "
                         "crop it to the object")  # fmt: skip


def _to_array(values: Any, name: str) -> np.ndarray:
    """NumPy's view of an array, a list or a tensor, wherever it lies."""
    if hasattr(values, "detach"):  # a torch tensor; this module does without torch
        values = values.detach().cpu()
        values = values.float() if str(values.dtype) == "torch.bfloat16" else values
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
    if kind == np.uint16:
        return np.rint(values / DEEP).astype(np.uint8)
    if np.issubdtype(kind, np.floating):
        low, high = values.min(), values.max()  # NaN where one is
        if not 0 <= low <= high <= 1:
            raise _NamedError(f"{name} of dtype {kind} must lie in [0, 1], got {low} to {high}: divide it by its white")
        return np.rint(values * 255).astype(np.uint8)
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
