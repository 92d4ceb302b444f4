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
from typing import Any

import psutil
import pytest
from batches import run_child
from dask.distributed import LocalCluster

from mmgsd.cluster import unchanged_environment
from mmgsd.config import RenderConfig
from mmgsd.dataset import check_dataset, load_dataset
from mmgsd.files import ForeignFileError, LockedError, locked, scratch_folder, write_json
from mmgsd.scene import stage
from mmgsd.scene.stage import RenderError, plan_batches, render_batch, render_dataset

CONFIG = RenderConfig(object="rope", train_images=3, test_images=2, views=1, samples=1, seed=5)
FEW = dataclasses.replace(CONFIG, train_images=1, test_images=1)  # of what Blender renders here
# without a main guard: a plain script may render
SCRIPT = """
import sys
from pathlib import Path
from mmgsd.scene import stage
from mmgsd.config import RenderConfig
stage.IMAGES_A_BATCH = 1
config = RenderConfig(object="rope", train_images=1, test_images=1, views=1, samples=1, seed=5)
how = {"workers": int(sys.argv[2]), "scheduler": sys.argv[3]}
stage.render_dataset(config, Path(sys.argv[1]), progress=False, **how)
"""


def start(folder: Path, workers: int, scheduler: str = "", temporary: Path | None = None) -> subprocess.Popen:
    script = folder.parent / "render.py"
    script.write_text(SCRIPT)
    path = str(Path(stage.__file__).resolve().parents[2])
    env = {**os.environ, "PYTHONPATH": path, **({"TMPDIR": str(temporary)} if temporary else {})}
    command = [sys.executable, str(script), str(folder), str(workers), scheduler]
    return subprocess.Popen(command, env=env, start_new_session=True)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `FEW` gives where nothing happens, for all tests to compare with: read it only."""
    folder = tmp_path_factory.mktemp("stage") / "undisturbed"
    assert start(folder, 2).wait(300) == 0
    return folder


def read_tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def wait_for(look: Callable[[], Any]) -> Any:
    """The first of what is looked for that is there."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if found := look():
            return found
        time.sleep(0.02)
    raise AssertionError("nothing came for two minutes")


def test_every_image_is_planned_once_and_splits_share_no_simulation() -> None:
    config = RenderConfig(train_images=93, test_images=21, views=10)
    jobs = plan_batches(config)
    for split, images in (("train", 93), ("test", 21)):
        episodes = [e for job in jobs.values() if job["split"] == split for e in job["episodes"]]
        assert sum(n for _, n in episodes) == images
        assert [e for e, _ in episodes] == list(range(len(episodes)))


def test_a_killed_rendering_goes_on_and_ends_with_the_same_bytes(undisturbed: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    process = start(killed, 1)
    partial = tmp_path / "killed.partial"
    wait_for(lambda: list(partial.glob("*.zip")))
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path.name: path.stat().st_mtime_ns for path in partial.glob("*.zip")}
    assert kept and not killed.exists()
    assert start(killed, 1).wait(300) == 0
    assert read_tree(undisturbed) == read_tree(killed)
    assert check_dataset(killed).images.to_list() == [1, 1]
    with pytest.raises(ValueError, match="seed: 5 there, 6 asked for"):
        render_dataset(dataclasses.replace(FEW, seed=6), killed)


def test_test_images_alone_are_those_of_the_whole_set_and_the_rest_can_follow(
    undisturbed: Path, tmp_path: Path
) -> None:
    whole, folder = undisturbed, tmp_path / "alone"
    assert render_dataset(FEW, folder, only_test=True, progress=False) == folder
    assert check_dataset(folder).images.to_dict() == {"test": 1}
    alone, all_of_them = load_dataset(folder, "test"), load_dataset(whole, "test")
    assert alone.fingerprint == all_of_them.fingerprint
    assert all((folder / name).read_bytes() == (whole / name).read_bytes() for name in all_of_them.labels.file)
    with pytest.raises(ValueError, match="alone has no train images"):
        load_dataset(folder, "train")
    render_dataset(FEW, folder, progress=False)
    assert read_tree(folder) == read_tree(whole)
    assert render_dataset(FEW, folder, only_test=True, progress=False) == folder
    assert len(load_dataset(folder, "train")) == 1 and not (tmp_path / "alone.partial").exists()


