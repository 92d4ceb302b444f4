import errno
import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mmgsd import files


def raising(number):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    return fail


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = files.write_text(tmp_path / "a" / "b.txt", "first")
    with pytest.raises(RuntimeError, match="in the middle"), files.atomic_write(path) as aside:
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


@pytest.mark.parametrize("begin", ["first", None])
def test_a_link_stays_and_what_it_leads_to_is_written(tmp_path, begin):
    real, link = tmp_path / "real" / "a.txt", tmp_path / "link.txt"
    real.parent.mkdir()
    (tmp_path / "middle").symlink_to(real)
    link.symlink_to("middle")
    if begin:
        real.write_text(begin)
    files.write_text(link, "second")
    assert link.is_symlink() and (tmp_path / "middle").is_symlink() and real.read_text() == "second"
    assert os.listdir(real.parent) == ["a.txt"]


def test_what_cannot_be_written_is_said_before_the_work_and_stays(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    for name in ("folder", "loop"):
        with pytest.raises(OSError, match=name), files.atomic_write(tmp_path / name):
            pytest.fail("the work is done for nothing")
    assert sorted(os.listdir(tmp_path)) == ["folder", "loop"] and (tmp_path / "loop").is_symlink()


def test_a_reader_of_a_pipe_gets_the_whole_file(tmp_path):
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()), daemon=True)
    reader.start()
    files.write_text(pipe, "answer")
    reader.join(10)
    assert got == [b"answer"] and stat.S_ISFIFO(os.stat(pipe).st_mode) and os.listdir(tmp_path) == ["pipe"]


def test_a_device_stays_one(tmp_path):
    device = tmp_path / "null"
    try:
        os.mknod(device, 0o600 | stat.S_IFCHR, os.makedev(1, 3))
        device.write_text("")
    except OSError as error:
        pytest.skip(f"no device may be made here: {error}")
    files.write_text(device, "answer")
    assert stat.S_ISCHR(os.stat(device).st_mode) and os.listdir(tmp_path) == ["null"]


@pytest.mark.parametrize("printed_to", ["pipe", "file"])
def test_what_is_printed_to_is_added_to(tmp_path, printed_to):
    link = tmp_path / "stdout"
    link.symlink_to("/dev/stdout")
    code = (f"from mmgsd import files; print('before', flush=True); files.write_text({str(link)!r}, 'table\\n'); "
            "print('after')")  # fmt: skip
    with open(tmp_path / "log", "wb") as log:
        out = log if printed_to == "file" else subprocess.PIPE
        done = subprocess.run([sys.executable, "-c", code], stdout=out, stderr=subprocess.PIPE, check=True)
    printed = (tmp_path / "log").read_bytes() if printed_to == "file" else done.stdout
    assert printed.split() == [b"before", b"table", b"after"] and link.is_symlink()


def test_a_mounted_file_is_written_where_it_is(tmp_path, monkeypatch):
    def refuse(source, target):
        raise OSError(errno.EBUSY, "Device or resource busy", str(source), None, str(target))

    (tmp_path / "out.csv").write_text("a longer one, from before")
    inode = (tmp_path / "out.csv").stat().st_ino
    monkeypatch.setattr(os, "replace", refuse)
    files.write_text(tmp_path / "out.csv", "answer")
    assert (tmp_path / "out.csv").read_text() == "answer" and (tmp_path / "out.csv").stat().st_ino == inode
    assert os.listdir(tmp_path) == ["out.csv"]


