"""Videos are read frame by frame, whatever holds them, and written whole; what is none is said in one sentence."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from mmgsd.video import CODECS, open_video, sort_naturally, writing_video

SIZE = (48, 64)


def make_frames(count: int = 5) -> list[np.ndarray]:
    return [np.full((*SIZE, 3), (40 * k, 200 - 40 * k, 90), np.uint8) for k in range(count)]


@pytest.mark.parametrize("ending", CODECS)
def test_what_is_written_is_read_again(tmp_path: Path, ending: str) -> None:
    path = tmp_path / "new" / f"a{ending}"
    with writing_video(path, 12.5) as write:
        for frame in make_frames():
            write(frame)
        assert not path.exists()
    video = open_video(path)
    assert (video.count, video.rate) == (5, 12.5) and list(path.parent.iterdir()) == [path]
    for frame, expected in zip(video, make_frames(), strict=True):
        assert np.abs(frame.astype(int) - expected).mean() < 6
    assert len(list(video)) == 5  # once more from the first one on


@pytest.mark.skipif(os.name != "posix", reason="names of bytes are POSIX's")
def test_a_name_that_is_no_utf8_is_written_and_read(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9") / os.fsdecode(b"na\xefve.mp4")
    with writing_video(path, 10) as write:
        for frame in make_frames():
            write(frame)
    assert len(list(open_video(path))) == 5 and list(path.parent.iterdir()) == [path]


def test_a_video_that_lost_frames_takes_no_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class FullDisk:
        """Loses frames, as FFmpeg does without a word."""

        def __init__(self, writer: Callable = cv2.VideoWriter) -> None:  # a type that cannot be inherited from
            inner = writer()
            self.isOpened, self.open, self.release = inner.isOpened, inner.open, inner.release
            self.write = lambda frame: None

    path = tmp_path / "a.mp4"
    path.write_bytes(b"what was there")
    monkeypatch.setattr(cv2, "VideoWriter", FullDisk)
    with pytest.raises(OSError, match="a.mp4 holds 0 of 5 frames"), writing_video(path, 10) as write:
        for frame in make_frames():
            write(frame)
    assert path.read_bytes() == b"what was there" and list(tmp_path.iterdir()) == [path]


def test_videos_are_read_where_opencv_moved_its_log_level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with writing_video(tmp_path / "a.avi", 10) as write:
        write(make_frames()[0])
    moved = SimpleNamespace(setLogLevel=lambda level: level)
    monkeypatch.delattr(cv2, "setLogLevel", raising=False)  # 4.13 and later
    monkeypatch.setattr(cv2.utils, "logging", moved, raising=False)
    assert len(list(open_video(tmp_path / "a.avi"))) == 1


def test_frames_of_two_sizes_are_no_video(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="as large as the first one"), writing_video(tmp_path / "a.mp4", 10) as write:
        write(make_frames()[0])
        write(np.zeros((64, 80, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_what_fails_while_it_is_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), writing_video(tmp_path / "a.avi", 10) as write:
        write(make_frames()[0])
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match=r"one of '.mp4', '.webm', '.avi'"), writing_video(tmp_path / "a.mkv", 10):
        pass


@pytest.mark.parametrize("ending", ["gif", "webp", "png"])
def test_animations_are_videos(tmp_path: Path, ending: str) -> None:
    images = [Image.fromarray(frame) for frame in make_frames()]
    images[0].save(tmp_path / f"a.{ending}", save_all=True, append_images=images[1:], duration=100)
    video = open_video(tmp_path / f"a.{ending}")
    assert video.count == 5 and np.abs(list(video)[3].astype(int) - make_frames()[3]).mean() < 6


def test_a_folder_is_read_in_natural_order(tmp_path: Path) -> None:
    for number, frame in zip((10, 2, 1), make_frames(3), strict=True):
        Image.fromarray(frame).save(tmp_path / f"frame{number}.png")
    (tmp_path / "notes.txt").write_text("of the day")
    video = open_video(tmp_path)
    assert video.count == 3
    for frame, expected in zip(video, make_frames(3)[::-1], strict=True):
        np.testing.assert_array_equal(frame, expected)
    names = ["b1", "a10b2", "a10b1", "a9", "a09", "a"]
    assert [path.name for path in sort_naturally([Path(name) for name in names])] == [
        "a", "a09", "a9", "a10b1", "a10b2", "b1"]  # fmt: skip


def test_what_is_no_video_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        open_video(tmp_path / "none.mp4")
    with pytest.raises(ValueError, match="holds no image"):
        open_video(tmp_path)
    for name, data in (("a.mp4", b"no video" * 100), ("empty.avi", b""), ("cut.webm", b"\x1aE\xdf\xa3" * 9)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=rf"{name} is no"):
            open_video(tmp_path / name)
    Image.fromarray(make_frames()[0]).save(tmp_path / "one.png")
    with pytest.raises(ValueError, match="one.png is a single image"):
        open_video(tmp_path / "one.png")