def test_a_lost_worker_of_a_foreign_cluster_costs_nothing_but_time(undisturbed: Path, tmp_path: Path) -> None:
    """The scheduler is given by its address; one of its workers is killed while it renders."""
    disturbed = tmp_path / "disturbed"
    how = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with unchanged_environment(), LocalCluster(n_workers=2, threads_per_worker=1, **how) as cluster:
        first = {worker.pid for worker in cluster.workers.values()}
        process = start(disturbed, 0, cluster.scheduler_address)
        killed = wait_for(lambda: next((pid for pid in first if list_blenders(pid)), None))
        os.kill(killed, signal.SIGKILL)
        assert process.wait(300) == 0
        assert killed not in {worker.pid for worker in cluster.workers.values()}
    assert read_tree(undisturbed) == read_tree(disturbed)


def test_rendering_leaves_the_environment_as_it_was(drawn: list[str], tmp_path: Path) -> None:
    before = dict(os.environ)
    render(tmp_path / "rope")
    assert dict(os.environ) == before


def list_blenders(pid: int) -> list[psutil.Process]:
    """What renders of a process's children and theirs, of which any may end while it is looked at."""
    found = []
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in psutil.Process(pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                found += [child] if stage.CHILD in child.cmdline() else []
    return found


def test_a_folder_begun_with_another_configuration_is_not_mixed(tmp_path: Path) -> None:
    partial = tmp_path / "rope.partial"
    write_json(partial / "config.json", stage._describe(CONFIG))
    with pytest.raises(ValueError, match="samples: 1 there, 2 asked for"):
        render_dataset(dataclasses.replace(CONFIG, samples=2), tmp_path / "rope", progress=False)


def test_a_failing_child_says_why() -> None:
    job = next(iter(plan_batches(CONFIG).values()))
    with pytest.raises(RenderError, match="split must be one of"):
        render_batch({**job, "split": "validation"})


def test_modules_of_the_working_directory_are_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("bpy", "json", "runpy", "mmgsd"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not mine')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep)  # twice the working directory
    job = {"config": {"samples": 0}, "split": "test", "episodes": [], "out": "a.zip"}
    code, said = stage.run_child(job, tmp_path)
    assert code == 1 and "samples must be" in said


def test_images_of_an_older_kind_of_cloth_are_not_taken_for_todays(tiny_dataset: Callable[..., Path]) -> None:
    config, folder = RenderConfig(object="cloth"), tiny_dataset(object="cloth")
    info = json.loads((folder / "dataset.json").read_text()) | {"config": dataclasses.asdict(config)}
    (folder / "dataset.json").write_text(json.dumps(info))
    with pytest.raises(ValueError, match=r"scenes: 1 there, \d+ asked for.*overwrite=True"):
        render_dataset(config, folder)
    info["versions"]["scenes"] = stage.SCENES["cloth"]
    (folder / "dataset.json").write_text(json.dumps(info))
    assert render_dataset(config, folder) == folder


def test_a_workspace_is_another_data_set_and_a_plain_one_is_described_as_ever(tmp_path: Path) -> None:
    assert stage._describe(CONFIG) == {
        "object": "rope", "train_images": 3, "test_images": 2, "views": 1, "samples": 1, "rotation_deg": 180.0,
        "ball": False, "seed": 5, "scenes": 1,
    }  # fmt: skip
    claim = write_json(tmp_path / "config.json", stage._describe(CONFIG))
    assert stage._check_claim(CONFIG, claim)
    with pytest.raises(ValueError, match="scene: 'plain' there, 'workspace' asked for"):
        stage._check_claim(dataclasses.replace(CONFIG, scene="workspace"), claim)


def test_an_object_without_a_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"objects/sock\.json does not exist"):
        render_dataset(dataclasses.replace(CONFIG, object="sock"), tmp_path / "sock", progress=False)


def test_a_changed_object_is_another_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    file = tmp_path / "data" / "objects" / "sheet.json"
    file.parent.mkdir(parents=True)
    file.write_text('{"outline": [[0, 0], [4, 0], [4, 2], [0, 2]], "symmetry": "turns"}')
    config, folder = RenderConfig(object="sheet", train_images=1, test_images=1, views=1), tmp_path / "sheet"
    data = load_dataset(render_dataset(config, folder, only_test=True, progress=False), "test")
    assert (data.group().order, data.n_points) == (2, len(data.group().permutations[0]))
    assert render_dataset(config, folder, only_test=True, progress=False) == folder
    file.write_text('{"outline": [[0, 0], [4, 0], [4, 3], [0, 3]], "symmetry": "turns"}')
    with pytest.raises(ValueError, match="scenes: .* there, .* asked for"):
        render_dataset(config, folder, progress=False)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Batches are drawn in milliseconds, without Blender; the list names the jobs' splits in turn."""
    asked: list[str] = []
    monkeypatch.setattr(stage, "IMAGES_A_BATCH", 1)

    def draw(job: dict, folder: Path) -> tuple[int, str]:
        asked.append(job["split"])
        return run_child(job, folder)

    monkeypatch.setattr(stage, "run_child", draw)
    return asked


def render(folder: Path, **how: object) -> Path:
    return render_dataset(CONFIG, folder, progress=False, workers=1, **how)


@pytest.mark.parametrize("name", ["only_test", "overwrite", "progress", "workers", "scheduler"])
def test_options_are_read_before_anything_is_touched(drawn: list[str], tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be .*got -1"):
        render_dataset(CONFIG, tmp_path / "rope", **{name: -1})
    assert not list(tmp_path.iterdir())


def test_a_notebooks_false_is_false(drawn: list[str], tmp_path: Path) -> None:
    before = read_tree(render(tmp_path / "rope"))
    drawn.clear()
    render(tmp_path / "rope", overwrite="false")
    assert not drawn and read_tree(tmp_path / "rope") == before


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["images/holiday.webp", "thesis.odt", "deeper/labels.parquet"])
def test_a_folder_of_others_is_left_as_it_is(drawn: list[str], tmp_path: Path, name: str, overwrite: bool) -> None:
    (tmp_path / "rope" / name).parent.mkdir(parents=True)
    (tmp_path / "rope" / name).write_text("mine")
    with pytest.raises(ForeignFileError, match="rope.* is (not empty|none)"):
        render(tmp_path / "rope", overwrite=overwrite)
    assert read_tree(tmp_path) == {f"rope/{name}": b"mine"} and not drawn


def test_a_foreign_file_among_the_images_keeps_a_set_from_being_replaced(drawn: list[str], tmp_path: Path) -> None:
    before = read_tree(render(tmp_path / "rope"))
    (tmp_path / "rope" / "images" / "holiday.webp").write_text("mine")
    with pytest.raises(ForeignFileError, match="holiday.webp was not written"):
        render(tmp_path / "rope", overwrite=True)
    assert read_tree(tmp_path / "rope") == {**before, "images/holiday.webp": b"mine"}
    (tmp_path / "rope" / "images" / "holiday.webp").unlink()
    render(tmp_path / "rope", overwrite=True)
    assert read_tree(tmp_path / "rope") == before and os.listdir(tmp_path) == ["rope"]


def test_foreign_files_beside_the_batches_are_named(drawn: list[str], tmp_path: Path) -> None:
    (tmp_path / "rope.partial").mkdir()
    (tmp_path / "rope.partial" / "notes.txt").write_text("mine")
    with pytest.raises(ForeignFileError, match="notes.txt was not written"):
        render(tmp_path / "rope", overwrite=True)


def test_a_folder_in_use_is_refused_and_a_finished_one_can_be_read(drawn: list[str], tmp_path: Path) -> None:
    with locked(tmp_path / "rope", "rendering"), pytest.raises(LockedError, match=f"in use by process {os.getpid()}"):
        render(tmp_path / "rope")
    render(tmp_path / "rope")
    with locked(tmp_path / "rope", "rendering"):
        assert len(load_dataset(render(tmp_path / "rope"))) == 3


@pytest.mark.parametrize("damage", [
    lambda data: b"", lambda data: data[:-40], lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:],
    lambda data: b"no zip", lambda data: data[:-5] + b"other",
])  # fmt: skip
def test_a_damaged_batch_is_rendered_again_and_the_others_are_kept(
    drawn: list[str], tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    whole = read_tree(render(tmp_path / "whole"))
    render(tmp_path / "rope", only_test=True)
    drawn.clear()
    batch = tmp_path / "rope.partial" / "test_000001.zip"
    batch.write_bytes(damage(batch.read_bytes()))
    with pytest.warns(UserWarning, match="test_000001.zip is damaged"):
        render(tmp_path / "rope")
    assert sorted(drawn) == ["test", "train", "train", "train"]
    assert read_tree(tmp_path / "rope") == whole


@pytest.mark.parametrize("claim", [b"", b"{", b"[]", b"\xff"])
def test_batches_are_known_again_by_their_marks_where_the_claim_is_damaged(
    drawn: list[str], tmp_path: Path, claim: bytes
) -> None:
    render(tmp_path / "rope", only_test=True)
    (tmp_path / "rope.partial" / "config.json").write_bytes(claim)
    drawn.clear()
    with pytest.warns(UserWarning, match="config.json is damaged"):
        render(tmp_path / "rope")
    assert drawn == ["train"] * 3


def test_a_killed_child_is_said_to_be_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "run_child", lambda job, folder: (-signal.SIGKILL, ""))
    with pytest.raises(RenderError, match="ended by SIGKILL: memory may be short, so try fewer workers"):
        render_batch(next(iter(plan_batches(CONFIG).values())))


