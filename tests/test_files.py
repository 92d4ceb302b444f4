import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mmgsd import files


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = files.write_text(tmp_path / "a" / "b.txt", "first")
    with pytest.raises(RuntimeError, match="in the middle"), files.writing(path) as aside:
        aside.write_text("sec")
        raise RuntimeError("in the middle")
    assert path.read_text() == "first"
    assert os.listdir(path.parent) == ["b.txt"]


def test_what_a_killed_process_left_is_removed_by_the_next_write_and_a_living_ones_is_not(tmp_path):
    target = tmp_path / "x.json"
    code = f"from mmgsd import files; from pathlib import Path; print(files.name_aside(Path({str(target)!r})))"
    left = Path(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip())
    living, others = files.name_aside(target), files.name_aside(tmp_path / "y.json")
    for path in (left, living, others):
        path.write_text("part")
    files.write_json(target, {"a": 1})
    assert not left.exists() and living.exists() and others.exists()
    assert files.read_json(target) == {"a": 1}


def test_a_full_disk_names_the_path(tmp_path):
    def fill() -> None:
        with files.writing(tmp_path / "big.bin"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left on device while writing .*big.bin") as caught:
        fill()
    assert caught.value.errno == errno.ENOSPC


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe", b"[1, 2"])
def test_damaged_json_names_the_file(tmp_path, data):
    (tmp_path / "a.json").write_bytes(data)
    with pytest.raises(files.DamagedFileError, match="a.json is damaged or no JSON .*: make it again"):
        files.read_json(tmp_path / "a.json", remedy="make it again")


def test_json_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert files.read_json(tmp_path / "a.json") == {"a": 1}


def test_a_folder_with_a_foreign_file_is_left_as_it_is(tmp_path):
    folder = tmp_path / "set"
    for name in ("ours.png", "thesis.odt"):
        files.write_text(folder / name, name)
    with pytest.raises(files.ForeignFileError, match="thesis.odt is none of this project's files"):
        files.remove_folder(folder, lambda path: path.suffix == ".png")
    assert sorted(os.listdir(folder)) == ["ours.png", "thesis.odt"]
    files.remove_folder(folder, lambda path: True)
    assert not folder.exists() and os.listdir(tmp_path) == []


def test_a_link_is_never_followed_to_be_removed(tmp_path):
    files.write_text(tmp_path / "real" / "a.png", "a")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with pytest.raises(files.ForeignFileError, match="is a link"):
        files.remove_folder(tmp_path / "link", lambda path: True)
    assert (tmp_path / "real" / "a.png").exists()


def test_a_folder_takes_the_place_of_another(tmp_path):
    files.write_text(tmp_path / "new" / "a.png", "new")
    files.write_text(tmp_path / "old" / "a.png", "old")
    files.replace_folder(tmp_path / "new", tmp_path / "old", lambda path: True)
    assert (tmp_path / "old" / "a.png").read_text() == "new"
    assert os.listdir(tmp_path) == ["old"]


def test_a_lock_names_the_process_that_holds_it_and_ends_with_it(tmp_path):
    folder = tmp_path / "set"
    code = (f"import time; from mmgsd import files; from pathlib import Path\n"
            f"with files.locked(Path({str(folder)!r}), 'rendering'):\n"
            " print('held', flush=True); time.sleep(60)")  # fmt: skip
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "held\n"
    with (
        pytest.raises(files.LockedError, match=rf"set is in use by process {other.pid} on .*, rendering since"),
        files.locked(folder, "training"),
    ):
        pass
    other.kill()
    other.wait()
    with files.locked(folder, "training"):
        assert f"process {os.getpid()}" in (tmp_path / ".set.lock").read_text()


def test_no_process_is_signalled_where_signal_0_is_ctrl_c(monkeypatch):
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("sends Ctrl-C on Windows"))
    monkeypatch.setattr(os, "name", "nt")
    assert files._is_running("", 1)
