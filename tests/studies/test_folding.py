"""The bench goes in step and goes on: states that are made, and answers that are given, are kept."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from mmgsd.files import write_json
from mmgsd.fold.demonstration import Look, read_demonstration
from mmgsd.fold.moves import PolicyAnswer
from mmgsd.fold.state import State, read_state, write_state
from mmgsd.fold.tasks import GROUNDS, TASKS
from mmgsd.paths import Paths
from mmgsd.studies import bench as benches
from mmgsd.studies import folding, policies
from mmgsd.studies.bench import (
    Bench,
    choose_shown,
    find_on_table,
    list_limited,
    list_rollouts,
    measure_success,
    summarise_rollouts,
)
from mmgsd.studies.folding import run
from mmgsd.studies.policies import POLICIES, SHIPPED, digest_policy, find_answering
from mmgsd.studies.registry import load_results

ASKED = [POLICIES["truth"], POLICIES["random"]]
ROW, COLUMN = np.divmod(np.arange(625), 25)
FLAT = {"cloth": np.stack([COLUMN / 24 - 0.5, 0.5 - ROW / 24, np.zeros(625)], 1),
        "rope": np.stack([np.linspace(-0.8, 0.8, 625), np.zeros(625), np.zeros(625)], 1)}  # fmt: skip
POSE = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2.5], [0, 0, 0, 1]])  # above the table, looking down
MATRIX = np.array([[60.0, 0, 49.5], [0, 60, 49.5], [0, 0, 1]])


def lay(object: str, about: dict, *, points: np.ndarray | None = None) -> State:
    """A state on the table, of which the middle is seen; the object lies flat unless ``points`` say otherwise."""
    points = (FLAT[object] if points is None else points).astype(np.float32)
    mask = np.zeros((100, 100), bool)
    mask[38:62, 38:62] = True
    state = State(points, points, np.zeros((100, 100, 3), np.uint8), mask, np.zeros((625, 2), np.float32),
                  np.ones(625, bool), MATRIX, POSE, points, about)  # fmt: skip
    return dataclasses.replace(state, xy=state.project(points).astype(np.float32))


@pytest.fixture
def physics(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """States without Blender: nothing moves, and an act shifts by a metre what it does not grasp truly."""
    made: list[str] = []

    def run(jobs: dict[str, dict], folder: Path, **_: object) -> dict[str, Path]:
        files = {}
        for name, job in jobs.items():
            files[name] = folder / f"{name}.npz"
            if files[name].is_file():
                continue
            made.append(name)
            folder.mkdir(parents=True, exist_ok=True)
            if job["kind"] in ("act", "look"):
                before = read_state(job["state"]).about
                about = {**before, "look": before["look"] + 1, "mark": job["mark"], "again": job.get("again", 0)}
            else:
                about = {key: job[key] for key in ("object", "task", "start", "ground", "seed")}
                about |= {"fault": "", "look": 0, "mark": job["mark"], "thickness": 0.0}
            write_state(files[name], lay(about["object"], about))
        return files

    monkeypatch.setattr(benches, "run_jobs", run)
    return made


def test_rollouts_go_through_tasks_starts_and_grounds_in_turn() -> None:
    found = list_rollouts("cloth", 40)
    assert len({rollout.name for rollout in found}) == 56 and len(list_rollouts("rope", 40)) == 40
    assert {rollout.start for rollout in found[40:]} == {"wrinkled"} and len({r.task for r in found[40:]}) == 4
    assert {rollout.task for rollout in found} == {name for name, task in TASKS.items() if task.object == "cloth"}
    assert {rollout.ground for rollout in found} == set(GROUNDS)
    assert all(rollout.start in TASKS[rollout.task].starts for rollout in found)
    assert list_rollouts("cloth", 10)[:10] == found[:10]


def test_a_run_makes_every_state_once_and_a_second_none(tmp_path: Path, physics: list[str]) -> None:
    out = run(Paths(tmp_path, "smoke"), policies=ASKED, progress=False)
    results = json.loads(out.read_text())
    assert results["run"]["rollouts"] == 2
    assert list(results["policies"]["cloth"]) == ["truth", "random", "nothing"]
    assert results["policies"]["cloth"]["truth"]["all"]["error"]["count"] == 2
    assert len(physics) == len(set(physics)) and any(name.startswith("random-edge") for name in physics)
    count = len(physics)
    again = json.loads(run(Paths(tmp_path, "smoke"), policies=ASKED, progress=False).read_text())
    assert len(physics) == count and again["policies"] == results["policies"]


def test_rollouts_within_a_limit_are_on_plain_ground_and_count_where_the_truth_succeeds(
    tmp_path: Path, physics: list[str]
) -> None:
    rollouts = list_limited("cloth", 5, 15)
    assert {(rollout.ground, rollout.turn_deg) for rollout in rollouts} == {("plain", 15)}
    assert len({rollout.name for rollout in rollouts}) == 5 and all("within-15" in rollout.name for rollout in rollouts)
    found = measure_success(Bench(tmp_path, {"progress": False}), [POLICIES["random"]], rollouts[:2])
    assert list(found) == ["truth", "random"]
    assert found["random"]["count"] == 0  # untouched, each is a success already


def test_an_interrupted_run_goes_on_from_its_files(tmp_path: Path, physics: list[str]) -> None:
    run(Paths(tmp_path, "smoke"), policies=ASKED, progress=False)
    answers = sorted((tmp_path / "data/generated/smoke/folding/answers").iterdir())
    kept = {path: path.read_bytes() for path in answers}
    answers[0].unlink()
    answers[1].write_text("{")
    with pytest.warns(UserWarning, match="damaged"):
        run(Paths(tmp_path, "smoke"), policies=ASKED, progress=False)
    assert all(path.read_bytes() == content for path, content in kept.items())


def test_a_rollout_that_is_a_success_untouched_does_not_count(tmp_path: Path, physics: list[str]) -> None:
    results = json.loads(run(Paths(tmp_path, "smoke"), policies=ASKED, progress=False).read_text())
    rows = results["policies"]["cloth"]  # nothing moves, and the demonstration's end is its start
    assert rows["nothing"]["all"]["success"]["mean"] == 1
    assert rows["truth"]["all"]["success"]["mean"] == 1 and "reachable" not in rows["truth"]


def test_the_report_reads_what_a_run_wrote(tmp_path: Path) -> None:
    said = {"mean": 0.5, "low": 0.1, "high": 0.9, "count": 4}
    row = {"reachable": {"success": said}, "beyond": {"error": said}, "all": {}, "rollouts": {"a": [0.1, True]}}
    write_json(tmp_path / "folding.json", {"run": {}, "policies": {"cloth": {"mmgsd": row, "sift": {}}, "rope": {}}})
    found = load_results(tmp_path)["folding"]
    assert found == {"cloth": {"mmgsd": {"success": said, "beyond": {"error": said}}}, "rope": {}}


def test_slides_show_each_look_and_the_end(tmp_path: Path, physics: list[str]) -> None:
    bench = Bench(tmp_path, {"progress": False})
    kept = [rollout for rollout in list_rollouts("cloth", 8) if rollout.task in ("edge", "twice")]
    bench.roll(ASKED[:1], kept, bench.make_starts(kept))
    shown = choose_shown(kept, {})
    assert len(bench.list_slides(ASKED[0], shown)) == 2 + 3


def test_the_rollout_with_the_median_error_is_drawn() -> None:
    kept = [rollout for rollout in list_rollouts("cloth", 27) if rollout.task in ("edge", "unfold")]
    ended = {rollout.name: {"error": abs(k - 2.0)} for k, rollout in enumerate(kept)}
    shown = choose_shown(kept, ended)
    assert list(shown) == ["edge", "unfold"]
    for task, rollout in shown.items():
        errors = sorted(ended[r.name]["error"] for r in kept if r.task == task)
        assert ended[rollout.name]["error"] == errors[len(errors) // 2]


def test_demonstrations_are_written_as_a_users_are_read(tmp_path: Path, physics: list[str]) -> None:
    paths = folding.write_demonstrations(tmp_path, progress=False)
    assert [path.stem for path in paths] == list(TASKS)
    for path in paths:
        read, task = read_demonstration(path), TASKS[path.stem]
        assert read.object == task.object and [len(look.moves) for look in read.looks] == list(map(len, task.looks))
        assert len(read.looks[0].asked) > len(task.looks[0])
        for look, moves in zip(read.looks, task.looks, strict=True):
            assert len(look.places) == len(look.asked) and look.places[: len(moves)] == tuple(m.pick for m in moves)


def test_rows_of_other_policies_stay(tmp_path: Path, physics: list[str]) -> None:
    run(Paths(tmp_path, "smoke"), policies=ASKED, progress=False)
    results = json.loads(run(Paths(tmp_path, "smoke"), policies=ASKED[:1], progress=False).read_text())
    assert list(results["policies"]["rope"]) == ["truth", "random", "nothing"]


def test_a_model_that_is_not_trained_yet_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    policy = POLICIES["quick_pcl"]
    with pytest.raises(FileNotFoundError, match="cloth-pcl-.*weights.safetensors is no"):
        find_answering(policy, "cloth")
    weights = find_answering(POLICIES["spcl"], "cloth")
    assert weights.name == "cloth-spcl.safetensors" and policy not in SHIPPED
    monkeypatch.setattr(policies, "find_answering", lambda *_: weights)
    digest_policy.cache_clear()
    assert digest_policy(policy, "cloth") != digest_policy(POLICIES["quick_spcl"], "cloth")
    digest_policy.cache_clear()


@pytest.mark.parametrize(("name", "object", "told"), [
    ("mmgsd", "cloth", {"n": 4, "joint": False}),
    ("mmgsd_joint", "rope", {"n": 2, "joint": True}),
    ("quick_unimodal", "cloth", {"n": 4, "joint": False}),
    ("quick_one", "cloth", {"n": 1, "joint": False}),
])  # fmt: skip
def test_all_methods_are_asked_for_as_many_modes_but_one(
    name: str, object: str, told: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    class Listening:
        def match(self, *_: object, **how: object) -> None:
            asked.append(how)

    monkeypatch.setattr(policies, "load_matcher", lambda *_: Listening())
    image = np.zeros((9, 9, 3), np.uint8)
    policies.ask(POLICIES[name], object, Look(image, np.zeros((1, 2, 2)), np.zeros((0, 2))), image, image[..., 0] > 0)
    assert asked == [told]


@pytest.mark.parametrize(("told", "names"), [
    ({}, {"truth", "mmgsd", "mmgsd_paper", "spcl", "random"}),
    ({"trained": True}, {"truth", "quick_mmgsd", "quick_unimodal"}),
    ({"trained": True, "only": "pcl"}, {"truth", "quick_spcl", "quick_pcl"}),
])  # fmt: skip
def test_the_command_runs_shipped_weights_or_trained_models(
    told: dict, names: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[set[str]] = []
    monkeypatch.setattr(folding, "run", lambda *_, policies, **__: asked.append({p.name for p in policies}))
    folding.main("smoke", **told)
    assert names <= asked[0] and "nothing" not in asked[0]
    assert any("quick" in name for name in asked[0]) == ("trained" in told)


def test_another_preset_has_no_rollouts(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="preset must"):
        run(Paths(tmp_path, "workspace"))


def test_pixels_and_places_on_the_table_belong_together() -> None:
    state = lay("cloth", {})
    np.testing.assert_allclose(find_on_table(state.xy, state), FLAT["cloth"][:, :2], atol=1e-5)


def test_a_summary_tells_all_from_what_was_reachable() -> None:
    rows = {
        "a": {"task": "edge", "error": 0.01, "overlap": 0.9, "success": True, "fault": "", "share": 1.0},
        "b": {"task": "edge", "error": 0.30, "overlap": 0.5, "success": False, "fault": "", "share": 0.2},
        "c": {"task": "unfold", "error": np.inf, "overlap": 0.0, "success": False, "fault": "nowhere", "share": 1.0},
    }
    said = summarise_rollouts(rows, {"a", "b"})
    assert said["all"]["success"]["mean"] == pytest.approx(1 / 3, abs=1e-4) and said["all"]["error"]["count"] == 3
    assert said["reachable"]["success"]["mean"] == 0.5 and said["cautious"] == {
        **said["cautious"],
        "mean": 1.0,
        "count": 1,
    }
    assert said["edge"]["error"]["mean"] == pytest.approx(0.155) and said["faults"] == 1
    assert said["rollouts"]["c"] == [1.0, False]


def test_a_policy_that_is_unsure_looks_again_and_keeps_the_surest_look(
    tmp_path: Path, physics: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shares = {"": 0.4, "-look1": 0.6, "-look2": 0.5}
    policy = POLICIES["mmgsd_again"]

    def say(bench: Bench, *asked: object) -> PolicyAnswer:
        look = asked[3].about.get("again", 0)
        return PolicyAnswer(np.zeros((0, 2, 2)), None, shares[f"-look{look}" if look else ""])

    monkeypatch.setattr(Bench, "_ask", say)
    bench = Bench(tmp_path, {"progress": False})
    kept = [rollout for rollout in list_rollouts("cloth", 8) if rollout.task == "edge"][:1]
    rows = bench.roll([policy, POLICIES["mmgsd"]], kept, bench.make_starts(kept))
    assert [row["share"] for row in rows["mmgsd_again"].values()] == [0.6]
    assert [row["share"] for row in rows["mmgsd"].values()] == [0.4]
    ((file, answer),) = bench.acted[policy, kept[0]]
    assert file.stem.endswith("look1") and answer.share == 0.6
    shares[""] = 0.8  # sure at once
    bench = Bench(tmp_path / "sure", {"progress": False})
    bench.roll([policy], kept, bench.make_starts(kept))
    assert not any("look" in path.stem for path in (tmp_path / "sure" / "acts").iterdir())
