"""Images of any depth and mode are read alike or refused by name, damaged files never without it."""

from __future__ import annotations

import os
import threading
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from mmgsd.images import NO_PICTURES, check_mask, check_pixels, list_images, read_image, to_rgb

FORMATS = ("png", "jpg", "webp", "tif", "gif", "bmp")


@pytest.fixture
def deep(rng: np.random.Generator) -> np.ndarray:
    """(H, W) uint16 with black and white in it."""
    deep = rng.integers(0, 65536, (40, 60), dtype=np.uint16)
    deep[0, 0], deep[0, 1] = 0, 65535
    return deep


def write_image(path: Path, rng: np.random.Generator) -> Path:
    """A picture with detail, so that no part of its file is without meaning."""
    pixels = cv2.resize(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), (160, 120), interpolation=cv2.INTER_CUBIC)
    Image.fromarray(pixels).save(path)
    return path


TURNS = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (1, False), 7: (3, True),
         8: (3, False)}  # fmt: skip  # what a camera notes: quarter turns to the left and a flip that were stored


def write_photograph(path: Path, orientation: int, values: type = np.uint8) -> np.ndarray:
    """A file that is stored turned, with the note of how; the picture (H, W, 3) uint8 that it shows."""
    shown = np.zeros((4, 6, 3), np.uint8)
    shown[0], shown[:, 0] = 255, 100
    turns, flipped = TURNS[orientation]
    stored = np.rot90(shown[:, ::-1] if flipped else shown, turns)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(path, exif=exif)
    return shown


@pytest.mark.parametrize("orientation", TURNS)
def test_a_photograph_is_upright_however_it_is_read(tmp_path: Path, orientation: int) -> None:
    path = tmp_path / "photo.png"
    shown = write_photograph(path, orientation)
    with Image.open(path) as loaded, Image.open(path) as lazy:
        loaded.load()
        for image in (read_image(path), to_rgb(path), to_rgb(str(path)), to_rgb(lazy), to_rgb(loaded)):
            np.testing.assert_array_equal(image, shown)
        np.testing.assert_array_equal(check_mask(loaded.convert("1", dither=0), (4, 6), "mask0"), shown[..., 0] > 127)
        np.testing.assert_array_equal(check_mask(path, (4, 6), "mask0"), shown[..., 0] > 127)


