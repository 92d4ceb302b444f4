"""A bar tells a file how far it is, where it is asked to, and only while it moves."""

from __future__ import annotations

from pathlib import Path

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