def test_stopping_says_what_is_kept_and_the_next_call_goes_on(
    drawn: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr(stage, "_assemble", stop)
    with pytest.raises(KeyboardInterrupt, match="5 of 5 batches are kept in .*rope.partial"):
        render(tmp_path / "rope")
    monkeypatch.undo()
    monkeypatch.setattr(stage, "IMAGES_A_BATCH", 1)
    assert len(load_dataset(render(tmp_path / "rope"))) == 3 and len(drawn) == 5


def test_nothing_listens_beyond_this_machine_while_it_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listening: set[str] = set()

    def look(job: dict, folder: Path) -> tuple[int, str]:
        there = psutil.Process().net_connections("inet")
        listening.update(c.laddr.ip for c in there if c.status == psutil.CONN_LISTEN)
        return run_child(job, folder)

    monkeypatch.setattr(stage, "run_child", look)
    render(tmp_path / "rope")
    assert listening <= {"127.0.0.1", "::1"}


def test_children_and_their_temporary_folders_go_with_a_killed_parent(tmp_path: Path) -> None:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    process = start(tmp_path / "rope", 1, temporary=temporary)
    children = wait_for(lambda: list_blenders(process.pid))
    time.sleep(1)  # past its first imports
    process.kill()
    process.wait()
    gone, alive = psutil.wait_procs(children, timeout=20)
    assert gone and not alive
    assert [path.name for path in temporary.glob(".mmgsd-batch*")]
    with scratch_folder(temporary, "mmgsd-batch"):
        assert len(list(temporary.glob(".mmgsd-batch*"))) == 1
