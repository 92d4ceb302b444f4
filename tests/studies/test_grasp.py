"""A single grasp: which mode it is at, how far from a corner, and what it lifts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_folding import FLAT, lay

from mmgsd.fold.state import read_state, write_state
from mmgsd.fold.tasks import GROUNDS, STARTS
from mmgsd.match.match import Match
from mmgsd.paths import Paths
from mmgsd.studies import bench, grasp
from mmgsd.studies.grasp import choose_picks, find_middle, judge_grasp, list_grasps, summarise_grasps

ABOUT = {"object": "cloth", "task": "grasp", "start": "flat", "ground": "plain", "seed": 0, "fault": "", "look": 0,
         "mark": "", "thickness": 0.0}  # fmt: skip


def answer(modes: list[list[float]], spreads: list[float]) -> Match:
    image, n = np.zeros((100, 100, 3), np.uint8), len(modes)
    covariances = np.eye(2) * np.array(spreads)[:, None, None] ** 2
    return Match(image, image, np.zeros((1, 2), np.float32), np.array([modes]), np.full((1, n), 1 / n),
                 covariances[None], np.zeros(1), np.zeros(1), np.full((1, 4, 4), 1 / 16))  # fmt: skip


CORNER = int(grasp.CORNERS[1])  # one point inside the rim
FLAT_CLOTH = lay("cloth", ABOUT)
FOLDED = FLAT["cloth"].copy()
FOLDED[CORNER, :2] = (0.02, -0.01)  # the second corner, laid beside the middle


def test_the_surest_is_the_narrowest_and_the_first_the_most_probable() -> None:
    modes = [[10.0, 20.0], [30.0, 40.0], [np.nan, np.nan]]
    picks = choose_picks(answer(modes, [5.0, 2.0, np.nan]), seed=3)
    assert picks["surest"] == [30, 40] and picks["probable"] == [10, 20] and picks["any"] in modes[:2]
    match = answer(modes, [5.0, 2.0, np.nan])
    assert {tuple(choose_picks(match, seed=k)["any"]) for k in range(9)} == {(10, 20), (30, 40)}


@pytest.mark.parametrize(
    ("pick", "after", "fault", "distance", "lifted"),
    [
        (FLAT_CLOTH.xy[CORNER], FOLDED, "", 0.0, True),
        (FLAT_CLOTH.xy[CORNER - 2], FOLDED, "", 2 / 24, True),  # off by two points
        (FLAT_CLOTH.xy[CORNER], FLAT["cloth"], "", 0.0, False),  # it slipped
        (FLAT_CLOTH.xy[CORNER], FOLDED, "nowhere", 0.0, False),
        (None, FLAT["cloth"], "", 1.0, False),  # no answer
    ],
)
def test_a_corner_is_lifted_that_lies_in_the_middle(
    pick: np.ndarray | None, after: np.ndarray, fault: str, distance: float, lifted: bool
) -> None:
    state = lay("cloth", ABOUT | {"fault": fault}, points=after)
    found = judge_grasp(FLAT_CLOTH, None if pick is None else pick.tolist(), state)
    assert found == {"distance": pytest.approx(distance, abs=1e-4), "lifted": lifted}


def test_a_corner_that_lay_there_before_was_not_lifted() -> None:
    folded = lay("cloth", ABOUT, points=FOLDED)
    assert not judge_grasp(folded, folded.xy[CORNER].tolist(), folded)["lifted"]


def test_grasps_are_compared_by_rollout() -> None:
    ours, others = ({"a": {"distance": d, "lifted": True}, "b": {"distance": 0.1, "lifted": False}} for d in (0.0, 0.2))
    said = summarise_grasps(ours, others)
    assert said["beyond"]["mean"] == pytest.approx(-0.1) and said["lifted"]["mean"] == 0.5
    assert said["distance"]["mean"] == pytest.approx(0.05)


def test_starts_and_grounds_are_taken_in_turn() -> None:
    found = list_grasps(12)
    assert len({r.name for r in found}) == 12 and {r.ground for r in found} == set(GROUNDS)
    assert {r.start for r in found} == set(STARTS["cloth"])


def test_a_run_lifts_what_is_grasped_at_a_corner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(jobs: dict[str, dict], folder: Path, **_: object) -> dict[str, Path]:
        """Physics: a pick within 3 px of the second corner brings it to its place, any other does nothing."""
        for name, job in jobs.items():
            points, before = FLAT["cloth"], read_state(job["state"]) if job["kind"] == "act" else None
            if before and any(np.linalg.norm(np.array(pick) - before.xy[CORNER]) < 3 for pick, _ in job["moves"]):
                points = FOLDED
            about = ABOUT | {key: job[key] for key in ("start", "ground", "seed", "mark") if key in job}
            folder.mkdir(parents=True, exist_ok=True)
            write_state(folder / f"{name}.npz", lay("cloth", about, points=points))
        return {name: folder / f"{name}.npz" for name in jobs}

    class Sure:
        def match(self, *_: object) -> Match:
            return answer([[50.0, 50.0], FLAT_CLOTH.xy[CORNER].tolist()], [9.0, 2.0])

    for module in (grasp, bench):
        monkeypatch.setattr(module, "run_jobs", run)
    monkeypatch.setattr(grasp, "load", lambda _: Sure())
    results = json.loads(grasp.run(Paths(tmp_path, "smoke"), progress=False).read_text())
    assert list(results) == list(grasp.MATCHERS)
    ways = results["mmgsd"]
    assert ways["surest"]["lifted"]["mean"] == 1 and ways["probable"]["lifted"]["mean"] == 0
    assert [ways[way]["distance"]["mean"] < 0.001 for way in ("surest", "probable")] == [True, False]
    assert find_middle(FLAT_CLOTH) == [49.5, 49.5]
