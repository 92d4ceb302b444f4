"""Child process that renders one job: ``python -m mmgsd.scene < job.json``.

A job with ``states`` makes each of them (`mmgsd.scene.folding`) and writes it to its ``out``. Any other renders: it
holds ``config`` (the fields of ``RenderConfig``), ``split``, ``episodes`` as [[episode, views], …], ``sheet``
(None, or the object as `PlanarObject.to_dict` gives it), ``out``, the archive to write, and where they are known
``mark``, the job's hash, which the archive keeps, and ``parent``, the process with which this one ends. Blender lives
here alone: its memory goes with the process, and its chatter stays out of the parent's output. The exit code is 1 after
an exception, its traceback on stderr.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mmgsd.config import RenderConfig, from_dict
from mmgsd.files import writing
from mmgsd.images import encode_image, encode_mask
from mmgsd.scene.objects.planar_object import PlanarObject

PR_SET_PDEATHSIG = 1  # of Linux: which signal a process gets when its parent ends


def main() -> None:
    """Read a job from stdin and do it."""
    job = json.load(sys.stdin)
    if "parent" in job:
        end_with(job["parent"])
    with silenced():
        make_states(job) if "states" in job else render_job(job)


def make_states(job: dict[str, Any]) -> list[Path]:
    """Begin or go on with rollouts, one job of ``states`` after the other; their files."""
    with one_core():
        from mmgsd.scene.manipulation import run_job

    return [run_job(one, Path(one["out"])) for one in job["states"]]


def render_job(job: dict[str, Any]) -> Path:
    """Render a job's episodes into its archive, which appears whole or not at all.

    A view has the entries ``{episode:06d}_{view:02d}.webp`` (lossless) and ``…_mask.png`` (1 bit); ``labels.json``
    lists all views in order.
    """
    with one_core():
        from mmgsd.scene.episode import render_episode  # bpy is loaded once the output is silenced

    planar = PlanarObject.from_dict(job["sheet"]) if job.get("sheet") else None
    config, out = from_dict(RenderConfig, job["config"]), Path(job["out"])
    with writing(out) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as archive:
        archive.comment, labels = job.get("mark", "").encode(), []
        for episode, n_views in job["episodes"]:
            for i, view in enumerate(render_episode(config, job["split"], episode, n_views, planar)):
                written = write_view(archive, episode, i, view)
                labels.append({"episode": episode, "view": i, "split": job["split"], **written})
        _add(archive, "labels.json", json.dumps(labels).encode())
    return out


def end_with(parent: int) -> None:
    """End this process with its parent, however that ends: nobody would take what it renders."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()
    if os.getppid() != parent:  # it has ended before
        os._exit(1)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


def write_view(archive: zipfile.ZipFile, episode: int, index: int, view: Any) -> dict[str, Any]:
    """Add a view's image and mask to the archive; its labels as JSON values."""
    stem = f"{episode:06d}_{index:02d}"
    _add(archive, f"{stem}.webp", encode_image(view.image))
    _add(archive, f"{stem}_mask.png", encode_mask(view.mask))
    arrays = {name: getattr(view, name).tolist() for name in ("xy", "visible", "intrinsics", "camera_pose")}
    return {**arrays, "info": view.info}


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    archive.writestr(zipfile.ZipInfo(name), data)  # a ZipInfo of its own carries no date: equal content, equal bytes


@contextmanager
def one_core() -> Iterator[None]:
    """Let Blender's task scheduler, which counts the cores once, believe in a single one.

    As many processes render as there are cores, and its idle threads would spin beside them: a quarter of the time.
    """
    if "MMGSD_THREADS" not in os.environ or not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        import bpy

        bpy.ops.mesh.primitive_plane_add()
        bpy.context.view_layer.update()  # the first task of all
        yield
    finally:
        os.sched_setaffinity(0, cores)


@contextmanager
def silenced() -> Iterator[None]:
    """Send what C code prints to nowhere; Python's own stderr is back before a traceback is printed."""
    sys.stdout.flush()
    sys.stderr.flush()
    original_fds = [os.dup(fd) for fd in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            os.dup2(nowhere, fd)
        yield
    finally:
        sys.stdout.flush()
        for fd, original in zip((1, 2), original_fds, strict=True):
            os.dup2(original, fd)
            os.close(original)
        os.close(nowhere)


if __name__ == "__main__":
    main()
