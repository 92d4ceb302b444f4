"""The one place that writes files whole or not at all, locks folders, and removes what is the project's own.

A file is written under a temporary name beside its place, flushed to the disk and renamed; through a link, the file
that it leads to. What is no regular file (a device, a pipe) is never replaced: it gets the finished bytes. Temporary
names carry the process that wrote them, so that what a killed one left behind is known, and removed by the next that
writes there.
"""

from __future__ import annotations

import errno
import glob
import hashlib
import json
import os
import re
import shutil
import socket
import stat
import tempfile
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TextIO

try:
    import fcntl
except ImportError:  # Windows: folders are not locked there
    fcntl = None

ASIDE = re.compile(r"\.(?P<name>.+)\.(?P<host>[^.]*)-(?P<pid>\d+)-[0-9a-f]{8}\.(aside|old)")
LONGEST = 48  # bytes of a name, or of a host's, in a temporary name: some file systems take 143 in all
UNSUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EINVAL, errno.EOPNOTSUPP}  # file systems without locks, or fsync


class LockedError(RuntimeError):
    """Another process works in a folder; the message names both."""


class ForeignFileError(ValueError):
    """A folder that is to be replaced holds something that is not the project's; the message names it."""


class DamagedFileError(ValueError):
    """A file is truncated or not of its format; the message names it and says what to do."""


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Give a temporary path to write; it takes the place of ``path`` at the end, or is removed after an exception.

    Raises OSError, with ``path`` in its message, where the disk is full or the folder cannot be written.
    """
    path = Path(path)
    try:
        direct = _is_written_directly(path)
        target = Path(tempfile.gettempdir(), path.name) if direct else Path(os.path.realpath(path))
        target.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(target.parent, target.name)
        aside = name_aside(target)
        try:
            yield aside
            if direct or not _replace(aside, target):
                _copy_into(aside, path)
        finally:
            aside.unlink(missing_ok=True)
    except OSError as error:
        if str(path) in str(error):
            raise
        raise type(error)(error.errno, f"{error.strerror or error} while writing {path}") from error


def _replace(aside: Path, target: Path) -> bool:
    """Whether a finished file took its place: one mounted by itself, as into a container, cannot be replaced."""
    _flush(aside)
    try:
        os.replace(aside, target)
    except OSError as error:
        if error.errno != errno.EBUSY:
            raise
        return False
    _flush(target.parent)
    return True


def _is_written_directly(path: Path) -> bool:
    """Whether a path is a device, a pipe, or what this process prints to; OSError of a folder or a link to itself."""
    try:
        there = os.stat(path)
    except FileNotFoundError:
        return False
    if stat.S_ISDIR(there.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    return not stat.S_ISREG(there.st_mode) or _find_printed(there) is not None


def _find_printed(there: os.stat_result) -> int | None:
    """The number under which this process prints to a file, a terminal or a pipe."""
    for number in (1, 2):
        with suppress(OSError):  # a closed one
            if os.path.samestat(os.fstat(number), there):
                return number
    return None


def _copy_into(aside: Path, path: Path) -> None:
    """Add to what is printed, where it is that: opened anew, a file would be written over from its beginning."""
    printed = _find_printed(os.stat(path))
    place = path if printed is None else os.dup(printed)
    with open(aside, "rb") as source, open(place, "wb") as target:
        shutil.copyfileobj(source, target)


def write_bytes(path: Path | str, data: bytes) -> Path:
    """Write a file whole or not at all; returns its path."""
    with atomic_write(path) as aside:
        aside.write_bytes(data)
    return Path(path)


def write_text(path: Path | str, text: str) -> Path:
    """Write UTF-8 text whole or not at all; returns the path."""
    return write_bytes(path, text.encode())


def write_json(path: Path | str, values: Any, *, indent: int | None = 1) -> Path:
    """Write plain values as JSON, a newline at the end, whole or not at all; returns the path."""
    return write_text(path, json.dumps(values, indent=indent) + "\n")


def read_json(path: Path | str, *, remedy: str = "remove it, or get it anew") -> Any:
    """Values of a JSON file, with or without a byte-order mark; DamagedFileError, which names it, where it is none."""
    try:
        return json.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except ValueError as error:  # wrong UTF-8 and wrong JSON are both
        raise DamagedFileError(f"{path} is damaged or no JSON ({error}): {remedy}") from error


def name_aside(path: Path, kind: str = "aside") -> Path:
    """A temporary name beside ``path`` that no other process, thread or machine takes."""
    return path.with_name(f".{_shorten(path.name)}.{_name_host()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.{kind}")


def _shorten(name: str) -> str:
    """A name, or where it is long a hash in its place: what is put around it must not make it too long."""
    data = os.fsencode(name)
    return name if len(data) <= LONGEST else hashlib.sha256(data).hexdigest()[:32]


def _name_host() -> str:
    return _shorten(re.sub("[^A-Za-z0-9_]", "_", socket.gethostname()))


def remove_leftovers(folder: Path, name: str = "") -> None:
    """Remove what killed processes of this machine left in ``folder``: of the file ``name``, or of every file."""
    name = _shorten(name)
    for path in folder.glob(f".{glob.escape(name) or '*'}.*.*"):
        parts = ASIDE.fullmatch(path.name)
        if parts and (not name or parts["name"] == name) and not _is_running(parts["host"], int(parts["pid"])):
            _remove(path)


def quarantine(path: Path) -> Path:
    """Rename a damaged intermediate file so that it is made again; returns where it is now."""
    target = path.with_name(f"{path.name}.damaged")
    os.replace(path, target)
    warnings.warn(f"{path} is damaged, so it is made again; what it held is now {target}", stacklevel=2)
    return target


def is_kept(path: Path, is_wanted: Callable[[Path], Any]) -> bool:
    """Whether a file is there and ``is_wanted``, which reads it; one that it finds damaged is set aside."""
    try:
        return path.is_file() and bool(is_wanted(path))
    except DamagedFileError:
        quarantine(path)
        return False


def remove_folder(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Remove a folder of the project's files; a no-op where there is none.

    ``is_ours`` is asked of every file's path relative to it. Nothing is touched where it denies one: ForeignFileError.
    The folder is renamed first, so that a kill leaves all of it or nothing under its name.
    """
    if not folder.exists():
        return
    check_ours(folder, is_ours)
    remove_leftovers(folder.parent, folder.name)
    old = name_aside(folder, "old")
    os.replace(folder, old)
    shutil.rmtree(old)


