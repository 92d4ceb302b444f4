"""Films with truth, and who follows points through them best: one short film goes all the way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from videos import turn_sample

from mmgsd.files import read_json
from mmgsd.fold.state import read_state
from mmgsd.fold.tasks import MOTIONS
from mmgsd.measure.tracking import Truth, measure_track
from mmgsd.paths import Paths
from mmgsd.studies import tracking
from mmgsd.studies.table import to_markdown
from mmgsd.studies.tracking import METHODS, POINTS, Method, describe_tracking, list_films, summarise
from mmgsd.symmetry import load_group


def test_films_take_motions_in_turn_and_have_names_of_their_own() -> None:
    films = list_films("cloth", 30)
    assert len(films) == 30 and {name.partition("-")[0] for name in films} == set(MOTIONS)
    assert len(set(films.values())) == 30 and len({film.task for film in films.values()}) > 3


def test_means_are_of_all_and_of_each_motion() -> None:
    rows = {"fold-cloth-0": {"delta": 0.5}, "turn-cloth-1": {"delta": 0.7}, "fold-cloth-4": {"delta": 0.9}}
    found = summarise(rows)
    assert found["all"] == {"delta": 0.7, "films": 3} and found["fold"] == {"delta": 0.7, "films": 2}
    assert set(found) == {"all", "fold", "turn"}


@pytest.mark.parametrize("name", ["lucas_kanade", "dis"])
def test_flow_follows_what_moves_little_and_says_what_it_loses(name: str) -> None:
    video = turn_sample("cloth", 5, count=4, degrees=6)
    points = np.array(POINTS["cloth"])
    truth = Truth(video.xy[:, points], video.visible[:, points], np.zeros((4, 0, len(points), 2)), (485, 485))
    xy, seen = METHODS[name].follow("cloth", video.frames, video.xy[0, points])
    assert measure_track(xy, seen, truth)["delta@4px"] > 0.7
    black = np.concatenate([video.frames[:1], 0 * video.frames[:1]])
    assert METHODS[name].follow("cloth", black, video.xy[0, points])[1][1].mean() < 0.5


def test_a_film_goes_all_the_way_and_what_is_finished_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("bpy")
    monkeypatch.setattr(tracking, "OBJECTS", ("cloth",))
    monkeypatch.setattr(tracking, "MOTIONS", ("gripper",))
    monkeypatch.setattr(tracking, "METHODS", {name: METHODS[name] for name in ("lucas_kanade", "dis")})
    how = {"count": 1, "frames": 3, "scale": 0.25, "workers": 1, "progress": False}
    paths = Paths(tmp_path, "smoke")
    out = tracking.run(paths, **how)
    results = read_json(out)
    assert set(results["methods"]["cloth"]) == {"lucas_kanade", "dis"}
    assert results["methods"]["cloth"]["dis"]["gripper"]["films"] == 1
    row = to_markdown(describe_tracking(results)).splitlines()[3]
    assert row.startswith("| DIS flow, chained | ") and row.count(" % |") == 5
    (file,) = tmp_path.glob("data/generated/smoke/folding/films/*.npz")
    film = read_state(file)
    assert film.image.shape == (3, 121, 121, 3) and film.xy.shape == (3, 625, 2)
    moved = np.linalg.norm(film.points[-1] - film.points[0], axis=1)
    assert moved.max() > 0.3 and np.median(moved) < 0.6  # what is gripped is carried, the rest stays
    assert (film.visible[1] < film.visible[0]).any()  # folded under, or behind the grippers
    corners = film.xy[:, load_group("cloth", "c4").orbit(0)]
    assert np.isfinite(corners).all()
    before = file.stat().st_mtime_ns
    deaf = Method("deaf", "black", lambda *_: pytest.fail("asked again"), learnt=False)
    monkeypatch.setattr(tracking, "METHODS", dict.fromkeys(("lucas_kanade", "dis"), deaf))
    assert read_json(tracking.run(paths, **how)) == results
    assert file.stat().st_mtime_ns == before
