"""A command line ends with one sentence, whatever went wrong, and Ctrl-C with what was kept."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import pytest

import mmgsd
from mmgsd.__main__ import COMMANDS, STUDIES, main, make_parser
from mmgsd.command import Option, add_arguments, call, run_command

LATER = "brings it (Python 3.11 or later)"
ROOT = Path(__file__).resolve().parents[1]


def raising(error: BaseException) -> Callable[[], None]:
    def main() -> None:
        raise error

    return main


@pytest.mark.parametrize(("error", "code", "sentence"), [
    (ValueError("preset must be\n  one of 'smoke'"), 2, "preset must be one of 'smoke'"),
    (FileNotFoundError(2, "No such file or directory", "a.json"), 2, "a.json: No such file or directory"),
    (FileNotFoundError("a.json does not exist: render it"), 2, "a.json does not exist: render it"),
    (RuntimeError("folder is in use"), 1, "folder is in use"),
    (KeyError("cloth"), 1, "KeyError: 'cloth' (set MMGSD_TRACEBACK=1 to see where)"),
    (ModuleNotFoundError(name="onnx"), 2, "onnx is not installed: pip install 'mmgsd[notebooks]' " + LATER),
    (ModuleNotFoundError(name="seaborn"), 2, "seaborn is not installed: pip install 'mmgsd[plot]' brings it"),
    (MemoryError(), 1, "MemoryError (set MMGSD_TRACEBACK=1 to see where)"),
])  # fmt: skip
def test_an_error_is_one_sentence_and_2_where_it_is_the_callers(capsys, monkeypatch, error, code, sentence):
    monkeypatch.delenv("MMGSD_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as stopped:
        run_command(raising(error))
    assert stopped.value.code == code
    assert capsys.readouterr().err == f"error: {sentence}\n"


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
        ("run models papr", "error: preset must be one of 'smoke', 'quick', 'paper'"),
        ("run models smoke --only shirt", "'shirt': no model or baseline of the preset smoke"),
        ("run models smoke --scheduler localhost", "error: --scheduler must be an address host:port"),
        ("run models smoke --only cloth-centre", "dataset.json does not exist"),
        ("run modls smoke", "argument study: invalid choice: 'modls' (choose from 'models', "),
        ("run folding smoke --only nobody", "--only 'nobody': no policy has a name with that; there are "),
        ("run", "the following arguments are required: study"),
        ("mtach", "argument command: invalid choice: 'mtach' (choose from 'match', "),
        ("write-sample smoke --quality 0", "error: quality must be between 1 and 100, got 0"),
        ("write-sample smoke", "dataset.json does not exist"),
        ("ship smoke", "for preset='smoke' there is no data/results/smoke/rmse.json yet: run 04_evaluate"),
        ("tables", "the following arguments are required: results, documents"),
        ("tables nowhere README.md", "README.md: No such file or directory"),
        ("latex papr", "error: preset must be one of"),
        ("rounds towel", "argument object: invalid choice: 'towel' (choose from 'cloth', 'rope')"),
        ("rounds cloth --last 99", "argument --last: invalid choice: 99"),
        ("reproduce papr", "argument preset: invalid choice: 'papr'"),
    ],
)
def test_every_command_says_what_is_wrong_without_a_traceback(tmp_path, monkeypatch, capsys, command, sentence):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    monkeypatch.delenv("MMGSD_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as stopped:
        main(command.split())
    told = capsys.readouterr().err
    assert stopped.value.code == 2
    assert sentence in told and "Traceback" not in told


def test_the_module_is_a_command(tmp_path):
    asked = [sys.executable, "-m", "mmgsd", "latex", "papr"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MMGSD_TRACEBACK": ""}
    done = subprocess.run(asked, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert "error: preset must be one of" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("words", [[name] for name in COMMANDS] + [["run", name] for name in STUDIES], ids=" ".join)
def test_every_command_has_help(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        make_parser(words).parse_args([*words, "--help"])
    told = capsys.readouterr().out
    assert stopped.value.code == 0 and f" {' '.join(words)} [-h]" in told and "\n\n" in told


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["nothing"]], ids=" ".join)
def test_no_command_is_imported_before_its_name_is_known(words):
    code = f"""
import sys
from mmgsd.__main__ import main
try:
    main({words})
except SystemExit:
    print([name for name in ("numpy", "cv2", "torch", "mmgsd.cli") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.endswith("[]\n")


Length = Annotated[int, Option("of each, in cm", metavar="CM")]


def lay_out(
    folder: Path, *names: str, length: Length, wide: Length | None = None, dry_run: bool = False, by: str = "hand"
) -> None:
    print(folder, names, length, wide, dry_run, by)


def test_a_functions_parameters_are_arguments_and_options(capsys):
    parser = argparse.ArgumentParser()
    add_arguments(parser, lay_out)
    words = ["here", "a", "b", "--length", "3", "--dry-run"]
    call(lay_out, parser.parse_args(words))
    assert capsys.readouterr().out == "here ('a', 'b') 3 None True hand\n"
    assert parser.parse_args([*words, "--wide", "4"]).wide == 4
    for wrong, said in ((words[:1], "names"), (words[:3], "--length"), ([*words, "--wide", "x"], "--wide: invalid")):
        with pytest.raises(SystemExit):
            parser.parse_args(wrong)
        assert said in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="another system ends a process otherwise")
def test_sigterm_is_as_ctrl_c(capsys: pytest.CaptureFixture) -> None:
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as stopped:
            run_command(lambda: os.kill(os.getpid(), signal.SIGTERM), kept="all is kept")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert stopped.value.code == 130 and "all is kept" in capsys.readouterr().err


def test_the_version_is_told(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0 and capsys.readouterr().out == f"mmgsd {mmgsd.__version__}\n"
