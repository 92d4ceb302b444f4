"""The verdict: numbers beside the stored ones, tolerances from seeds, and what was stored outlives kills."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import pytest

from mmgsd.paths import Paths
from mmgsd.report.verdict import (
    compare_files,
    compare_numbers,
    compute_tolerance,
    judge_number,
    judge_run,
    keep_stored,
    list_measures,
    load_stored,
    measure_spreads,
)

ERRORS = {"mmgsd-0": 50.0, "mmgsd-1": 52.0, "mmgsd-2": 54.0, "pcl-0": 50.0, "pcl-1": 50.0, "spcl-0": 9.0}
SEEDS = {"cloth": {key: {"rmse_mean": error} for key, error in ERRORS.items()}}
STORED = {
    "rmse": {"cloth": {"mmgsd": {"rmse_mean": 50.0, "queries": 9}, "sift": {"rmse_mean": 80.0}}},
    "runs": {"cloth-mmgsd": {"model": "cloth-mmgsd-c4", "minutes": 1.0, "hardware": "CPU, 2 cores"}},
    "sigma": {"cloth": {"4": {"rmse_mean": 60.0, "run": {"model": "cloth-mmgsd-sigma4"}}}},
    "uncertainty": {"calibrated": {"cloth": {"mmgsd": {"spearman": 0.4, "auroc_absent": None}}}},
    "seeds": SEEDS,
}
ANSWERS = ("cloth-mmgsd-c4", "cloth-mmgsd-sigma4", "cloth-sift")


def write_results(paths: Paths, results: dict[str, Any]) -> None:
    paths.results.mkdir(parents=True, exist_ok=True)
    for name, content in results.items():
        (paths.results / f"{name}.json").write_text(json.dumps(content))


def touch_answers(paths: Paths) -> None:
    for name in ANSWERS:
        paths.queries(name).parent.mkdir(parents=True, exist_ok=True)
        paths.queries(name).touch()


def change(error: float, **others: float) -> dict[str, Any]:
    """What is stored, with other errors of MMGSD, and others, on the cloth."""
    results = copy.deepcopy(STORED)
    for method, value in {"mmgsd": error, **others}.items():
        results["rmse"]["cloth"].setdefault(method, {})["rmse_mean"] = value
    return results


@pytest.fixture
def paths(tmp_path: Path) -> Paths:
    """A preset with stored results and all answers there."""
    paths = Paths(tmp_path, "quick")
    write_results(paths, STORED)
    touch_answers(paths)
    return paths


@pytest.mark.parametrize(
    ("stored", "found", "said"),
    [
        (50.0, 50.0, "equal"), (math.nan, math.nan, "equal"), (50.0, 52.0, "agrees"), (50.0, 48.0, "agrees"),
        (50.0, 52.1, "differs"), (50.0, math.nan, "differs"), (math.nan, 50.0, "differs"), (50.0, None, "missing"),
        (None, 50.0, "new"),
    ],
)  # fmt: skip
def test_a_number_is_judged_by_its_tolerance(stored: float | None, found: float | None, said: str) -> None:
    assert judge_number(stored, found, 2.0) == said


@pytest.mark.parametrize(
    ("measure", "row", "seeds", "tolerance"),
    [
        ("rmse_mean", "mmgsd", SEEDS, 6.0),  # 3 times the std of 50, 52, 54
        ("rmse_mean", "pcl", SEEDS, 1.5),  # its seeds are equal: the floor, 3 % of 50
        ("rmse_mean", "spcl", SEEDS, 6.0),  # a single seed is no spread: the largest of those that are
        ("rmse_mean", "4", SEEDS, 6.0),
        ("rmse_mean", "sift", SEEDS, 1.5),  # nothing is trained
        ("rmse_mean", "mmgsd", {}, 1.5),
        ("rmse_mean", "mmgsd", {"rope": SEEDS["cloth"]}, 1.5),  # another object's say nothing
        ("aurc", "mmgsd", SEEDS, 6.0),  # a mean of errors
        ("pck@20px", "mmgsd", SEEDS, 0.015),
        ("spearman", "mmgsd", SEEDS, 0.05),
        ("ece", "mmgsd", SEEDS, 0.05),
        ("ece", "spcl", SEEDS, 0.15),  # by the steps in which its bandwidth is chosen
    ],
)  # fmt: skip
def test_the_tolerance_comes_from_the_seeds_and_has_a_floor(
    measure: str, row: str, seeds: dict, tolerance: float
) -> None:
    found = compute_tolerance(list_measures()[measure], "cloth", row, 50.0, measure_spreads(seeds))
    assert found == pytest.approx(tolerance)


def test_the_same_results_are_equal_and_no_file_is_new(paths: Paths) -> None:
    keep_stored(paths)
    verdict = judge_run(paths)
    assert set(verdict.numbers["agrees"]) == {"equal"} and verdict.files.empty
    assert verdict.summary.startswith("Verdict: 4 of 4 numbers agree with the stored ones; 4 are equal.\n")
    assert "Files: 0 of 5 stored ones written anew, 0 new.\n" in verdict.summary


def test_numbers_that_agree_differ_are_missing_or_new_are_told_apart(paths: Paths) -> None:
    found = change(55.0, sift=90.0, orb=70.0)
    del found["uncertainty"]
    table = compare_numbers(STORED, found, paths)["agrees"]
    assert table.to_dict() == {
        ("rmse", "cloth", "mmgsd", "rmse_mean"): "agrees",
        ("rmse", "cloth", "sift", "rmse_mean"): "differs",
        ("rmse", "cloth", "orb", "rmse_mean"): "not run here",
        ("sigma", "cloth", "4", "rmse_mean"): "equal",
        ("uncertainty, calibrated", "cloth", "mmgsd", "spearman"): "missing",
    }
    paths.queries("cloth-orb").touch()
    assert compare_numbers(STORED, found, paths)["agrees"]["rmse", "cloth", "orb", "rmse_mean"] == "new"


@pytest.mark.parametrize("answers", ANSWERS)
def test_a_row_that_is_kept_without_its_answers_is_not_of_this_run(paths: Paths, answers: str) -> None:
    paths.queries(answers).unlink()
    table = compare_numbers(STORED, STORED, paths)["agrees"]
    lost = {"cloth-mmgsd-c4": 2, "cloth-mmgsd-sigma4": 1, "cloth-sift": 1}  # the model is in two tables
    assert (table == "not run here").sum() == lost[answers]


def test_a_difference_is_named_with_both_values_and_the_files_that_hold_it(paths: Paths) -> None:
    keep_stored(paths)
    write_results(paths, change(60.0) | {"stages": {"01_render_data": 1.0}})
    verdict = judge_run(paths)
    assert "3 of 4 numbers agree" in verdict.summary
    assert "differs: rmse cloth mmgsd rmse_mean is 60, stored 50 ± 6\n" in verdict.summary
    assert verdict.files["file"].to_dict() == {
        "data/results/quick/rmse.json": "written anew", "data/results/quick/stages.json": "new"
    }  # fmt: skip
    assert "Files: 1 of 5 stored ones written anew, 1 new.\n  data/results/quick/rmse.json\n" in verdict.summary
    assert (paths.generated / "notebooks" / "verdict.txt").read_text() == verdict.summary


def test_files_are_told_apart_by_their_digests() -> None:
    changed = compare_files({"same": "1", "runs.json": "1", "gone": "1"}, {"same": "1", "runs.json": "2", "new": "1"})
    assert changed["file"].to_dict() == {"gone": "gone", "new": "new", "runs.json": "written anew"}


def test_what_is_stored_outlives_a_run_that_was_killed_after_it_wrote(paths: Paths) -> None:
    keep_stored(paths)
    write_results(paths, change(60.0))
    keep_stored(paths)  # the same run, resumed
    assert judge_run(paths).numbers["stored"]["rmse", "cloth", "mmgsd", "rmse_mean"] == 50.0


def test_a_finished_run_that_is_repeated_is_compared_with_what_was_stored_before_it(paths: Paths) -> None:
    for _ in range(3):
        keep_stored(paths)
        write_results(paths, change(60.0))
        numbers = judge_run(paths).numbers
        assert numbers["stored"]["rmse", "cloth", "mmgsd", "rmse_mean"] == 50.0


def test_results_that_come_from_elsewhere_after_a_run_are_the_stored_ones(paths: Paths) -> None:
    keep_stored(paths)
    write_results(paths, change(60.0))
    judge_run(paths)
    write_results(paths, change(58.0))  # git pull
    keep_stored(paths)
    write_results(paths, change(60.0))
    assert judge_run(paths).numbers["stored"]["rmse", "cloth", "mmgsd", "rmse_mean"] == 58.0


def test_without_stored_results_all_is_new(tmp_path: Path) -> None:
    paths = Paths(tmp_path, "quick")
    keep_stored(paths)
    write_results(paths, STORED)
    touch_answers(paths)
    summary = judge_run(paths).summary
    assert "0 of 0 numbers" in summary and "4 new" in summary and "mean nothing" not in summary


def test_a_preset_without_any_number_has_a_verdict(tmp_path: Path) -> None:
    verdict = judge_run(Paths(tmp_path, "quick"))
    assert verdict.numbers.empty and "0 of 0 numbers" in verdict.summary


def test_the_verdict_on_smoke_says_that_its_numbers_mean_nothing(tmp_path: Path) -> None:
    assert judge_run(Paths(tmp_path, "smoke")).summary.startswith("Nothing is learnt in smoke")


def test_damaged_notes_of_what_was_stored_are_set_aside(paths: Paths) -> None:
    keep_stored(paths)
    (paths.generated / "notebooks" / "stored.json").write_text("{}")
    with pytest.warns(UserWarning, match="stored.json is damaged"):
        assert not load_stored(paths)["running"]


def test_measures_of_the_seeds_are_stored_with_them() -> None:
    seeds = json.loads((Path(__file__).resolve().parents[2] / "data" / "results" / "quick" / "seeds.json").read_text())
    assert {measure.like for measure in list_measures().values()} - {""} <= set(seeds["cloth"]["mmgsd-0"])
