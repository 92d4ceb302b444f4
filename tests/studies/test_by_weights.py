"""Studies of finished weights: a row of each preset's images, beside the rows that are there."""

from __future__ import annotations

from pathlib import Path

import pytest

from mmgsd.measure.evaluation import read_results, write_results
from mmgsd.paths import Paths
from mmgsd.studies import by_weights
from mmgsd.studies.by_weights import list_parts, list_rows, measure_weights


def test_clean_and_cluttered_images_are_asked_about_and_other_rows_stay(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(by_weights, "load_dataset", lambda folder, split: f"{folder.parent.name}, {split}")
    paths, others = Paths(tmp_path, "round2"), {"mine": {"quick": {"seen": {"px": 1}}}}
    write_results(others, paths.results.parent / "parts.json")
    measure = {"round2, train": {"seen": {"px": 2}}, "round2_workspace, train": {"hidden": {"px": 3}}}
    file = measure_weights(paths, "parts.json", "cloth-paper", "train", lambda matcher, data: measure[data])
    found = read_results(file, depth=3)
    assert found == others | {"cloth-paper": {"round2": {"seen": {"px": 2}}, "round2_workspace": {"hidden": {"px": 3}}}}
    assert list(list_parts(found)) == ["mine, quick", "cloth-paper, round2", "cloth-paper, round2_workspace"]
    rows = list_rows(found, {"seen": "is seen", "hidden": "is hidden", "none": "is nowhere"})
    assert rows == {"is seen": {"mine, quick": {"px": 1}, "cloth-paper, round2": {"px": 2}},
                    "is hidden": {"cloth-paper, round2_workspace": {"px": 3}}}  # fmt: skip


def test_weights_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match="nowhere"):
        measure_weights(Paths(tmp_path, "round2"), "parts.json", "nowhere", "train", lambda matcher, data: {})
