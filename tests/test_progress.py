"""A bar is drawn where somebody sees it, is lines elsewhere, and tells a file how far it is where it is asked to."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from mmgsd import progress
from mmgsd.progress import TOLD, ProgressBar


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(TOLD, str(tmp_path / "bar.txt"))
    monkeypatch.setattr(progress, "EVERY", 0.0)
    return tmp_path / "bar.txt"


def test_a_bar_tells_what_it_counts_until_it_ends(told: Path) -> None:
    bar = ProgressBar(total=3, desc="render cloth", mininterval=0)
    bar.update(2)
    bar.refresh()
    assert told.read_text() == "render cloth: 2/3"
    bar.close()
    assert told.read_text() == ""
    told.write_text("another: 1/2")
    bar.close()
    assert told.read_text() == "another: 1/2"


def test_a_disabled_bar_tells_nothing_and_a_folder_that_is_gone_stops_no_work(
    told: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(ProgressBar(range(3), disable=True)) == [0, 1, 2]
    assert not told.exists()
    monkeypatch.setenv(TOLD, str(told / "missing" / "bar.txt"))
    assert list(ProgressBar(range(3))) == [0, 1, 2]


def test_without_the_variable_no_file_is_told(told: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(TOLD)
    assert list(ProgressBar(range(3))) == [0, 1, 2]
    assert not told.exists()


@pytest.mark.parametrize(("watched", "say", "leave", "lines"), [
    (False, 0.0, False, ["work: 1/3", "work: 2/3", "work: 3/3"]), (False, 99.0, False, []),
    (False, 99.0, True, ["work: 3/3"]), (True, 0.0, True, None),
])  # fmt: skip
def test_where_no_bar_can_be_drawn_over_lines_say_now_and_then_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, watched: bool, say: float, leave: bool,
    lines: list[str] | None,
) -> None:  # fmt: skip
    monkeypatch.setattr(progress, "SAY", say)
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    if watched:
        monkeypatch.setenv("JPY_SESSION_NAME", "01_render_data.ipynb")
    for _ in ProgressBar(range(3), desc="work", leave=leave, mininterval=0):
        pass
    said = capsys.readouterr().err
    assert ("\r" in said) == watched
    if lines is not None:
        found = [line.partition(" [")[0] for line in said.splitlines()]
        assert list(dict.fromkeys(line for line in found if line != "work: 0/3")) == lines


def test_a_notebook_that_papermill_runs_says_how_far_it_is(tmp_path: Path) -> None:
    cell = """
from mmgsd import progress
progress.SAY = 0.0
for _ in progress.ProgressBar(range(3), desc="work", mininterval=0):
    pass
"""
    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)]), tmp_path / "in.ipynb")
    command = [sys.executable, "-m", "papermill", "--kernel", "python3", "--log-output", "--no-progress-bar"]
    environment = {name: value for name, value in os.environ.items() if name != "JPY_SESSION_NAME"}
    environment["PYTHONPATH"] = str(Path(progress.__file__).parents[1])
    done = subprocess.run(
        [*command, "in.ipynb", "out.ipynb"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert "work: 2/3 [" in done.stdout + done.stderr