@pytest.mark.parametrize("host", ["h", "node-" + "x" * 59])
@pytest.mark.parametrize("name", ["b" * 251 + ".txt", "é" * 125 + ".txt", os.fsdecode(b"caf\xe9.txt"), "a[1].txt"])
def test_every_legal_name_is_written_and_what_a_killed_process_left_of_it_is_found(tmp_path, monkeypatch, host, name):
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    left = files.name_aside(tmp_path / name)
    left = left.with_name(left.name.replace(f"-{os.getpid()}-", f"-{2**22 + 1}-"))  # no such process
    left.touch()
    assert len(os.fsencode(left.name)) <= 143
    with files.locked(tmp_path / name, "writing"):
        files.write_text(tmp_path / name, "whole")
    assert os.listdir(tmp_path) == [name] and (tmp_path / name).read_text() == "whole"


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_without_file_locks_work_goes_on_and_is_said_once(tmp_path, monkeypatch, recwarn, number):
    monkeypatch.setattr(files.fcntl, "flock", raising(number))
    for _ in range(2):
        with files.locked(tmp_path / "set", "rendering"):
            pass
    (warning,) = recwarn
    assert "no file locks" in str(warning.message) and str(tmp_path) in str(warning.message)


@pytest.mark.parametrize(("of", "number"), [("folder", errno.EINVAL), ("folder", errno.EIO), ("file", errno.ENOSYS)])
def test_a_file_is_whole_where_the_disk_cannot_be_flushed(tmp_path, monkeypatch, recwarn, of, number):
    def flush(handle):
        if stat.S_ISDIR(os.fstat(handle).st_mode) == (of == "folder"):
            raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", flush)
    for text in ("first", "second"):
        assert files.write_text(tmp_path / "a.txt", text).read_text() == text
    (warning,) = recwarn
    assert "power cut" in str(warning.message) and str(tmp_path) in str(warning.message)


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_file_that_did_not_reach_the_disk_is_not_put_in_place(tmp_path, monkeypatch, number):
    files.write_text(tmp_path / "a.txt", "first")
    monkeypatch.setattr(os, "fsync", raising(number))
    with pytest.raises(OSError, match="while writing .*a.txt"):
        files.write_text(tmp_path / "a.txt", "second")
    assert (tmp_path / "a.txt").read_text() == "first"


def test_a_full_disk_names_the_path(tmp_path):
    def fill() -> None:
        with files.atomic_write(tmp_path / "big.bin"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left on device while writing .*big.bin") as caught:
        fill()
    assert caught.value.errno == errno.ENOSPC


@pytest.mark.parametrize("data", [b"", b"{", b"\xff\xfe", b"[1, 2"])
def test_damaged_json_names_the_file(tmp_path, data):
    (tmp_path / "a.json").write_bytes(data)
    with pytest.raises(files.DamagedFileError, match="a.json is damaged"):
        files.read_json(tmp_path / "a.json", remedy="make it again")


def test_json_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert files.read_json(tmp_path / "a.json") == {"a": 1}


def test_a_folder_with_a_foreign_file_is_left_as_it_is(tmp_path):
    folder = tmp_path / "set"
    for name in ("ours.png", "thesis.odt"):
        files.write_text(folder / name, name)
    with pytest.raises(files.ForeignFileError, match="thesis.odt was not written"):
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


def test_a_folder_is_replaced_though_the_old_one_cannot_go_at_once(tmp_path, monkeypatch):
    files.write_text(tmp_path / "new" / "a.png", "new")
    files.write_text(tmp_path / "old" / "a.png", "old")
    monkeypatch.setattr(os, "rmdir", raising(errno.ENOTEMPTY))  # as NFS does while a file is open somewhere
    monkeypatch.setattr(os, "unlink", raising(errno.EBUSY))
    files.replace_folder(tmp_path / "new", tmp_path / "old", lambda path: True)
    monkeypatch.undo()
    assert (tmp_path / "old" / "a.png").read_text() == "new"


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


@pytest.mark.parametrize(("content", "kept", "left"), [
    ('{"a": 1}', True, ["x.json"]), ('{"a": 2}', False, ["x.json"]), ("{", False, ["x.json.damaged"]),
    (None, False, []),
])  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*is damaged")
def test_a_file_is_kept_where_it_is_what_is_wanted_and_set_aside_where_it_is_damaged(tmp_path, content, kept, left):
    path = tmp_path / "x.json"
    if content is not None:
        path.write_text(content)
    assert files.is_kept(path, lambda file: files.read_json(file) == {"a": 1}) is kept
    assert os.listdir(tmp_path) == left
