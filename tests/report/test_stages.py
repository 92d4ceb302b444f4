"""A run knows its stage, keeps the minutes of what it made from nothing, and estimates the rest from them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mmgsd.files import DamagedFileError, LockedError
from mmgsd.paths import Paths
from mmgsd.report import stages
from mmgsd.report.stages import Run, estimate_left, find_run, load_minutes, load_state

STAGES = ("01_render", "02_inspect", "03_train")
STORED = {"01_render": 8.0, "02_inspect": 2.0, "03_train": 10.0}


class Clock:
    """Stands for the module time: minutes pass when they are told to."""

    def __init__(self) -> None:
        self.seconds = 2e9  # later than what any test writes

    def time(self) -> float:
        return self.seconds


@pytest.fixture
def paths(tmp_path: Path) -> Paths:
    return Paths(tmp_path, "quick")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(stages, "time", clock)
    monkeypatch.setattr(stages, "_has_new_files", lambda paths, since: (paths.generated / "made").exists())
    return clock


def pass_stage(run: Run, name: str, clock: Clock, minutes: float, *, skips: bool = True, made: bool = True) -> None:
    with run.stage(name, skips=skips):
        clock.seconds += 60 * minutes
        (run.paths.generated / "made").unlink(missing_ok=True)
        if made:
            (run.paths.generated / "made").touch()


def state(now: str, minutes: dict[str, float], whole: dict[str, float] | None = None) -> dict[str, Any]:
    return {"stages": STAGES, "now": now, "minutes": minutes, "whole": minutes if whole is None else whole}


@pytest.mark.parametrize(
    ("now", "minutes", "whole", "elapsed", "left"),
    [
        ("01_render", {}, {}, 0.0, 20.0),
        ("01_render", {}, {}, 3.0, 17.0),
        ("01_render", {}, {}, 16.0, 24.0),  # twice as long as expected: so will the rest be
        ("02_inspect", {"01_render": 4.0}, None, 0.0, 6.0),  # twice as fast
        ("02_inspect", {"01_render": 0.1}, {}, 0.0, 12.0),  # finished before: says nothing of the pace
        ("03_train", {"01_render": 0.1, "02_inspect": 4.0}, {"01_render": 16.0, "02_inspect": 4.0}, 5.0, 15.0),
        ("", {"01_render": 8.0}, None, 0.0, 12.0),
        ("", STORED, None, 0.0, 0.0),
    ],
)
def test_the_rest_is_what_is_stored_at_this_machines_pace(
    now: str, minutes: dict, whole: dict | None, elapsed: float, left: float
) -> None:
    assert estimate_left(state(now, minutes, whole), STORED, elapsed) == pytest.approx(left)


def test_without_the_minutes_of_a_stage_to_come_nothing_is_estimated() -> None:
    assert estimate_left(state("01_render", {}), {}, 1.0) is None
    assert estimate_left(state("01_render", {}), {**STORED, "03_train": 0.0}, 1.0) is None
    assert estimate_left(state("03_train", {"01_render": 1.0, "02_inspect": 1.0}), {"03_train": 4.0}, 1.0) == 3.0


def test_minutes_of_what_was_made_from_nothing_are_stored_and_others_stay(paths: Paths, clock: Clock) -> None:
    paths.results.mkdir(parents=True)
    (paths.results / "stages.json").write_text(json.dumps({"01_render": 8.0, "03_train": 10.0}))
    run = Run(paths, STAGES)
    pass_stage(run, "01_render", clock, 0.5, made=False)
    pass_stage(run, "02_inspect", clock, 2, skips=False, made=False)
    pass_stage(run, "03_train", clock, 12)
    run.finish()
    assert run.minutes == pytest.approx({"01_render": 0.5, "02_inspect": 2, "03_train": 12})
    assert load_minutes(paths) == {"01_render": 8.0, "02_inspect": 2.0, "03_train": 12.0}


def test_a_killed_stage_is_timed_by_no_later_run_and_what_it_followed_is(paths: Paths, clock: Clock) -> None:
    killed = Run(paths, STAGES)
    pass_stage(killed, "01_render", clock, 8)
    with pytest.raises(KeyboardInterrupt), killed.stage("02_inspect", skips=False):
        raise KeyboardInterrupt
    run = Run(paths, STAGES)
    assert load_state(paths)["minutes"] == {}
    pass_stage(run, "01_render", clock, 0.1, made=False)
    pass_stage(run, "02_inspect", clock, 1, skips=False)
    pass_stage(run, "03_train", clock, 10)
    run.finish()
    assert load_minutes(paths) == {"01_render": 8.0, "03_train": 10.0}


def test_the_state_names_the_stage_while_it_lasts(paths: Paths, clock: Clock) -> None:
    run = Run(paths, STAGES)
    with run.stage("01_render", skips=True):
        assert load_state(paths) | {"now": "01_render", "since": clock.seconds} == load_state(paths)
    assert load_state(paths)["now"] == ""


def test_a_damaged_state_is_set_aside(paths: Paths) -> None:
    find_run(paths).mkdir(parents=True)
    (find_run(paths) / "run.json").write_text('{"stages": [')
    with pytest.warns(UserWarning, match="run.json is damaged"):
        assert load_state(paths) == {}


def test_stored_minutes_that_are_none_stop_a_run_at_its_beginning(paths: Paths) -> None:
    paths.results.mkdir(parents=True)
    (paths.results / "stages.json").write_text('{"01_render": "long"}')
    with pytest.raises(DamagedFileError, match="stages.json must"):
        Run(paths, STAGES)


def test_only_one_run_of_a_preset_is_at_work(paths: Paths) -> None:
    with Run(paths, STAGES).stage("01_render", skips=True), pytest.raises(LockedError, match="run_all, 01_render"):
        Run(paths, STAGES)


def test_executed_notebooks_and_locks_are_not_what_a_stage_has_made(paths: Paths) -> None:
    for name in ("notebooks/01_render.ipynb", "cloth/.partial", ".notebooks.lock"):
        (paths.generated / name).parent.mkdir(parents=True, exist_ok=True)
        (paths.generated / name).touch()
    assert not stages._has_new_files(paths, 0.0)
    (paths.generated / "cloth" / "dataset.json").touch()
    assert stages._has_new_files(paths, 0.0) and not stages._has_new_files(paths, 3e9)
