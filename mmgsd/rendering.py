"""The rendering stage: episodes are independent tasks on Dask, each in a child process of its own.

bpy is imported in these children only (``python -m mmgsd.scene``): a crash, a leak or a killed worker costs one batch.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from dask.distributed import Client, LocalCluster, as_completed
from tqdm.auto import tqdm

from mmgsd.config import ADDED, DEFAULT_GROUP, OBJECTS, OWN_GROUP, RenderConfig, drop_added, find_root, to_dict
from mmgsd.dataset import FORMAT, SPLITS, load_dataset
from mmgsd.sheet import Sheet, load_sheet
from mmgsd.symmetry import GRID_GROUPS, LINE_GROUPS, load_group, load_mirror

IMAGES_A_BATCH = 30  # a child process ends after about so many, which bounds its memory
SCENES = {"cloth": 2, "rope": 1}  # to be raised where the same configuration gives another object than before
WORKSPACES = 1  # likewise of what is seen around the object in the scene "workspace"
GROUPS = {"cloth": GRID_GROUPS, "rope": LINE_GROUPS}


class RenderError(RuntimeError):
    """Blender failed in a child process; the message ends with what it said."""


def render_dataset(
    config: RenderConfig, folder: Path, *,
    only_test: bool = False, workers: int = 0, scheduler: str = "", overwrite: bool = False, progress: bool = True,
) -> Path:  # fmt: skip
    """Render the data set of ``config`` into ``folder`` and return it; a finished one is returned as it is.

    ``only_test`` leaves out the training images: enough to evaluate models. A later call without it renders the rest.

    ``workers`` processes on this machine (0: one a core), or the ``scheduler`` of an existing Dask cluster by its
    address. Finished batches of a killed call are kept. ValueError where the folder holds another configuration.

    Objects other than ``cloth`` and ``rope`` are read from ``data/objects/<name>.json`` (`mmgsd.sheet`).
    """
    if (folder / "dataset.json").is_file() and not overwrite:
        info = load_dataset(folder, "test").info
        _check_same_config(config, info["config"] | {"scenes": info["versions"].get("scenes", 1)}, folder)
        if only_test or "train" in info["images"]:
            return folder
    partial = folder.with_name(folder.name + ".partial")
    if overwrite:
        shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True, exist_ok=True)
    _claim(config, partial)
    jobs = {name: job for name, job in plan_batches(config).items() if job["split"] == "test" or not only_test}
    missing = {name: job for name, job in jobs.items() if not (partial / f"{name}.zip").is_file()}
    if missing:
        with _connect(workers, scheduler) as client:
            _render_batches(client, missing, partial, config, progress)
    finished = _assemble(config, partial, list(jobs))
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(finished, folder)
    if not only_test:
        shutil.rmtree(partial)
    return folder


def load_object(config: RenderConfig) -> Sheet | None:
    """The sheet that an object's file describes; None for the cloth and the rope, which need none."""
    return None if config.object in OBJECTS else load_sheet(find_root() / "data" / "objects" / f"{config.object}.json")


