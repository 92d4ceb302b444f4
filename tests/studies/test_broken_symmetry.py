"""Prior work's ways to break the symmetry: what is trained, for how long, and which rows are written."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from mmgsd.measure.evaluation import read_results, write_results
from mmgsd.paths import Paths
from mmgsd.studies import broken_symmetry
from mmgsd.studies.claims import HELD, NOT_HELD


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """(object, steps) of each model that is asked for; its row is written without training."""
    asked: list[tuple[str, int]] = []

    def measure(paths, object, row, images, steps, *, overwrite):
        asked.append((object, steps))
        return {"rmse_mean": float(steps)}

    monkeypatch.setattr(broken_symmetry, "_measure", measure)
    return asked


def test_other_steps_have_a_file_of_their_own_and_rows_of_other_objects_stay(tmp_path: Path, trained: list) -> None:
    paths = Paths(tmp_path, "paper")
    (file,) = broken_symmetry.list_shown(paths, steps=4000)
    write_results({"cloth, any rotation": {"rmse_mean": 1.0}}, file)
    assert broken_symmetry.run(paths, steps=4000, objects="rope") == file
    rows = read_results(file)
    assert set(rows) == {"cloth, any rotation", "rope, plain", "rope, ball at one end"}
    assert trained == [("rope", 4000)] * 2 and rows["rope, plain"]["rmse_mean"] == 4000
    assert broken_symmetry.run(paths).name == "broken_symmetry.json" and len(trained) == 6


@pytest.mark.parametrize(("name", "value"), [("steps", -1), ("objects", "towel")])
def test_options_are_checked_before_anything_is_rendered(tmp_path: Path, name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        broken_symmetry.check(Paths(tmp_path, "paper"), **{name: value})


@pytest.mark.parametrize(("longer", "verdict"), [(None, NOT_HELD), (0.59, NOT_HELD), (0.6, HELD)])
def test_the_ball_is_judged_by_the_longer_training(longer: float | None, verdict: str) -> None:
    ball = "rope, ball at one end"
    results = {"broken_symmetry": {ball: {"rmse_mean": 111.1, "right": 0.52}}}
    if longer is not None:
        results["broken_symmetry_4000"] = {ball: {"rmse_mean": 60.0, "right": longer}}
    claim = broken_symmetry.judge_ball(results)
    assert claim.verdict == verdict
    error, share = (60.0, f"{100 * longer:.0f} %") if longer else (111.1, "52 %")
    assert claim.measured == f"with a ball {error} px; right with a ball {share}"
    assert ("steps=4000" in claim.command) == bool(longer)


def test_the_end_that_the_ball_is_on_is_counted_by_itself() -> None:
    own = pd.DataFrame({"point": [0, 18, 19, 312, 600, 0], "visible": [True] * 5 + [False],
                        "rmse_px": [4.0, 6.0, 9.0, 5.0, 80.0, 99.0]})  # fmt: skip
    every = own.assign(nearest_px=[4.0, 6.0, 3.0, 5.0, 7.0, 1.0], n=[2, 2, 2, 1, 2, 2])
    compared = broken_symmetry._compare(own, every, "rope")
    assert compared == {"nearest_of_all": 5.0, "right": 0.5, "right_at_end": 1.0}  # the middle has one match
    assert set(broken_symmetry._compare(own, every, "cloth")) == {"nearest_of_all", "right"}
    assert broken_symmetry._compare(own.assign(rmse_px=9.0), every, "rope")["right_at_end"] == 0.0