def test_a_damaged_picture_names_the_argument(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write_image(tmp_path / "towel.png", rng)
    path.write_bytes(path.read_bytes()[:500])
    with Image.open(path) as image, pytest.raises(ValueError, match="^image7 "):
        to_rgb(image, "image7")


@pytest.mark.parametrize("kind", FORMATS)
def test_a_pipe_is_read(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    path, pipe = write_image(tmp_path / f"towel.{kind}", rng), tmp_path / "pipe"
    os.mkfifo(pipe)
    for content in (path.read_bytes(), b""):
        threading.Thread(target=pipe.write_bytes, args=(content,), daemon=True).start()
        if content:
            np.testing.assert_array_equal(read_image(pipe), read_image(path))
    with pytest.raises(ValueError, match="pipe is empty"):
        read_image(pipe)


def test_of_a_folder_is_taken_what_can_be_read(tmp_path: Path) -> None:
    readable = set()
    for ending, kind in Image.registered_extensions().items():
        for mode in ("RGB", "L", "1", "P", "I;16", "F"):
            path = tmp_path / f"towel{ending.upper() if len(ending) % 2 else ending}"
            try:
                Image.new(mode, (32, 32)).save(path, kind)
                read_image(path)
            except (ValueError, OSError, KeyError):
                path.unlink(missing_ok=True)
                continue
            readable |= set() if kind in NO_PICTURES else {path}
            break
    for other in ("notes.txt", ".hidden.png", "towel.h5", "towel.heic"):
        (tmp_path / other).touch()
    (tmp_path / "folder.png").mkdir()
    assert {".jpg", ".jfif", ".ppm", ".avif", ".jp2", ".webp"} <= {path.suffix.lower() for path in readable}
    assert {path.name for path in list_images(tmp_path)} == {path.name for path in readable} | {"towel.heic"}


@pytest.mark.parametrize(
    ("kind", "channels"), [*product(("png", "tif"), (1, 3, 4)), ("pgm", 1), ("ppm", 3)]
)  # fmt: skip
def test_16_bits_are_scaled_and_rounded(tmp_path: Path, deep: np.ndarray, kind: str, channels: int) -> None:
    path = tmp_path / f"deep.{kind}"
    cv2.imwrite(str(path), deep if channels == 1 else np.dstack([deep] * channels))
    image = read_image(path)
    assert (image.shape, image.dtype) == ((40, 60, 3), np.uint8)
    with Image.open(path) as opened:
        for read in (image, to_rgb(opened)):
            np.testing.assert_array_equal(read, np.dstack([np.rint(deep / 257)] * 3))


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA", "CMYK", "YCbCr", "I;16", "F"])
def test_every_mode_shows_the_same_picture(tmp_path: Path, mode: str) -> None:
    shown = np.zeros((8, 8), np.uint8)
    shown[:4] = 255
    picture = Image.fromarray(shown)
    if mode in ("I;16", "F"):
        picture = Image.fromarray(shown.astype(np.uint16) * 257 if mode == "I;16" else np.float32(shown / 255))
    else:
        picture = picture.convert("RGB").convert(mode)
    picture.save(tmp_path / "picture.tif")
    for image in (read_image(tmp_path / "picture.tif"), to_rgb(picture)):
        np.testing.assert_allclose(image, np.dstack([shown] * 3), atol=1)


def test_palettes_with_transparency_are_read(tmp_path: Path) -> None:
    picture = Image.fromarray(np.full((8, 8, 3), (250, 10, 20), np.uint8)).convert("P")
    picture.save(tmp_path / "p.png", transparency=0)
    np.testing.assert_allclose(read_image(tmp_path / "p.png")[0, 0], (250, 10, 20), atol=30)


@pytest.mark.parametrize("kind", ["gif", "webp", "tif"])
def test_of_several_pictures_the_first_is_read(tmp_path: Path, kind: str) -> None:
    frames = [Image.new("RGB", (8, 8), colour) for colour in ("white", "black")]
    frames[0].save(tmp_path / f"moving.{kind}", save_all=True, append_images=frames[1:])
    assert read_image(tmp_path / f"moving.{kind}").min() > 250


@pytest.mark.parametrize(("values", "message"), [
    (np.float32([[0, 255.0]]), r"float32 must lie in \[0, 1\], got 0.0 to 255.0"),
    (np.float32([[np.nan, 0.5]]), r"float32 must lie in \[0, 1\], got nan to nan"),
    (np.int32([[0, 70000]]), "must be uint8 or float, got int32 from 0 to 70000"),
])  # fmt: skip
def test_values_without_a_white_are_refused(tmp_path: Path, values: np.ndarray, message: str) -> None:
    Image.fromarray(values).save(tmp_path / "values.tif")
    with pytest.raises(ValueError, match=f"values.tif .*{message}"):
        read_image(tmp_path / "values.tif")


@pytest.mark.parametrize("harm", ["truncated", "cut to its head", "empty", "text"])
@pytest.mark.parametrize("kind", FORMATS)
def test_a_damaged_file_is_named(tmp_path: Path, rng: np.random.Generator, kind: str, harm: str) -> None:
    path = write_image(tmp_path / f"damaged.{kind}", rng)
    content = path.read_bytes()
    path.write_bytes({"truncated": content[: len(content) // 2], "cut to its head": content[:20], "empty": b"",
                      "text": b"no image at all\n"}[harm])  # fmt: skip
    with pytest.raises(ValueError, match=rf"damaged\.{kind} "):
        read_image(path)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_flipped_bit_is_named_or_gives_an_image(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    path = write_image(tmp_path / f"flipped.{kind}", rng)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    for place in [*range(0, 64), *rng.integers(64, len(content), 60)]:
        damaged = content.copy()
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged.tobytes())
        try:
            assert read_image(path).ndim == 3
        except ValueError as error:
            assert f"flipped.{kind} " in str(error)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_wrong_ending_does_not_matter(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    path = write_image(tmp_path / f"right.{kind}", rng)
    expected = read_image(path)
    np.testing.assert_array_equal(read_image(path.rename(tmp_path / "wrong.xyz")), expected)


def test_what_is_no_file_is_named(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere.png"
    for read in (read_image, to_rgb, lambda path: to_rgb(str(path)), lambda path: check_mask(path, (4, 4), "mask0")):
        with pytest.raises(FileNotFoundError, match="nowhere.png does not exist"):
            read(nowhere)
    with pytest.raises(ValueError, match=f"{tmp_path.name} is a folder"):
        read_image(tmp_path)


def test_too_many_pixels_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("L", (100, 100)).save(tmp_path / "bomb.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    with pytest.raises(ValueError, match="bomb.png has too many pixels .*: make it smaller"):
        read_image(tmp_path / "bomb.png")


@pytest.mark.parametrize(
    "convert",
    [
        lambda image: image[..., None], lambda image: np.dstack([image] * 3), lambda image: np.dstack([image] * 4),
        lambda image: image.astype(np.uint16) * 257, lambda image: image / 255, lambda image: np.float16(image / 255),
        lambda image: torch.from_numpy(image), lambda image: torch.from_numpy(image / 255).requires_grad_(),
        lambda image: torch.from_numpy(image / 255).bfloat16(), lambda image: image.tolist() and Image.fromarray(image),
        lambda image: image > 100, lambda image: (image * np.uint16(257)).astype(">u2"),
        lambda image: (image / 255).astype(">f4"), lambda image: np.float32(image / 255) * np.float32(1 + 2e-7),
        lambda image: image / 255 * 1.02 - 0.01,
    ],
)  # fmt: skip
def test_arrays_of_every_kind_show_the_same(convert: object) -> None:
    image = np.array([[0, 255, 0], [255, 0, 255]], np.uint8)
    np.testing.assert_array_equal(to_rgb(convert(image)), np.dstack([image] * 3))


@pytest.mark.parametrize(("bad", "message"), [
    (np.zeros((3, 40, 60), np.uint8), r"shape \(3, 40, 60\): channels go last"), (None, r"got shape \(\)"),
    (torch.zeros(1, 40, 60), r"shape \(1, 40, 60\): channels go last"), (np.zeros((4, 4, 2)), r"shape \(4, 4, 2\)"),
    (np.zeros((2, 40, 60, 3), np.uint8), "give one image of the batch"), (np.zeros((4, 4), object), "got object"),
    (np.zeros((4, 4), complex), "got complex128"), (np.full((4, 4), -1), "got int64 from -1 to -1"),
    (np.full((4, 4), -0.5), r"in \[0, 1\], got -0.5 to -0.5"), (np.array([[0, 1]], ">i4"), "got >i4 from 0 to 1"),
    (np.array([[0, 1.03]]), r"in \[0, 1\], got 0.0 to 1.03: clip it"), ([[1, 2], [3]], "array of numbers, got list"),
    (np.array([[-1, 1.0]]), r"in \[0, 1\], got -1.0 to 1.0: divide it"),
])  # fmt: skip
def test_arrays_that_are_no_image_are_refused(bad: object, message: str) -> None:
    with pytest.raises(ValueError, match=f"^image7 .*{message}"):
        to_rgb(bad, "image7")


@pytest.mark.parametrize("xy", [(3, 4), [3, 4], [(3, 4)], np.array([[3, 4]]), torch.tensor([3.0, 4.0])])
def test_pixels_of_every_kind(xy: object) -> None:
    np.testing.assert_array_equal(check_pixels(xy, (10, 10)), np.float32([[3, 4]]))


@pytest.mark.parametrize("bad", [None, "3,4", [("a", "b")], [(1, 2), (3,)], [1, 2, 3], 1j, [(1e300, 1)], {}])
def test_what_is_no_pixel(bad: object) -> None:
    with pytest.raises(ValueError, match="^xy must be"):
        check_pixels(bad, (10, 10))
