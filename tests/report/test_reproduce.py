"""What a terminal shows of a run, how it ends, and that a Ctrl-C leaves no process behind."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from mmgsd.command import KEPT
from mmgsd.paths import Paths
from mmgsd.report import reproduce
from mmgsd.report.reproduce import Screen, describe_failure, describe_state, running
from mmgsd.report.stages import find_run

STATE = {"stages": ["01_render_data", "03_train"], "started": 100.0, "now": "03_train", "since": 460.0,
         "minutes": {"01_render_data": 6.0}, "whole": {"01_render_data": 6.0}, "begun": ["03_train"]}  # fmt: skip
STORED = {"01_render_data": 3.0, "03_train": 10.0}
SLEEP = "import time; time.sleep(120)"  # s, more than any test takes
COMMAND = f"""
import os, sys
from mmgsd.__main__ import main
from mmgsd.report import reproduce

def wait(preset):
    with reproduce.running([sys.executable, "-c", {SLEEP!r}], os.devnull, {{}}) as process:
        print(process.pid, flush=True)
        process.wait()

reproduce.reproduce = wait
main(["reproduce", "smoke"])
"""  # with something that waits in the place of papermill


class Terminal(io.StringIO):
    """Draws over its last line."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def paths(tmp_path: Path) -> Paths:
    find_run(Paths(tmp_path, "quick")).mkdir(parents=True)
    return Paths(tmp_path, "quick")


def write_state(paths: Paths, **changes: Any) -> None:
    (find_run(paths) / "run.json").write_text(json.dumps(STATE | changes))


@pytest.mark.parametrize(
    ("stored", "doing", "now", "line"),
    [
        (STORED, "cloth-mmgsd: 12/40", 1060.0,
         "[2/2] 03_train: 10 min, in all 16 min, about 10 min left | cloth-mmgsd: 12/40"),
        (STORED, "", 490.0, "[2/2] 03_train: 30 s, in all 6 min, about 20 min left"),
        (STORED | {"03_train": 90.0}, "", 460.0, "[2/2] 03_train: 0 s, in all 6 min, about 3 h 00 left"),
        ({}, "", 460.0, "[2/2] 03_train: 0 s, in all 6 min, time left unknown: no minutes stored"),
    ],
)  # fmt: skip
def test_the_line_says_the_stage_its_minutes_and_what_is_left(
    stored: dict[str, float], doing: str, now: float, line: str
) -> None:
    assert describe_state(STATE, stored, doing, now, 100.0) == line


def test_a_terminal_keeps_finished_stages_and_draws_over_the_rest(paths: Paths) -> None:
    write_state(paths)
    (find_run(paths) / "bar.txt").write_text("cloth-mmgsd: 12/40")
    screen = Screen(Terminal())
    for _ in range(3):
        screen.show_state(paths, 100.0)
    shown = screen.out.getvalue()
    assert shown.count("[1/2] 01_render_data: 6.0 min\n") == 1
    assert shown.count("\r\x1b[K[2/2] 03_train: ") == 3 and shown.count("\n") == 1


def test_a_file_gets_a_line_a_stage_and_no_more_than_one_a_minute(
    paths: Paths, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = Screen(io.StringIO())
    write_state(paths, now="01_render_data", minutes={})
    for _ in range(3):
        screen.show_state(paths, 100.0)
    write_state(paths)
    screen.show_state(paths, 100.0)
    assert [line.split(":")[0] for line in screen.out.getvalue().splitlines()] == [
        "[1/2] 01_render_data", "[1/2] 01_render_data", "[2/2] 03_train"
    ]  # fmt: skip
    monkeypatch.setattr(reproduce, "SAY", 0.0)
    screen.show_state(paths, 100.0)
    assert len(screen.out.getvalue().splitlines()) == 4


def test_what_an_earlier_run_left_is_not_shown(paths: Paths) -> None:
    screen = Screen(io.StringIO())
    screen.show_state(paths, 100.0)
    write_state(paths)
    screen.show_state(paths, 101.0)
    assert screen.out.getvalue().startswith("starting: ") and screen.out.getvalue().count("\n") == 1


@pytest.mark.parametrize(
    ("begun", "stage", "notebook"),
    [(100.0, "03_train", "quick/notebooks/03_train.ipynb"), (101.0, "run_all", "run_all_quick.ipynb")],
)
def test_a_failure_names_its_stage_its_error_and_the_traceback(
    paths: Paths, tmp_path: Path, begun: float, stage: str, notebook: str
) -> None:
    write_state(paths)
    log = tmp_path / "log"
    log.write_text("Traceback:\n\x1b[31mValueError\x1b[0m: no images\n\n")
    said = describe_failure(paths, paths.generated.parent / "run_all_quick.ipynb", log, begun)
    assert said == f"{stage} failed: ValueError: no images (its traceback: data/generated/{notebook})"


def wait_for(found: Callable[[], Any]) -> Any:
    """What is found within half a minute."""
    for _ in range(300):
        if value := found():
            return value
        time.sleep(0.1)
    raise AssertionError("nothing came in half a minute")


def test_an_interrupt_ends_all_that_was_started_other_sessions_too(tmp_path: Path) -> None:
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {SLEEP!r}], start_new_session=True)"
    with pytest.raises(KeyboardInterrupt), running([sys.executable, "-c", child], tmp_path / "log", {}) as process:
        grandchild = wait_for(lambda: psutil.Process(process.pid).children())[0]
        raise KeyboardInterrupt
    assert not grandchild.is_running() and not psutil.pid_exists(process.pid)


def test_what_will_not_end_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproduce, "PATIENCE", 0.5)
    deaf = f"import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('deaf', flush=True); {SLEEP}"
    with pytest.raises(KeyboardInterrupt), running([sys.executable, "-c", deaf], tmp_path / "log", {}) as process:
        wait_for((tmp_path / "log").read_bytes)
        raise KeyboardInterrupt
    assert not psutil.pid_exists(process.pid)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it goes on, and holds its lock")
def test_a_killed_command_leaves_no_papermill_behind() -> None:
    with subprocess.Popen([sys.executable, "-c", COMMAND], stdout=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        child = int(process.stdout.readline())
        process.kill()
    wait_for(lambda: not psutil.pid_exists(child) or psutil.Process(child).status() == psutil.STATUS_ZOMBIE)


def heed_signals() -> None:
    """As a command in a terminal does, also where the tests themselves run in the background and ignore them."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_the_command_ends_with_one_line_that_says_what_is_kept(number: signal.Signals) -> None:
    command, pipes = [sys.executable, "-c", COMMAND], {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, preexec_fn=heed_signals) as process:
        assert "smoke" in process.stdout.readline()
        child = int(process.stdout.readline())
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (130, f"stopped: {KEPT}\n")
    assert not psutil.pid_exists(child)
