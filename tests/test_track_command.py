"""``python -m mmgsd track``: files of a track appear whole, what is interrupted is kept, and what is wrong is said."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mmgsd
from mmgsd.__main__ import main
from mmgsd.match.recording import draw_points
from mmgsd.match.track import Tracked
from mmgsd.video import open_video


class Following:
    """Follows two points: the second is hidden, then the object is away, in the last frame."""

    error: BaseException | None = None
    fails_at = 2
    absent = (0.0, 0.0, 0.9)

    def follow(self, frames: object, xy: object = None, *, find: object = None, mask0: object = None) -> Iterator:
        for number, frame in enumerate(frames):
            if number == self.fails_at and self.error:
                raise self.error
            away = self.absent[number] > 0.5
            places = np.full((2, 2), np.nan) if away else np.array([[10.0, 20], [40, 30.25]]) + number
            yield Tracked(places, np.array([0.9, 0.1]) * (not away), np.full(2, 0.75) * (not away), self.absent[number])
            assert frame.shape == (48, 64, 3)


@pytest.fixture
def following(monkeypatch: pytest.MonkeyPatch) -> type[Following]:
    class Ours(Following):
        pass

    monkeypatch.setattr(mmgsd, "load", lambda _: Ours())
    return Ours


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in range(3):
        Image.fromarray(np.full((48, 64, 3), 90, np.uint8)).save(folder / f"{number}.png")
    return folder


def track(place: Path, out: Path, *more: str) -> None:
    main(["track", str(place), "--xy", "10,20", "--xy", "40,30", "--weights", "cloth", "--out", str(out), *more])


def test_a_folder_takes_table_json_and_video(following, frames: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    track(frames, out)
    assert "3 frames, the object is not seen in 1 of them" in capsys.readouterr().out
    with open(out / "track.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 and rows[3] == {"frame": "1", "time_s": "0.1", "point": "1", "x": "41.0", "y": "31.2",
                                          "visible": "0.1", "confidence": "0.75", "absent": "0.0"}  # fmt: skip
    assert (rows[5]["x"], rows[5]["absent"]) == ("", "0.9")
    values = json.loads((out / "track.json").read_text())
    assert values["frames_per_second"] == 10 and [frame["frame"] for frame in values["frames"]] == [0, 1, 2]
    assert values["frames"][0]["points"][0] == {"xy": [10.0, 20.0], "visible": 0.9, "confidence": 0.75}
    assert values["frames"][2]["points"][0]["xy"] is None
    assert open_video(out / "track.mp4").count == 3 and len(list(out.iterdir())) == 3


def test_a_file_alone_is_of_its_ending(following, frames: Path, tmp_path: Path) -> None:
    track(frames, tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text())["frames"] and not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize(("error", "code", "said"), [
    (KeyboardInterrupt(), 130, "a.json hold the first 2 frames"),
    (ValueError("frames must be as large as the first one"), 2, "error: frames must be as large"),
])  # fmt: skip
def test_what_is_interrupted_is_kept(following, frames: Path, tmp_path: Path, capsys, error, code, said) -> None:
    following.error = error
    with pytest.raises(SystemExit) as stopped:
        track(frames, tmp_path / "a.json")
    assert stopped.value.code == code and said in capsys.readouterr().err
    assert len(json.loads((tmp_path / "a.json").read_text())["frames"]) == 2


def test_a_video_without_the_object_is_said(following, frames: Path, tmp_path: Path, capsys) -> None:
    following.absent = (0.9, 0.9, 0.9)
    with pytest.raises(SystemExit) as stopped:
        track(frames, tmp_path / "a.csv")
    assert stopped.value.code == 1 and "none of the frames shows the object" in capsys.readouterr().err


@pytest.mark.parametrize(("out", "said"), [
    ("a.xyz", "--out's ending must be one of '.csv', '.json'"),
    ("frames/v.gif", "--out's ending must be one of"),
])  # fmt: skip
def test_another_ending_is_refused(following, frames: Path, tmp_path: Path, capsys, out: str, said: str) -> None:
    with pytest.raises(SystemExit) as stopped:
        track(frames, tmp_path / out)
    assert stopped.value.code == 2 and said in capsys.readouterr().err


def test_the_video_itself_is_not_written_over(following, frames: Path, tmp_path: Path, capsys) -> None:
    track(frames, tmp_path / "a.avi")
    before = (tmp_path / "a.avi").read_bytes()
    with pytest.raises(SystemExit):
        track(tmp_path / "a.avi", tmp_path / "a.avi")
    assert "--out must not be the video itself" in capsys.readouterr().err
    assert (tmp_path / "a.avi").read_bytes() == before


def test_seen_points_are_filled_and_hidden_ones_rings() -> None:
    image = np.zeros((200, 200, 3), np.uint8)
    points = Tracked(np.array([[50.0, 50], [150, 150], [np.nan, np.nan]]), np.array([0.9, 0.1, 0]), np.ones(3), 0.0)
    drawn = draw_points(image, points)
    assert drawn[50, 50].any() and not drawn[150, 150].any() and drawn[140:160, 140:160].any() and not image.any()


def test_a_folder_that_was_made_for_nothing_goes_again(following, frames: Path, tmp_path: Path) -> None:
    following.error = RuntimeError("nothing is followed")
    following.fails_at = 0
    with pytest.raises(SystemExit):
        track(frames, tmp_path / "out")
    assert not (tmp_path / "out").exists()