def plan_batches(config: RenderConfig) -> dict[str, dict]:
    """The jobs of a data set by name; they depend on the configuration alone, never on who renders them."""
    jobs, sheet = {}, load_object(config)
    described = None if sheet is None else sheet.to_dict()
    for split, images in zip(SPLITS, (config.train_images, config.test_images), strict=True):
        views = [min(config.views, images - start) for start in range(0, images, config.views)]
        batch = max(1, IMAGES_A_BATCH // config.views)
        for start in range(0, len(views), batch):
            episodes = [[start + i, n] for i, n in enumerate(views[start : start + batch])]
            job = {"config": to_dict(config), "split": split, "episodes": episodes, "sheet": described}
            jobs[f"{split}_{start:06d}"] = job
    return jobs


def render_batch(job: dict) -> bytes:
    """Render one job in a child process and return its zip file; RenderError where the child fails."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "batch.zip"
        path = os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")])
        # as many children as cores, so one thread in each
        one = {"MMGSD_THREADS": "1", "OMP_NUM_THREADS": "1", "OIDN_NUM_THREADS": "1", "OIDN_SET_AFFINITY": "0"}
        env = {**one, **os.environ, "PYTHONPATH": path}
        text = json.dumps({**job, "out": str(out)})
        command = [sys.executable, "-m", "mmgsd.scene"]
        done = subprocess.run(command, input=text, env=env, capture_output=True, text=True)
        if done.returncode or not out.is_file():
            raise RenderError(f"rendering {job['split']} {job['episodes']} failed:\n{done.stderr[-2000:]}")
        return out.read_bytes()


@contextlib.contextmanager
def _connect(workers: int, scheduler: str) -> Iterator[Client]:
    if scheduler:
        with Client(scheduler) as client:
            yield client
        return
    threads = workers or os.cpu_count()  # they only wait for the children
    with _unchanged_environment(), LocalCluster(
        n_workers=1, threads_per_worker=threads, processes=False, dashboard_address="127.0.0.1:0", silence_logs="ERROR",
    ) as local, Client(local) as client:  # fmt: skip
        yield client


@contextlib.contextmanager
def _unchanged_environment() -> Iterator[None]:
    """Dask sets OMP_NUM_THREADS=1 and more in this process for good: a training later on would get a single thread."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _render_batches(client: Client, jobs: dict, partial: Path, config: RenderConfig, progress: bool) -> None:
    futures = {client.submit(render_batch, job, pure=False, retries=2): name for name, job in jobs.items()}
    total = sum(n for job in jobs.values() for _, n in job["episodes"])
    with tqdm(total=total, desc=f"render {config.object}", unit="image", disable=not progress) as bar:
        for future in as_completed(futures):
            name = futures.pop(future)
            aside = partial / f"{name}.tmp"
            aside.write_bytes(future.result())
            os.replace(aside, partial / f"{name}.zip")
            bar.update(sum(n for _, n in jobs[name]["episodes"]))


def _check_same_config(config: RenderConfig, stored: dict, folder: Path) -> None:
    asked, stored = _describe(config), drop_added(stored)
    if stored != asked:
        there, wanted = ADDED | stored, ADDED | asked
        changed = [f"{k}: {there.get(k)!r} there, {v!r} asked for" for k, v in wanted.items() if there.get(k) != v]
        raise ValueError(f"{folder} holds another data set ({'; '.join(changed)}): use overwrite=True to replace it")


def _describe(config: RenderConfig) -> dict:
    """All that decides the images."""
    return to_dict(config) | {"scenes": _name_scenes(config)}


def _name_scenes(config: RenderConfig) -> int | str:
    """Version of the object's scenes; of an object of the user's own, with the digest of what its file describes.

    Of another scene than the plain one, with its name and version.
    """
    sheet, around = load_object(config), "" if config.scene == "plain" else f"-{config.scene}{WORKSPACES}"
    if sheet is None:
        return f"{SCENES[config.object]}{around}" if around else SCENES[config.object]
    return f"{SCENES['cloth']}{around}-{hashlib.sha256(json.dumps(sheet.to_dict()).encode()).hexdigest()[:8]}"


def _describe_symmetry(config: RenderConfig) -> dict:
    """Image size, groups and mirror of the object, as dataset.json holds them."""
    sheet = load_object(config)
    if sheet is None:
        groups = {name: load_group(config.object, name).permutations for name in GROUPS[config.object]}
        default, mirror, size = DEFAULT_GROUP[config.object], load_mirror(config.object), config.size
    else:
        groups = {"identity": np.arange(len(sheet.rest))[None], OWN_GROUP: sheet.group.permutations}
        default, mirror, size = OWN_GROUP, sheet.mirror, sheet.size
    symmetry = {name: permutations.tolist() for name, permutations in groups.items()}
    mirror = None if mirror is None else mirror.tolist()
    return {"size": list(size), "default_group": default, "symmetry": symmetry, "mirror": mirror}


def _claim(config: RenderConfig, partial: Path) -> None:
    path = partial / "config.json"
    if path.is_file():
        _check_same_config(config, json.loads(path.read_text()), partial)
    aside = path.with_suffix(".tmp")
    aside.write_text(json.dumps(_describe(config)))
    os.replace(aside, path)


def _assemble(config: RenderConfig, partial: Path, names: list[str]) -> Path:
    """Unpack the batches of these names into a folder of the data set's format, dataset.json last."""
    folder = partial / "dataset"
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    rows = [row for name in names for row in _unpack(partial / f"{name}.zip", folder)]
    labels = pd.DataFrame(rows)
    labels.to_parquet(folder / "labels.parquet", index=False)
    info = {
        "format": FORMAT,
        "object": config.object,
        "images": labels.split.value_counts().to_dict(),
        "config": to_dict(config),
        "versions": {"scenes": _name_scenes(config), **_list_versions()},
        **_describe_symmetry(config),
    }
    (folder / "dataset.json").write_text(json.dumps(info))
    return folder


def _list_versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in ("bpy", "numpy", "pillow")}


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
