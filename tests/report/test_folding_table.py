"""The folding bench's table: policies in their order, intervals, and dashes for what was not run."""

from __future__ import annotations

from mmgsd.report.folding import make_folding_sentence, make_folding_table


def mean(value: float, count: int = 8) -> dict[str, float | int]:
    return {"mean": value, "low": value - 0.1, "high": value + 0.1, "count": count}


def row(success: float) -> dict:
    part = {"success": mean(success), "error": mean(0.0312), "overlap": mean(0.874)}
    return {"all": {**part, "success": mean(success, 10)}, "reachable": part, "cautious": mean(0.9, 5)}


RESULTS = {
    "run": {"rollouts": 10, "minutes": 12.5, "hardware": "CPU, 2 cores"},
    "policies": {"cloth": {"mmgsd": row(0.75), "truth": row(0.8)}, "rope": {"truth": row(0.8)}},
}


def test_a_row_a_policy_with_the_interval_of_its_success() -> None:
    lines = make_folding_table(RESULTS).splitlines()
    assert lines[0] == "|  | cloth: success | error | overlap | rope: success | error | overlap |"
    assert lines[2].startswith("| true matches | 80 % (70 to 90) | 3.1 % | 87.4 % | 80 %")
    assert lines[3] == "| MMGSD, modes that agree | 75 % (65 to 85) | 3.1 % | 87.4 % | – | – | – |"
    assert len(lines) == 4


def test_counts_and_caution_are_said() -> None:
    assert make_folding_sentence(RESULTS) == (
        "Rollouts: cloth: the true matches succeed in 8 of 10, and MMGSD 90 % of the 5 it agrees on; "
        "rope: the true matches succeed in 8 of 10 (12.5 minutes, CPU, 2 cores)."
    )
