"""A run of the whole experiment, stage by stage: which one it is in, the minutes of each, and those that are left.

``data/generated/PRESET/notebooks/run.json`` says how far a run is, for who looks on and for the run that goes on after
a kill. ``data/results/PRESET/stages.json`` keeps each stage's minutes: {"01_render_data": 8.2, …}.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mmgsd.files import DamagedFileError, is_kept, locked, write_json
from mmgsd.paths import Paths
from mmgsd.studies.registry import REMEDY, read_table


def find_run(paths: Paths) -> Path:
    """The folder of a preset's executed notebooks, and of what is kept of their run."""
    return paths.generated / "notebooks"


class Run:
    """The stages of a preset, to be run in order, each within `stage`; ``minutes`` are those of this run's stages.

    LockedError, which names the process, where another run of the preset is at work.
    """

    def __init__(self, paths: Paths, stages: Sequence[str]) -> None:
        self.paths, self.stages = paths, list(stages)
        self.stored = load_minutes(paths)
        self.minutes: dict[str, float] = {}
        self.times: dict[str, float] = {}
        earlier = load_state(paths)
        self.whole = dict(earlier.get("whole", {}))  # minutes of what was made from nothing to its end
        self.begun = list(earlier.get("begun", []))  # and did not come to its end
        with locked(find_run(paths), "run_all"):
            self._write("", started=time.time())

    @contextmanager
    def stage(self, name: str, *, skips: bool) -> Iterator[None]:
        """Time one stage; ``skips`` says whether it leaves finished work as it is.

        Its minutes are kept for later estimates unless it found its work finished, or half done by a killed run.
        """
        with locked(find_run(self.paths), f"run_all, {name},"):
            resumed, since = name in self.begun, time.time()
            self.begun = [*dict.fromkeys([*self.begun, name])]
            self._write(name, since=since)
            yield
            self.minutes[name] = (time.time() - since) / 60
            self.begun.remove(name)
            if not resumed and (not skips or _has_new_files(self.paths, since)):
                self.whole[name] = round(self.minutes[name], 2)
            self._write("")

    def finish(self) -> Path:
        """Store the minutes of the stages that were made from nothing, beside those that are stored; the file."""
        minutes = {**self.stored, **self.whole}
        stages = [*dict.fromkeys([*self.stages, *minutes])]
        ordered = {name: minutes[name] for name in stages if name in minutes}
        written = write_json(self.paths.results / "stages.json", ordered)
        self.whole, self.begun = {}, []
        self._write("")
        return written

    def _write(self, now: str, **times: float) -> None:
        """Say in run.json which stage it is in, since when (s since 1970), and what was done."""
        self.times |= times
        state = {"stages": self.stages, "now": now, **self.times, "minutes": self.minutes}
        write_json(find_run(self.paths) / "run.json", {**state, "whole": self.whole, "begun": self.begun})


def load_state(paths: Paths) -> dict[str, Any]:
    """What run.json says; {} where there is none, and where it is damaged, which is set aside."""
    path = find_run(paths) / "run.json"
    return read_table(path) if is_kept(path, read_table) else {}


def load_minutes(paths: Paths) -> dict[str, float]:
    """The stored minutes of each stage, {} where there are none; DamagedFileError where one is no number."""
    path = paths.results / "stages.json"
    minutes = read_table(path) if path.is_file() else {}
    if not all(isinstance(value, int | float) for value in minutes.values()):
        raise DamagedFileError(f"{path} must hold the minutes of each stage: {REMEDY}")
    return minutes


def estimate_left(state: Mapping[str, Any], stored: Mapping[str, float], elapsed: float) -> float | None:
    """Minutes that the rest takes: those stored, at this machine's pace; None where some stage has none stored.

    ``state`` is what run.json says, ``elapsed`` the minutes of its present stage. The pace comes from the stages that
    this run made from nothing, and from the present one as soon as that takes longer than expected.
    """
    now, rest = state["now"], [name for name in state["stages"] if name not in state["minutes"]]
    if not all(stored.get(name) for name in rest):
        return None
    timed = [name for name in state["whole"] if stored.get(name)]
    took, expected = (sum(minutes[name] for name in timed) for minutes in (state["whole"], stored))
    pace = took / expected if expected else 1.0
    present = stored[now] if now else 0.0
    if present:
        pace = max(pace, (took + elapsed) / (expected + present))
    return pace * sum(stored[name] for name in rest if name != now) + max(0.0, pace * present - elapsed)


def _has_new_files(paths: Paths, since: float) -> bool:
    """Whether anything but locks and executed notebooks was generated after a time (s since 1970)."""
    for path in paths.generated.rglob("[!.]*"):
        with contextlib.suppress(FileNotFoundError):  # of another process
            if find_run(paths) not in path.parents and path.is_file() and path.stat().st_mtime > since:
                return True
    return False
