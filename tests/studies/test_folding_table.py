"""The folding bench's table: policies in their order, intervals, and dashes for what was not run."""

from __future__ import annotations

from mmgsd.studies.folding import describe_folding, describe_starts, make_folding_sentence
from mmgsd.studies.grasp import describe_grasps
from mmgsd.studies.table import to_markdown

ERRORS = {"edge-flat-plain-0": 0.01, "edge-wrinkled-plain-1": 0.07, "corner-flat-workspace-2": 0.02}


def mean(value: float, count: int = 8) -> dict[str, float | int]:
    return {"mean": value, "low": value - 0.1, "high": value + 0.1, "count": count}


def row(success: float, worse: float = 0.0) -> dict:
    part = {"success": mean(success), "error": mean(0.0312), "overlap": mean(0.874)}
    beyond = {"error": mean(0.2), "success": mean(-0.5)}
    every = {**part, "success": mean(success, 10), "error": mean(0.0712, 10)}
    rollouts = {name: [error + worse * ("wrinkled" in name), False] for name, error in ERRORS.items()}
    return {"all": every, "reachable": part, "cautious": mean(0.9, 5), "beyond": beyond, "rollouts": rollouts}


RESULTS = {
    "run": {"rollouts": 10},
    "policies": {"cloth": {"mmgsd": row(0.75, 0.031), "truth": row(0.8)}, "rope": {"truth": row(0.8)}},
}


def test_a_row_a_policy_with_the_interval_of_its_success() -> None:
    lines = to_markdown(describe_folding(RESULTS)).splitlines()
    heads = "success | as true matches | error | beside MMGSD's"
    assert lines[0] == f"|  | cloth: {heads} | rope: {heads} |"
    rest = "3.1 % | +20.0 (+10.0 to +30.0)"
    assert lines[2].startswith(f"| true matches | 80 % (70 to 90) | 100 % (44 to 100) | {rest} | 80 %")
    assert lines[3] == f"| MMGSD, modes that agree | 75 % (65 to 85) | 67 % (21 to 94) | {rest} | – | – | – | – |"
    assert len(lines) == 4


def test_grounds_and_starts_are_told_apart_of_all_rollouts() -> None:
    lines = to_markdown(describe_starts(RESULTS)).splitlines()
    heads = ("plain", "workspace", "flat", "wrinkled", "corner")
    assert lines[0].startswith(f"|  | {' | '.join(f'cloth: {head}' for head in heads)} | rope: plain")
    assert lines[3] == "| MMGSD, modes that agree | 1 of 2 | 1 of 1 | 2 of 2 | 0 of 1 | – | – | – | – | – | – |"


def test_rollouts_that_a_policy_lacks_are_left_out_of_all() -> None:
    few = row(0.5)
    del few["rollouts"]["edge-flat-plain-0"]
    results = {"policies": {**RESULTS["policies"], "cloth": {**RESULTS["policies"]["cloth"], "spcl": few}}}
    assert to_markdown(describe_starts(results)).splitlines()[2].startswith("| true matches | 1 of 1 | 1 of 1 |")


def test_a_grasp_has_its_distance_and_what_it_lifts() -> None:
    assert describe_grasps({}) == "*Not measured yet.*"
    way = {"distance": mean(0.031), "beyond": mean(-0.02), "lifted": mean(0.5)}
    assert to_markdown(describe_grasps({"grasp": {"spcl": {"surest": way}}})).splitlines()[2:] == [
        "| SPCL, the surest corner | 3.1 % | −2.0 (−12.0 to +8.0) | 50 % (40 to 60) |"
    ]


def test_counts_caution_and_pairs_are_said() -> None:
    results = {**RESULTS, "policies": {**RESULTS["policies"]}}
    results["policies"]["cloth"] = {**results["policies"]["cloth"], "spcl": row(0.5)}
    assert make_folding_sentence(results) == (
        "Cloth: 8 of 10 rollouts count; MMGSD succeeds in 90 % of the 5 whose modes agree most. "
        "Rope: 8 of 10 rollouts count."
    )


def test_rollouts_of_which_none_counts_are_dashes() -> None:
    part = RESULTS["policies"]["cloth"]["truth"]["all"]
    rows = {"truth": {"all": part, "cautious": {"count": 0}, "beyond": {}, "rollouts": {}}}
    results = {"run": RESULTS["run"], "policies": {"cloth": rows, "rope": rows}}
    assert to_markdown(describe_folding(results)).splitlines()[2] == f"| true matches |{' – |' * 8}"
    assert "0 of 10 rollouts count" in make_folding_sentence(results)
