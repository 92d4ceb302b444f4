"""The whole experiment of a preset, watched from a terminal: ``python -m mmgsd reproduce quick``.

It is papermill that runs notebooks/run_all.ipynb; this says how far it is, ends all of it at a Ctrl-C, and gives the
verdict.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TextIO

import psutil

from mmgsd.command import Option
from mmgsd.config import PRESETS
from mmgsd.paths import Paths, find_root
from mmgsd.progress import TOLD
from mmgsd.report.stages import estimate_left, find_run, load_minutes, load_state

LOOK = 1.0  # s between two looks at how far it is
SAY = 60.0  # s between two lines, where no line can be drawn over
PATIENCE = 10.0  # s that processes have to end when asked


def reproduce(preset: str, *, out: TextIO = sys.stdout) -> str:
    """Run every stage of a preset, telling ``out`` how far it is; returns the summary of the verdict.

    Raises RuntimeError, which names the stage and where its traceback is, where one fails.
    """
    paths = Paths(find_root(), preset)
    source, executed = paths.root / "notebooks" / "run_all.ipynb", paths.generated.parent / f"run_all_{preset}.ipynb"
    folder = find_run(paths)
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "papermill", "--kernel", "python3", "--no-progress-bar", source, executed]
    environment, log = {**os.environ, TOLD: str(folder / "bar.txt")}, folder / "papermill.log"
    (folder / "bar.txt").unlink(missing_ok=True)  # of a killed run
    begun, screen = time.time(), Screen(out)
    with running([*map(str, command), "-p", "preset", preset], log, environment) as process:
        while process.poll() is None:
            screen.show_state(paths, begun)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(LOOK)
    screen.show_state(paths, begun)
    screen.draw("")
    if process.returncode:
        raise RuntimeError(describe_failure(paths, executed, log, begun))
    return (folder / "verdict.txt").read_text("utf-8") + f"Every number: {executed.relative_to(paths.root)}\n"


@contextmanager
def running(command: list[str], log: Path, environment: Mapping[str, str]) -> Iterator[subprocess.Popen]:
    """A process that writes to ``log``; after an exception it ends, with all that it started.

    It has a session of its own, so that a Ctrl-C in the terminal reaches it only from here.
    """
    with open(log, "wb") as file:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT, env=environment,
            start_new_session=True, preexec_fn=_end_with_parent if sys.platform == "linux" else None,
        )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            end_tree(process.pid)
            process.wait()


def _end_with_parent() -> None:
    """In a process that begins: be ended when its parent is killed outright."""
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def end_tree(pid: int) -> None:
    """End a process and all that it started: asked at first, killed after `PATIENCE`."""
    with contextlib.suppress(psutil.NoSuchProcess):
        parent = psutil.Process(pid)
        tree = [parent, *parent.children(recursive=True)]
        for end in (psutil.Process.terminate, psutil.Process.kill):
            for process in tree:
                with contextlib.suppress(psutil.NoSuchProcess):
                    end(process)
            tree = psutil.wait_procs(tree, timeout=PATIENCE)[1]


class Screen:
    """Where progress is told: over one line of a terminal, or a line a minute in a file; a line a finished stage."""

    def __init__(self, out: TextIO) -> None:
        self.out, self.over = out, out.isatty()
        self.finished: list[str] = []  # finished stages
        self.now, self.printed = "", 0.0  # stage and time (s) of the last line that was not drawn over

    def show_state(self, paths: Paths, begun: float) -> None:
        """Tell how far a run is that began at a time (s since 1970)."""
        state = load_state(paths)
        if state.get("started", 0.0) < begun:  # what an earlier run left
            self.draw(f"starting: {_say((time.time() - begun) / 60)}", "starting")
            return
        for name in state["minutes"]:
            if name not in self.finished:
                self.finished.append(name)
                self.write(f"{_count(state, name)}: {state['minutes'][name]:.1f} min")
        if state["now"]:
            bar = find_run(paths) / "bar.txt"
            doing = bar.read_text("utf-8") if bar.is_file() else ""
            self.draw(describe_state(state, load_minutes(paths), doing, time.time(), begun), state["now"])

    def write(self, line: str) -> None:
        """A line that stays."""
        self.draw("")
        print(line, file=self.out, flush=True)

    def draw(self, line: str, now: str = "") -> None:
        """A line that the next one is drawn over; where that cannot be, one a stage and a minute."""
        if self.over:
            columns = shutil.get_terminal_size().columns
            self.out.write(f"\r\x1b[K{line[: columns - 1]}")
            self.out.flush()
        elif line and (now != self.now or time.monotonic() - self.printed >= SAY):
            self.now, self.printed = now, time.monotonic()
            print(line, file=self.out, flush=True)


def describe_state(state: Mapping[str, Any], stored: Mapping[str, float], doing: str, now: float, begun: float) -> str:
    """One line: which stage, for how long, how long all and the rest take, and what its bar says."""
    elapsed = (now - state["since"]) / 60
    left = estimate_left(state, stored, elapsed)
    rest = "time left unknown: no minutes stored" if left is None else f"about {_say(left)} left"
    line = f"{_count(state, state['now'])}: {_say(elapsed)}, in all {_say((now - begun) / 60)}, {rest}"
    return line + (f" | {doing}" if doing else "")


def describe_failure(paths: Paths, executed: Path, log: Path, begun: float) -> str:
    """Which stage failed, with the last line of its error, and where the traceback is."""
    state = load_state(paths)
    name = state.get("now", "") if state.get("started", 0.0) >= begun else ""
    place = find_run(paths) / f"{name}.ipynb" if name else executed
    text = re.sub(r"\x1b\[[0-9;]*m", "", log.read_text("utf-8", errors="replace"))
    last = next((line for line in reversed(text.splitlines()) if line.strip()), "it said nothing")
    return f"{name or 'run_all'} failed: {last.strip()} (its traceback: {place.relative_to(paths.root)})"


def _count(state: Mapping[str, Any], name: str) -> str:
    return f"[{state['stages'].index(name) + 1}/{len(state['stages'])}] {name}"


def _say(minutes: float) -> str:
    """Minutes for a reader: "40 s", "12 min", "2 h 05"."""
    if minutes < 1:
        return f"{60 * minutes:.0f} s"
    hours, rest = divmod(round(minutes), 60)
    return f"{hours} h {rest:02}" if hours else f"{rest} min"


def main(preset: Annotated[str, Option(choices=PRESETS)]) -> None:
    """Run every stage of a preset and print its verdict."""
    for name in ("SIGTERM", "SIGHUP"):  # end everything as a Ctrl-C does, unless nohup has it go on
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
            signal.signal(getattr(signal, name), signal.default_int_handler)
    print(f"Every stage of the preset {preset}; Ctrl-C stops, and the same command goes on.", flush=True)
    print(reproduce(preset), end="")
