"""Rollouts' states as files: batches of jobs on Dask, each batch in a child process that runs Blender's physics.

A job is a plain dictionary. Its ``mark`` is a digest of all that decides its state, of an act also of the state that it
goes on from; the state keeps it, so that a file of another origin never passes for it.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mmgsd.checks import check, check_choice, read_count, read_flag
from mmgsd.cluster import run_tasks
from mmgsd.files import is_kept, scratch_folder, write_bytes
from mmgsd.fold.state import State, read_state
from mmgsd.fold.tasks import GROUNDS, MOTIONS, STARTS, Move, Task, find_task, place_truth
from mmgsd.progress import ProgressBar
from mmgsd.scene.stage import connect, run_job

if TYPE_CHECKING:
    from dask.distributed import Client

VERSION = 1  # to be raised where the same job gives another state than before
JOBS_A_BATCH = 12  # a child process ends after so many at most: it takes seconds to start

PixelMove = tuple[tuple[float, float], tuple[float, float]]  # pick and place, (x, y) px each


def start_job(task: Task, start: str, ground: str, seed: int, *, turn_deg: float | None = None) -> dict:
    """A rollout's first state: the object lies in ``start``, turned by any angle, seen by a random camera.

    With ``turn_deg`` it is seen turned by no more than that, both ways, here and after each act: on a plain ground.
    How it lies depends on task, start and seed alone, what it looks like on the ground too. ValueError for a start that
    the task's object has not, another ground than those of ``GROUNDS``, and for a turn beyond 180 or in a workspace.
    """
    check_choice("start", start, STARTS[task.object])
    check_choice("ground", ground, GROUNDS if turn_deg is None else ("plain",))
    check("turn_deg", turn_deg, "None, or between 0 and 180", turn_deg is None or 0 <= turn_deg <= 180)
    limit = {} if turn_deg is None else {"turn_deg": float(turn_deg)}
    return _begin("start", task, start, ground, seed, **limit)


def demonstration_job(task: Task, seed: int) -> dict:
    """The demonstration's first state: plain ground, the camera above, the object unturned about the origin."""
    return _begin("demonstration", task, task.demonstrated_from, "plain", seed)


def act_job(state: Path, moves: Sequence[PixelMove]) -> dict:
    """The state after ``moves``, pairs of pixels (x, y) of its image, were made at once from the state in a file."""
    return _go_on(state, {"kind": "act", "moves": _read_moves(moves)})


def look_job(state: Path, again: int, *, tilt_deg: float | None = None) -> dict:
    """The state in a file, seen by another camera, the ``again``-th, from 1.

    With ``tilt_deg`` it looks from aside, so far from straight down. ValueError for a tilt beyond 80, and where the
    ground is not plain.
    """
    check_choice("ground", read_state(state).about["ground"], GROUNDS if tilt_deg is None else ("plain",))
    check("tilt_deg", tilt_deg, "None, or between 0 and 80", tilt_deg is None or 0 <= tilt_deg <= 80)
    tilt = {} if tilt_deg is None else {"tilt_deg": float(tilt_deg)}
    return _go_on(state, {"kind": "look", "again": read_count("again", again, least=1)} | tilt)


def film_job(
    state: Path, moves: Sequence[PixelMove], motion: str, *, frames: int, size: tuple[int, int] | None = None
) -> dict:
    """What a fixed camera sees of a motion of `MOTIONS` that begins with the state in a file.

    Of ``moves`` as `act_job` has them, being made; ``frames`` pictures, at least 2, evenly over the time that it takes,
    of ``size`` (width, height) px, none: as the state's. DamagedFileError where the file is no state; ValueError for
    another motion.
    """
    check_choice("motion", motion, MOTIONS)
    film = {"kind": "film", "motion": motion, "frames": read_count("frames", frames, least=2)}
    size = list(size or read_state(state).camera.size)
    return _go_on(state, {**film, "size": size, "moves": _read_moves(moves)})


