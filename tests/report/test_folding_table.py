"""The folding bench's table: policies in their order, intervals, and dashes for what was not run."""

from __future__ import annotations

from mmgsd.report.folding import make_folding_sentence, make_folding_table


def mean(value: float, count: int = 8) -> dict[str, float | int]:
    return {"mean": value, "low": value - 0.1, "high": value + 0.1, "count": count}


def row(success: float) -> dict:
    part = {"success": mean(success), "error": mean(0.0312), "overlap": mean(0.874)}
    beyond = {"error": mean(0.2), "success": mean(-0.5)}
    every = {**part, "success": mean(success, 10), "error": mean(0.0712, 10)}
    return {"all": every, "reachable": part, "cautious": mean(0.9, 5), "beyond": beyond}


RESULTS = {
    "run": {"rollouts": 10},
    "policies": {"cloth": {"mmgsd": row(0.75), "truth": row(0.8)}, "rope": {"truth": row(0.8)}},
}


def test_a_row_a_policy_with_the_interval_of_its_success() -> None:
    lines = make_folding_table(RESULTS).splitlines()
    heads = "success | error | beside MMGSD's | overlap | error of all"
    assert lines[0] == f"|  | cloth: {heads} | rope: {heads} |"
    rest = "3.1 % | +20.0 (+10.0 to +30.0) | 87.4 % | 7.1 %"
    assert lines[2].startswith(f"| true matches | 80 % (70 to 90) | {rest} | 80 %")
    assert lines[3] == f"| MMGSD, modes that agree | 75 % (65 to 85) | {rest} | – | – | – | – | – |"
    assert len(lines) == 4


def test_counts_caution_and_pairs_are_said() -> None:
    results = {**RESULTS, "policies": {**RESULTS["policies"]}}
    results["policies"]["cloth"] = {**results["policies"]["cloth"], "spcl": row(0.5)}
    assert make_folding_sentence(results) == (
        "Cloth: 8 of 10 rollouts count; MMGSD succeeds in 90 % of the 5 whose modes agree most. "
        "Rope: 8 of 10 rollouts count."
    )


def test_rollouts_of_which_none_counts_are_dashes() -> None:
    part = RESULTS["policies"]["cloth"]["truth"]["all"]
    rows = {"truth": {"all": part, "cautious": {"count": 0}, "beyond": {}}}
    results = {"run": RESULTS["run"], "policies": {"cloth": rows, "rope": rows}}
    assert make_folding_table(results).splitlines()[2] == f"| true matches |{' – |' * 10}"
    assert "0 of 10 rollouts count" in make_folding_sentence(results)
