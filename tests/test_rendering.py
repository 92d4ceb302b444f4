"""The rendering stage: planned by configuration alone, resumed after a kill, never mixed with another configuration."""

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from dask.distributed import LocalCluster

from mmgsd import rendering
from mmgsd.config import RenderConfig
from mmgsd.dataset import check_dataset, load_dataset
from mmgsd.files import write_json
from mmgsd.rendering import RenderError, plan_batches, render_batch, render_dataset

CONFIG = RenderConfig(object="rope", train_images=3, test_images=2, views=1, samples=1, seed=5)
# without a main guard: a plain script may render
SCRIPT = """
import sys
from pathlib import Path
from mmgsd import rendering
from mmgsd.config import RenderConfig
rendering.IMAGES_A_BATCH = 1
config = RenderConfig(object="rope", train_images=3, test_images=2, views=1, samples=1, seed=5)
how = {"workers": int(sys.argv[2]), "scheduler": sys.argv[3]}
rendering.render_dataset(config, Path(sys.argv[1]), progress=False, **how)
"""


def start(folder: Path, workers: int, scheduler: str = "") -> subprocess.Popen:
    script = folder.parent / "render.py"
    script.write_text(SCRIPT)
    path = str(Path(rendering.__file__).resolve().parents[1])
    env = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, str(script), str(folder), str(workers), scheduler]
    return subprocess.Popen(command, env=env, start_new_session=True)


def read_tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_every_image_is_planned_once_and_splits_share_no_simulation() -> None:
    config = RenderConfig(train_images=93, test_images=21, views=10)
    jobs = plan_batches(config)
    for split, images in (("train", 93), ("test", 21)):
        episodes = [e for job in jobs.values() if job["split"] == split for e in job["episodes"]]
        assert sum(n for _, n in episodes) == images
        assert [e for e, _ in episodes] == list(range(len(episodes)))


def test_a_killed_rendering_goes_on_and_ends_with_the_same_bytes(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start(whole, 2).wait(300) == 0
    process = start(killed, 1)
    partial = tmp_path / "killed.partial"
    deadline = time.monotonic() + 120
    while not list(partial.glob("*.zip")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path.name: path.stat().st_mtime_ns for path in partial.glob("*.zip")}
    assert kept and not killed.exists()
    assert start(killed, 1).wait(300) == 0
    assert read_tree(whole) == read_tree(killed)
    assert check_dataset(killed).images.to_list() == [3, 2]
    with pytest.raises(ValueError, match="seed: 5 there, 6 asked for"):
        render_dataset(dataclasses.replace(CONFIG, seed=6), killed)


def test_test_images_alone_are_those_of_the_whole_data_set_and_the_rest_can_follow(tmp_path: Path) -> None:
    whole, folder = (tmp_path / name for name in ("whole", "alone"))
    render_dataset(CONFIG, whole, progress=False)
    assert render_dataset(CONFIG, folder, only_test=True, progress=False) == folder
    assert check_dataset(folder).images.to_dict() == {"test": 2}
    alone, all_of_them = load_dataset(folder, "test"), load_dataset(whole, "test")
    assert alone.fingerprint == all_of_them.fingerprint
    assert all((folder / name).read_bytes() == (whole / name).read_bytes() for name in all_of_them.labels.file)
    with pytest.raises(ValueError, match="alone has no train images"):
        load_dataset(folder, "train")
    render_dataset(CONFIG, folder, progress=False)
    assert read_tree(folder) == read_tree(whole)
    assert render_dataset(CONFIG, folder, only_test=True, progress=False) == folder
    assert len(load_dataset(folder, "train")) == 3 and not (tmp_path / "alone.partial").exists()


def test_a_lost_worker_of_a_foreign_cluster_costs_nothing_but_time(tmp_path: Path) -> None:
    """The scheduler is given by its address; one of its workers is killed while it renders."""
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert start(undisturbed, 1).wait(300) == 0
    how = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with rendering._unchanged_environment(), LocalCluster(n_workers=2, threads_per_worker=1, **how) as cluster:
        first = {worker.pid for worker in cluster.workers.values()}
        process = start(disturbed, 0, cluster.scheduler_address)
        killed = wait_for_rendering_worker(first)
        os.kill(killed, signal.SIGKILL)
        assert process.wait(300) == 0
        assert killed not in {worker.pid for worker in cluster.workers.values()}
    assert read_tree(undisturbed) == read_tree(disturbed)


def test_rendering_leaves_the_environment_as_it_was(tmp_path: Path) -> None:
    before = dict(os.environ)
    render_dataset(dataclasses.replace(CONFIG, train_images=1, test_images=1), tmp_path / "rope", progress=False)
    assert dict(os.environ) == before


def wait_for_rendering_worker(pids: set[int]) -> int:
    """The first of the worker processes that has a Blender child."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        for pid in pids:
            with contextlib.suppress(psutil.NoSuchProcess):  # a child may end while it is looked at
                if any("mmgsd.scene" in " ".join(child.cmdline()) for child in psutil.Process(pid).children()):
                    return pid
        time.sleep(0.02)
    raise AssertionError("no worker began to render")


def test_a_folder_begun_with_another_configuration_is_not_mixed(tmp_path: Path) -> None:
    partial = tmp_path / "rope.partial"
    write_json(partial / "config.json", rendering._describe(CONFIG))
    with pytest.raises(ValueError, match="samples: 1 there, 2 asked for"):
        render_dataset(dataclasses.replace(CONFIG, samples=2), tmp_path / "rope", progress=False)


def test_a_failing_child_says_why() -> None:
    job = next(iter(plan_batches(CONFIG).values()))
    with pytest.raises(RenderError, match="split must be one of"):
        render_batch({**job, "split": "validation"})


def test_images_of_an_older_kind_of_cloth_are_not_taken_for_todays(tiny_dataset: Callable[..., Path]) -> None:
    config, folder = RenderConfig(object="cloth"), tiny_dataset(object="cloth")
    info = json.loads((folder / "dataset.json").read_text()) | {"config": dataclasses.asdict(config)}
    (folder / "dataset.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=r"scenes: 1 there, \d+ asked for.*overwrite=True"):
        render_dataset(config, folder)
    info["versions"]["scenes"] = rendering.SCENES["cloth"]
    (folder / "dataset.json").write_text(json.dumps(info))
    assert render_dataset(config, folder) == folder


def test_an_object_without_a_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"objects/sock\.json does not exist"):
        render_dataset(dataclasses.replace(CONFIG, object="sock"), tmp_path / "sock", progress=False)


def test_a_changed_object_is_another_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    file = tmp_path / "data" / "objects" / "sheet.json"
    file.parent.mkdir(parents=True)
    file.write_text('{"outline": [[0, 0], [4, 0], [4, 2], [0, 2]], "symmetry": "turns"}')
    config, folder = RenderConfig(object="sheet", train_images=1, test_images=1, views=1), tmp_path / "sheet"
    data = load_dataset(render_dataset(config, folder, progress=False))
    assert (data.group().order, data.n_points) == (2, len(data.group().permutations[0]))
    assert render_dataset(config, folder, progress=False) == folder
    file.write_text('{"outline": [[0, 0], [4, 0], [4, 3], [0, 3]], "symmetry": "turns"}')
    with pytest.raises(ValueError, match="scenes: .* there, .* asked for"):
        render_dataset(config, folder, progress=False)