def true_moves(look: Sequence[Move], demonstrated: np.ndarray, state: State) -> list[PixelMove]:
    """What a policy that knows the true matches answers: the pixels of the picked points, and of the carried places.

    Places are carried by the rigid motion that best maps the points (625, 3) m of the demonstration's FIRST state
    onto those of the rollout's, since a task's places are given in that frame.
    """
    places = place_truth(np.array([move.place for move in look]), demonstrated, state.first)
    pixels = state.project(np.column_stack([places, np.zeros(len(places))]))
    return [(tuple(map(float, state.xy[move.pick])), (float(x), float(y)))
            for move, (x, y) in zip(look, pixels, strict=True)]  # fmt: skip


def _read_moves(moves: Sequence[PixelMove]) -> list[list[list[float]]]:
    pixels = np.array(moves, dtype=float).reshape(-1, 4) if len(moves) == 0 else np.array(moves, dtype=float)
    accepted = "pairs of finite pixels ((x, y), (x, y))"
    check("moves", moves, accepted, pixels.shape[1:] in ((2, 2), (4,)) and bool(np.isfinite(pixels).all()))
    return pixels.reshape(-1, 2, 2).tolist()


def _begin(kind: str, task: Task, start: str, ground: str, seed: int, **limit: float) -> dict:
    find_task(task.name)
    what = {"kind": kind, "task": task.name, "object": task.object, "start": start, "ground": ground}
    return _marked(what | {"seed": read_count("seed", seed)} | limit)


def _go_on(state: Path, job: dict) -> dict:
    """A job that begins with the state in a file."""
    return _marked(job | {"after": read_state(state).about["mark"]}) | {"state": str(state)}


def _marked(job: dict) -> dict:
    return job | {"mark": hashlib.sha256(json.dumps([VERSION, job], sort_keys=True).encode()).hexdigest()}


def run_jobs(
    jobs: Mapping[str, dict], folder: Path, *, workers: int = 0, scheduler: str = "", progress: bool = True
) -> dict[str, Path]:
    """Make each job's state, the file ``folder/<name>.npz``; returns the files by name.

    Whole ones that are there already are kept; damaged ones are set aside, those of another job replaced. An act's
    state must be there. ``workers`` child processes at once (0: one a core), or the ``scheduler`` of an existing Dask
    cluster by its address. RenderError where a child process fails.
    """
    folder, workers, progress = Path(folder), read_count("workers", workers), read_flag("progress", progress)
    files = {name: folder / f"{name}.npz" for name in jobs}
    missing = {name: job for name, job in jobs.items() if not is_kept(files[name], partial(_is_of, job))}
    if missing:
        with connect(workers, scheduler) as client:
            _run_missing(client, missing, files, progress)
    return files


def _is_of(job: dict, path: Path) -> bool:
    return read_state(path).about["mark"] == job["mark"]


def _run_missing(client: Client, jobs: dict[str, dict], files: dict[str, Path], progress: bool) -> None:
    names = list(jobs)
    threads = max(1, sum(client.nthreads().values()))
    most = 1 if any(job["kind"] == "film" for job in jobs.values()) else JOBS_A_BATCH  # a film takes minutes
    size = min(most, -(-len(names) // threads))
    batches = [names[i : i + size] for i in range(0, len(names), size)]
    # with the files of the states that jobs go on from: a worker elsewhere sees no files of this machine
    before = {name: Path(job["state"]).read_bytes() for name, job in jobs.items() if "state" in job}
    tasks = {batch[0]: {name: (jobs[name], before.get(name)) for name in batch} for batch in batches}
    bar = ProgressBar(total=len(names), desc="fold", unit="state", disable=not progress)
    with bar, run_tasks(client, _make_batch, tasks, retries=1) as results:
        for _, states in results:
            for name, data in states.items():
                write_bytes(files[name], data)
            bar.update(len(states))


def _make_batch(jobs: dict[str, tuple[dict, bytes | None]]) -> dict[str, bytes]:
    """Make states in a child process: their files by name."""
    with scratch_folder(Path(tempfile.gettempdir()), "mmgsd-fold") as folder:
        states = []
        for i, (job, before) in enumerate(jobs.values()):
            state = {"state": str(write_bytes(folder / f"before{i}.npz", before))} if before else {}
            states.append(job | state | {"out": str(folder / f"after{i}.npz")})
        outs = [Path(one["out"]) for one in states]
        job, what = {"module": "mmgsd.fold.manipulation", "states": states}, f"folding {', '.join(jobs)}"
        return dict(zip(jobs, run_job(job, folder, what, outs), strict=True))