def replace_folder(finished: Path, folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """Put the folder ``finished`` in the place of ``folder``, whose files must all be ours (see `remove_folder`)."""
    old = None
    if hasattr(os, "sync"):
        os.sync()  # thousands of small files: one call for all of them
    if folder.exists():
        check_ours(folder, is_ours)
        old = name_aside(folder, "old")
        os.replace(folder, old)
    os.replace(finished, folder)
    _flush(folder.parent)
    if old:
        _remove(old)
    remove_leftovers(folder.parent, folder.name)


def check_ours(folder: Path, is_ours: Callable[[Path], bool]) -> None:
    """ForeignFileError where a folder holds a file that ``is_ours`` denies, or is a link or a file itself."""
    if folder.is_symlink() or not folder.is_dir():
        raise ForeignFileError(f"{folder} is a link or a file, not our folder: move it, or choose another place")
    for place, folders, names in os.walk(folder):  # from the top: a foreign tree is not walked through
        folders.sort()
        files = set(names)
        for path in (Path(place, name) for name in sorted([*names, *folders])):
            if path.is_symlink() or (path.name in files and not is_ours(path.relative_to(folder))):
                raise ForeignFileError(f"{path} was not written by mmgsd: move it away, or choose another folder")


@contextmanager
def locked(folder: Path, doing: str) -> Iterator[None]:
    """Hold a folder, which need not exist, for this process alone; LockedError names who holds it, and ``doing`` what.

    The lock ends with the process, however it ends. It lies beside the folder while it is held: ``.NAME.lock``. Where
    the file system has no locks, a warning says so and nothing is held.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.with_name(f".{_shorten(folder.name)}.lock")
    with _take(path) as file:
        if file is None:
            holder = path.read_text("utf-8").strip() if path.is_file() else ""
            raise LockedError(f"{folder} is in use by {holder or 'another process'}: wait for it, or stop it")
        file.truncate(0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        file.write(f"process {os.getpid()} on {socket.gethostname()}, {doing} since {since}\n")
        file.flush()
        try:
            yield
        finally:
            if fcntl:  # Windows removes no open file
                path.unlink(missing_ok=True)


@contextmanager
def _take(path: Path) -> Iterator[TextIO | None]:
    """The lock file, held, or None where another process holds it; one that was removed meanwhile is opened anew."""
    while True:
        with open(path, "a+", encoding="utf-8") as file:
            try:
                if fcntl:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield None
                return
            except OSError as error:
                if error.errno not in UNSUPPORTED:
                    raise
                _warn_once(f"{path.parent} has no file locks ({error.strerror}): start no second process that writes "
                           "there")  # fmt: skip
            if not fcntl or (path.exists() and os.fstat(file.fileno()).st_ino == path.stat().st_ino):
                yield file
                return


@contextmanager
def scratch_folder(parent: Path, name: str) -> Iterator[Path]:
    """A temporary folder in ``parent``, removed at the end; those of its name that killed processes left go first."""
    remove_leftovers(parent, name)
    folder = name_aside(parent / name)
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def saying_what_stays(describe: Callable[[], str]) -> Iterator[None]:
    """Let the KeyboardInterrupt of a Ctrl-C, or of a notebook's stop, say what is kept of the work."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(describe()) from None


def _is_running(host: str, pid: int) -> bool:
    """Whether the process may be alive: of another machine, and on Windows, that is not known."""
    if os.name != "posix" or host != _name_host():
        return True
    try:
        os.kill(pid, 0)
    except OSError as error:  # of another user's process PermissionError
        return not isinstance(error, ProcessLookupError)
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Have the system write a file, or a folder's entries, to the disk.

    A warning where the file system cannot, or for a folder: what was renamed in it is whole, and there.
    """
    if path.is_dir() and os.name != "posix":
        return
    try:
        handle = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)  # Windows flushes what may be written
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in UNSUPPORTED and not path.is_dir():
            raise
        folder = path if path.is_dir() else path.parent
        _warn_once(f"{folder} cannot be flushed to the disk ({error.strerror}): a power cut may lose what was just "
                   "written there")  # fmt: skip


@cache
def _warn_once(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=3)
