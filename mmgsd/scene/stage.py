"""The rendering stage: episodes are independent tasks on Dask, each in a child process of its own.

bpy is imported in these children only (``python -m mmgsd.scene``): a crash, a leak or a killed worker costs one batch.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import io
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from mmgsd import files
from mmgsd.checks import check, read_count, read_flag
from mmgsd.cluster import open_client, open_threads, run_tasks
from mmgsd.config import DEFAULT_GROUP, OBJECTS, OWN_GROUP, RenderConfig, list_later, to_dict
from mmgsd.dataset import load_dataset
from mmgsd.dataset_format import FORMAT, SPLITS, encode_table, find_owner, is_member
from mmgsd.paths import find_root
from mmgsd.progress import ProgressBar
from mmgsd.scene.objects.planar_object import PlanarObject, load_planar_object
from mmgsd.symmetry import GRID_GROUPS, LINE_GROUPS, load_group, load_mirror

if TYPE_CHECKING:
    from dask.distributed import Client

IMAGES_A_BATCH = 30  # a child process ends after about so many, which bounds its memory
SCENES = {"cloth": 2, "rope": 1}  # to be raised where the same configuration gives another object than before
WORKSPACES = 2  # likewise of what is seen around the object in the scene "workspace"
GROUPS = {"cloth": GRID_GROUPS, "rope": LINE_GROUPS}
BATCH = re.compile(r"(train|test)_\d+\.(zip|tmp)(\.damaged)?|config\.(json|tmp)(\.damaged)?")
LABELS = {"episode", "view", "split", "xy", "visible", "intrinsics", "camera_pose", "info"}  # of a view in a batch
UNREADABLE = (OSError, EOFError, ValueError, TypeError, LookupError, AttributeError, NotImplementedError, RuntimeError,
              zipfile.BadZipFile, zlib.error)  # fmt: skip  # what zipfile raises about a damaged archive
# Our package is found where this one was; what else lies there or in the working directory, a bpy.py say, is not.
CHILD = """
import runpy, sys
sys.path.insert(0, sys.argv[1])
import mmgsd
del sys.path[0]
runpy.run_module("mmgsd.scene", run_name="__main__")
"""

_children: set[subprocess.Popen] = set()  # that render for this process now


class RenderError(RuntimeError):
    """Blender failed in a child process; the message ends with what it said."""


def render_dataset(
    config: RenderConfig, folder: Path, *,
    only_test: bool = False, workers: int = 0, scheduler: str = "", overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Render the data set of ``config`` into ``folder`` and return it; a finished one is returned as it is.

    ``only_test`` leaves out the training images: enough to evaluate models. A later call without it renders the rest.

    ``workers`` processes on this machine (0: one a core that it may use), or the ``scheduler`` of an existing Dask
    cluster by its address. Finished batches of a killed call are kept, damaged ones are rendered again.

    Objects other than ``cloth`` and ``rope`` are read from ``data/objects/<name>.json``
    (`mmgsd.scene.objects.planar_object`).

    Raises ValueError where the folder holds another configuration, ForeignFileError where it holds anything but a data
    set, LockedError while another process renders into it.
    """
    flags = {"only_test": only_test, "overwrite": overwrite, "progress": progress}
    only_test, overwrite, progress = (read_flag(name, value) for name, value in flags.items())
    folder, workers = Path(folder), read_count("workers", workers)
    check("scheduler", scheduler, "an address like tcp://host:8786 or ''", isinstance(scheduler, str))
    if not overwrite and _is_rendered(config, folder, only_test):
        return folder
    with files.locked(folder, "rendering"):
        if not overwrite and _is_rendered(config, folder, only_test):  # by the process that held the folder before
            return folder
        partial = folder.with_name(folder.name + ".partial")
        _check_places(folder, partial)
        jobs = {name: job for name, job in plan_batches(config).items() if job["split"] == "test" or not only_test}
        if overwrite:
            files.remove_folder(partial, _is_batch_file)
        with files.saying_what_stays(lambda: _describe_finished(partial, jobs)):
            _render_missing(config, jobs, partial, workers, scheduler, progress)
            files.replace_folder(_assemble(config, partial, list(jobs)), folder, find_owner(folder))
        if not only_test:
            files.remove_folder(partial, _is_batch_file)
    return folder


def _is_rendered(config: RenderConfig, folder: Path, only_test: bool) -> bool:
    """Whether the images asked for are there; ValueError where another configuration's are."""
    if not (folder / "dataset.json").is_file():
        return False
    info = load_dataset(folder, "test").info
    _check_same_config(config, info["config"] | {"scenes": info["versions"].get("scenes", 1)}, folder)
    return only_test or "train" in info["images"]


def _check_places(folder: Path, partial: Path) -> None:
    """Refuse folders that hold anything of others' before an hour of rendering, not after it."""
    for place in (folder, partial):
        if place.exists() or place.is_symlink():
            files.check_ours(place, find_owner(place) if place == folder else _is_batch_file)


