"""Child process that does one job and ends: ``python -m mmgsd.scene < job.json``.

Blender lives in such ones alone, so its memory goes with the process, and its chatter stays out of the parent's output.
A job may name under ``module`` whose ``run_job`` does it, `mmgsd.scene.batch` if left out, and under ``parent`` the
process with which this one ends. The exit code is 1 after an exception, its traceback on stderr.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PR_SET_PDEATHSIG = 1  # of Linux: which signal a process gets when its parent ends


def main() -> None:
    """Read a job from stdin and do it, silenced."""
    job = json.load(sys.stdin)
    if "parent" in job:
        _end_with(job["parent"])
    with silenced():
        use_one_core()
        importlib.import_module(job.get("module", "mmgsd.scene.batch")).run_job(job)


def _end_with(parent: int) -> None:
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


def use_one_core() -> None:
    """Let Blender's task scheduler, which counts the cores once, believe in a single one, where MMGSD_THREADS is set.

    As many processes render as there are cores, and its idle threads would spin beside them: a quarter of the time.
    """
    if "MMGSD_THREADS" not in os.environ or not hasattr(os, "sched_setaffinity"):
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        import bpy

        bpy.ops.mesh.primitive_plane_add()
        bpy.context.view_layer.update()  # the first task of all
    finally:
        os.sched_setaffinity(0, cores)


@contextmanager
def silenced() -> Iterator[None]:
    """Send what C code prints to nowhere; Python's own stderr is back before a traceback is printed."""
    sys.stdout.flush()
    sys.stderr.flush()
    originals = [os.dup(fd) for fd in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            os.dup2(nowhere, fd)
        yield
    finally:
        sys.stdout.flush()
        for fd, original in zip((1, 2), originals, strict=True):
            os.dup2(original, fd)
            os.close(original)
        os.close(nowhere)


if __name__ == "__main__":
    main()
