"""A command line ends with one sentence, whatever went wrong, and Ctrl-C with what was kept."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mmgsd.command import run_command

ROOT = Path(__file__).resolve().parents[1]


def raising(error: BaseException) -> Callable[[], None]:
    def main() -> None:
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (ValueError("preset must be\n  one of 'smoke'"), "error: preset must be one of 'smoke'"),
        (FileNotFoundError(2, "No such file or directory", "a.json"), "error: a.json: No such file or directory"),
        (FileNotFoundError("a.json does not exist: render it"), "error: a.json does not exist: render it"),
        (RuntimeError("folder is in use"), "error: folder is in use"),
        (KeyError("cloth"), "error: KeyError: 'cloth' (set MMGSD_TRACEBACK=1 to see where)"),
        (
            ModuleNotFoundError(name="bpy"),
            "error: bpy is not installed: pip install 'mmgsd[render]' brings it (Python 3.11)",
        ),
        (ModuleNotFoundError(name="seaborn"), "error: seaborn is not installed: pip install 'mmgsd[plot]' brings it"),
        (MemoryError(), "error: MemoryError (set MMGSD_TRACEBACK=1 to see where)"),
    ],
)
def test_an_error_is_one_sentence_and_exit_2(capsys, monkeypatch, error, sentence):
    monkeypatch.delenv("MMGSD_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as stopped:
        run_command(raising(error))
    assert stopped.value.code == 2
    assert capsys.readouterr().err == sentence + "\n"


def test_ctrl_c_says_what_was_kept(capsys):
    with pytest.raises(SystemExit) as stopped:
        run_command(raising(KeyboardInterrupt()), kept="two models are kept")
    assert stopped.value.code == 130
    assert capsys.readouterr().err == "stopped: two models are kept\n"


def test_the_traceback_is_to_be_had(monkeypatch):
    monkeypatch.setenv("MMGSD_TRACEBACK", "1")
    with pytest.raises(KeyError):
        run_command(raising(KeyError("cloth")))


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("studies.matrix papr", "error: preset must be one of 'smoke', 'quick', 'paper'"),
        ("studies.matrix smoke --only shirt", "'shirt': no model or baseline of the preset smoke"),
        ("studies.matrix smoke --scheduler localhost", "error: --scheduler must be an address host:port"),
        ("studies.matrix smoke --only cloth-centre", "dataset.json does not exist"),
        ("extras.sampling papr", "error: preset must be one of"),
        ("extras.sampling smoke --quality 0", "error: quality must be between 1 and 100, got 0"),
        ("extras.sampling smoke", "dataset.json does not exist"),
        ("extras.shipping papr", "error: preset must be one of"),
        ("extras.shipping smoke", "for preset='smoke' there is no data/results/smoke/rmse.json yet: run 04_evaluate"),
        ("report.tables", "the following arguments are required: results, documents"),
        ("report.tables nowhere README.md", "README.md: No such file or directory"),
        ("report.latex papr", "error: preset must be one of"),
    ],
)
def test_every_command_says_what_is_wrong_without_a_traceback(tmp_path, command, sentence):
    module, *arguments = command.split()
    environment = {**os.environ, "MMGSD_ROOT": str(tmp_path), "PYTHONPATH": str(ROOT), "MMGSD_TRACEBACK": ""}
    asked = [sys.executable, "-m", f"mmgsd.{module}", *arguments]
    done = subprocess.run(asked, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert sentence in done.stderr and "Traceback" not in done.stderr
