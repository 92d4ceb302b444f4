"""Child process that makes states of rollouts: ``python -m mmgsd.fold < job.json``.

A job holds ``states``, each a job of `mmgsd.fold.jobs` with ``out``, the file to write, and ``parent``, the process
with which this one ends.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mmgsd.scene.child import one_core, run_main


def make_states(job: dict[str, Any]) -> list[Path]:
    """Begin or go on with rollouts, one job of ``states`` after the other; their files."""
    with one_core():
        from mmgsd.fold.manipulation import run_job  # bpy is loaded once the output is silenced

    return [run_job(one, Path(one["out"])) for one in job["states"]]


if __name__ == "__main__":
    run_main(make_states)