def _is_batch_file(path: Path) -> bool:
    """Whether a file of a folder of finished batches is ours: a batch, what is claimed, or a set being put together."""
    first, *rest = path.parts
    if rest:
        return (first == "dataset" or files.ASIDE.fullmatch(first) is not None) and is_member("/".join(rest))
    return any(pattern.fullmatch(first) for pattern in (BATCH, files.ASIDE))


def _describe_finished(partial: Path, jobs: dict[str, dict]) -> str:
    done = sum((partial / f"{name}.zip").is_file() for name in jobs)
    return f"rendering was stopped; {done} of {len(jobs)} batches are kept in {partial}: call again without overwrite"


def load_object(config: RenderConfig) -> PlanarObject | None:
    """What an object's file describes; None for the cloth and the rope, which need none."""
    path = find_root() / "data" / "objects" / f"{config.object}.json"
    return None if config.object in OBJECTS else load_planar_object(path)


def plan_batches(config: RenderConfig) -> dict[str, dict]:
    """The jobs of a data set by name; they depend on the configuration alone, never on who renders them."""
    jobs, planar, configuration = {}, load_object(config), _describe(config)
    described = None if planar is None else planar.to_dict()
    for split, images in zip(SPLITS, (config.train_images, config.test_images), strict=True):
        views = [min(config.views, images - start) for start in range(0, images, config.views)]
        batch = max(1, IMAGES_A_BATCH // config.views)
        for start in range(0, len(views), batch):
            episodes = [[start + i, n] for i, n in enumerate(views[start : start + batch])]
            job = {"config": to_dict(config), "split": split, "episodes": episodes, "sheet": described}
            job_hash = hashlib.sha256(json.dumps([configuration, split, episodes]).encode()).hexdigest()
            jobs[f"{split}_{start:06d}"] = {**job, "mark": job_hash}
    return jobs


def render_batch(job: dict) -> bytes:
    """Render one job in a child process and return its zip file; RenderError where the child fails."""
    with files.scratch_folder(Path(tempfile.gettempdir()), "mmgsd-batch") as folder:
        out = folder / "batch.zip"
        (data,) = run_job(job | {"out": str(out)}, folder, f"rendering {job['split']} {job['episodes']}", [out])
        return data


def run_job(job: dict, folder: Path, doing: str, outs: Sequence[Path]) -> list[bytes]:
    """What a child, which ends with this process, writes to ``outs``; RenderError says what it was ``doing``."""
    code, stderr = run_child(job | {"parent": os.getpid()}, folder)
    if code or not all(out.is_file() for out in outs):
        raise RenderError(f"{doing} {_describe_exit(code)}:\n{stderr[-2000:]}")
    return [out.read_bytes() for out in outs]


def run_child(job: dict, folder: Path) -> tuple[int, str]:
    """Exit code and stderr of a child that does ``job``, with ``folder`` for all its temporary files."""
    place = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)))  # an empty one is the cwd
    # as many children as cores, so one thread in each
    one = {"MMGSD_THREADS": "1", "OMP_NUM_THREADS": "1", "OIDN_NUM_THREADS": "1", "OIDN_SET_AFFINITY": "0"}
    env = {**one, **os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": path, "TMPDIR": str(folder)}
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    # a session of its own: Ctrl-C stops the parent, which ends its children, and none of them fails and is tried again
    command = [sys.executable, "-c", CHILD, place]
    with subprocess.Popen(command, env=env, text=True, start_new_session=True, **pipes) as child:
        _children.add(child)
        try:
            _, stderr = child.communicate(json.dumps(job))
        finally:
            _children.discard(child)
            child.kill()
    return child.returncode, stderr


def _describe_exit(code: int) -> str:
    """How a child ended, from its exit code."""
    if code >= 0:
        return "failed"
    name = signal.Signals(-code).name
    short = ": memory may be short, so try fewer workers" if -code == signal.SIGKILL else ""
    return f"failed: its process was ended by {name}{short}"


@contextlib.contextmanager
def connect(workers: int, scheduler: str) -> Iterator[Client]:
    """A client of the Dask cluster at ``scheduler``, or of one here with ``workers`` threads (0: one a core)."""
    if scheduler:
        with open_client(scheduler) as client:
            yield client
        return
    with open_threads(workers) as client:  # they only wait for the children
        try:
            yield client
        finally:
            for child in list(_children):
                child.kill()


def _render_missing(
    config: RenderConfig, jobs: dict, partial: Path, workers: int, scheduler: str, progress: bool
) -> None:
    """Render the jobs of which ``partial`` holds no whole batch; ValueError where it holds another configuration's."""
    files.is_kept(partial / "config.json", functools.partial(_check_claim, config))
    missing = {name: job for name, job in jobs.items()
               if not files.is_kept(partial / f"{name}.zip", functools.partial(_check_batch, job))}  # fmt: skip
    files.write_json(partial / "config.json", _describe(config))
    if missing:
        with connect(workers, scheduler) as client:
            _render_batches(client, missing, partial, config, progress)


def _render_batches(client: Client, jobs: dict, partial: Path, config: RenderConfig, progress: bool) -> None:
    total = sum(n for job in jobs.values() for _, n in job["episodes"])
    bar = ProgressBar(total=total, desc=f"render {config.object}", unit="image", disable=not progress)
    with bar, run_tasks(client, render_batch, jobs, retries=2) as results:
        for name, data in results:
            files.write_bytes(partial / f"{name}.zip", data)
            bar.update(sum(n for _, n in jobs[name]["episodes"]))


def _check_claim(config: RenderConfig, path: Path) -> bool:
    """ValueError where the batches beside a file are of another configuration; DamagedFileError where it names none."""
    stored = files.read_json(path)
    if not isinstance(stored, dict):
        raise files.DamagedFileError(f"{path} holds no configuration")
    _check_same_config(config, stored, path.parent)
    return True


def _check_batch(job: dict, path: Path) -> bool:
    """DamagedFileError where a file is not the whole batch of a job, whose hash it carries."""
    try:
        with zipfile.ZipFile(path) as batch:
            labels, job_hash = json.loads(batch.read("labels.json")), batch.comment.decode()
            whole = batch.testzip() is None and all(label.keys() >= LABELS for label in labels)
        whole = whole and len(labels) == sum(n for _, n in job["episodes"]) and job_hash == job["mark"]
    except UNREADABLE:
        whole = False
    if not whole:
        raise files.DamagedFileError(f"{path} is no whole batch of this data set")
    return True


def _check_same_config(config: RenderConfig, stored: dict, folder: Path) -> None:
    there, wanted = (list_later(RenderConfig) | values for values in (stored, _describe(config)))
    if there != wanted:
        changed = [f"{k}: {there.get(k)!r} there, {v!r} asked for" for k, v in wanted.items() if there.get(k) != v]
        raise ValueError(f"{folder} holds another data set ({'; '.join(changed)}): use overwrite=True to replace it")


def _describe(config: RenderConfig) -> dict:
    """All that decides the images."""
    return to_dict(config) | {"scenes": _name_scenes(config)}


def _name_scenes(config: RenderConfig) -> int | str:
    """Version of an object's scenes and of what is around it; of an object of the user's own, its file's digest too."""
    planar, around = load_object(config), "" if config.scene == "plain" else f"-{config.scene}{WORKSPACES}"
    if planar is None:
        return f"{SCENES[config.object]}{around}" if around else SCENES[config.object]
    return f"{SCENES['cloth']}{around}-{hashlib.sha256(json.dumps(planar.to_dict()).encode()).hexdigest()[:8]}"


def _describe_symmetry(config: RenderConfig) -> dict:
    """Image size, groups and mirror of the object, as dataset.json holds them."""
    planar = load_object(config)
    if planar is None:
        groups = {name: load_group(config.object, name).permutations for name in GROUPS[config.object]}
        default, mirror, size = DEFAULT_GROUP[config.object], load_mirror(config.object), config.size
    else:
        groups = {"identity": np.arange(len(planar.rest))[None], OWN_GROUP: planar.group.permutations}
        default, mirror, size = OWN_GROUP, planar.mirror, planar.size
    symmetry = {name: permutations.tolist() for name, permutations in groups.items()}
    mirror = None if mirror is None else mirror.tolist()
    return {"size": list(size), "default_group": default, "symmetry": symmetry, "mirror": mirror}


def _assemble(config: RenderConfig, partial: Path, names: list[str]) -> Path:
    """Unpack the batches of these names into a folder of the data set's format, dataset.json last."""
    folder = partial / "dataset"
    files.remove_folder(folder, lambda path: is_member(path.as_posix()))
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    rows = [row for name in names for row in _unpack(partial / f"{name}.zip", folder)]
    labels = pd.DataFrame(rows)
    table, digest = encode_table(labels)
    versions = {name: importlib.metadata.version(name) for name in ("bpy", "numpy", "pillow")}
    (folder / "labels.parquet").write_bytes(table)
    info = {
        "format": FORMAT,
        "object": config.object,
        "images": labels.split.value_counts().to_dict(),
        "config": to_dict(config),
        "versions": {"scenes": _name_scenes(config), **versions},
        **_describe_symmetry(config),
        "labels_sha256": digest,
    }
    (folder / "dataset.json").write_text(json.dumps(info))
    return folder


def _unpack(path: Path, folder: Path) -> Iterator[dict]:
    """Write a batch's files and yield its rows of labels; episodes of the test split are numbered after 1,000,000."""
    with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as batch:
        for label in json.loads(batch.read("labels.json")):
            split, stem = label["split"], f"{label['episode']:06d}_{label['view']:02d}"
            names = {"file": f"images/{split}_{stem}.webp", "mask": f"masks/{split}_{stem}.png"}
            (folder / names["file"]).write_bytes(batch.read(f"{stem}.webp"))
            (folder / names["mask"]).write_bytes(batch.read(f"{stem}_mask.png"))
            flat = {key: [v for row in label.pop(key) for v in row] for key in ("xy", "intrinsics", "camera_pose")}
            flat["xy"] = np.float32(flat["xy"])
            label["episode"] += 1_000_000 * (split == "test")
            yield {**names, **flat, **label.pop("info"), **label}
