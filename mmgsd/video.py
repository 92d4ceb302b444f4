"""The one place that reads and writes videos: files of OpenCV's kinds, animations, folders of images as their frames.

OpenCV's wheels bring FFmpeg: mp4, avi and webm are tried, with MPEG-4, MJPG and VP8 or VP9; GIF and animated WebP
are Pillow's. FFmpeg in these wheels writes mp4 (MPEG-4), webm (VP8) and avi (Motion JPEG).
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mmgsd.checks import check_choice
from mmgsd.files import atomic_write, scratch_folder
from mmgsd.images import is_image, list_images, read_animation, read_image

CODECS = {".mp4": "mp4v", ".webm": "VP80", ".avi": "MJPG"}  # of what is written
RATE = 10.0  # frames a second, where nothing says it
REMEDY = "save it as mp4 (H.264), for example by ffmpeg -i VIDEO video.mp4, or give a folder of its frames"


@dataclass(frozen=True)
class Video:
    """Frames (H, W, 3) uint8 RGB, read when they are asked for, each time from the first one on."""

    path: Path
    count: int | None  # frames, None where the file does not say
    rate: float = RATE  # frames a second

    def __iter__(self) -> Iterator[np.ndarray]:
        if self.path.is_dir():
            return map(read_image, sort_naturally(list_images(self.path)))
        return read_animation(self.path) if is_image(self.path) else _read_video(self.path)


def open_video(path: Path | str) -> Video:
    """A video, an animated GIF or WebP, or a folder of images in natural order (2 before 10).

    FileNotFoundError where there is none; ValueError for a file that no decoder takes, a single image, and a folder
    without images.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: give the path of a video, or of a folder of images")
    if path.is_dir():
        return Video(path, len(list_images(path)))
    if is_image(path):
        return Video(path, sum(1 for _ in read_animation(path)))
    with _opening(path) as capture:
        if not capture.grab():
            raise ValueError(f"{path} is no video, damaged, or of an unknown codec: {REMEDY}")
        count, rate = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    return Video(path, int(count) if 0 < count < 1e9 else None, rate if 0 < rate < 1e4 else RATE)


def sort_naturally(paths: list[Path]) -> list[Path]:
    """Paths by the numbers in their names: frame2 before frame10."""
    return sorted(paths, key=lambda path: [(not p.isdecimal(), int(p) if p.isdecimal() else 0, p)
                                           for p in re.split(r"(\d+)", path.name)])  # fmt: skip


def _read_video(path: Path) -> Iterator[np.ndarray]:
    with _opening(path) as capture:
        while (read := capture.read())[0]:
            yield cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB)


@contextmanager
def _opening(path: Path) -> Iterator[cv2.VideoCapture]:
    """What FFmpeg makes of a file; its own words are kept back, a sentence of ours says what is wrong."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # before OpenCV 4.13, and from it on
    level = logging.setLogLevel(0)
    with _spelling(path) as plain:
        capture = cv2.VideoCapture(str(plain), cv2.CAP_FFMPEG)
        logging.setLogLevel(level)
        yield capture
        capture.release()


@contextmanager
def _spelling(path: Path) -> Iterator[Path]:
    """A path that OpenCV can be given: a link to one whose name is no UTF-8, which would end the process."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as place:
            link = Path(place, "video" + path.suffix.encode("ascii", "ignore").decode().rstrip("."))
            link.symlink_to(path.absolute())
            yield link
    else:
        yield path


@contextmanager
def writing_video(path: Path, rate: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Give what takes frames (H, W, 3) uint8 RGB of one size, ``rate`` a second; the file appears whole or not at all.

    ValueError where its name does not end as `CODECS` do, and for a frame of another size, RuntimeError where this
    OpenCV cannot write such a file, OSError where it lacks frames, as on a full disk, which FFmpeg tells nobody.
    """
    check_choice("ending of a video that is written", path.suffix.lower(), tuple(CODECS))
    path.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(path.parent, path.name) as scratch, _spelling(scratch) as folder:
        inside, writer, count = folder / f"video{path.suffix.lower()}", cv2.VideoWriter(), 0
        kind, size = cv2.VideoWriter_fourcc(*CODECS[inside.suffix]), ()

        def write(frame: np.ndarray) -> None:
            """Add a frame; the first one opens the file."""
            nonlocal count, size
            size = size or frame.shape
            if frame.shape != size:
                raise ValueError(f"frames must be as large as the first one, {size}, got {frame.shape}")
            if not (writer.isOpened() or writer.open(str(inside), cv2.CAP_FFMPEG, kind, rate, frame.shape[1::-1])):
                raise RuntimeError(f"this OpenCV cannot write {path.suffix} videos: choose another of {[*CODECS]}")
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1

        try:
            yield write
        finally:
            writer.release()
        if inside.exists():
            with _opening(inside) as capture:
                written = sum(1 for _ in iter(capture.grab, False))
            if written < count:
                raise OSError(f"{path} holds {written} of {count} frames that were written: is there room on its disk?")
            with atomic_write(path) as aside:
                os.replace(inside, aside)
