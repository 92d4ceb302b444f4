"""The table of the folding bench (`mmgsd.fold.rollouts`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.fold.policies import POLICIES

Results = Mapping[str, Any]  # data/results/<preset>/folding.json
HEADS = ("success", "error", "beside MMGSD's", "overlap", "error of all")


def make_folding_table(results: Results) -> str:
    """Markdown, a row a policy: success, error and overlap of the rollouts that count, and the error of all.

    Those count that the true matches succeed in, and that are no success before anything is done. With 95 % intervals
    of the success and of the difference from the error of MMGSD's modes that agree; what was not measured is a dash.
    """
    heads = ["", *(f"{name}: {head}" if head == HEADS[0] else head for name in OBJECTS for head in HEADS)]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    rows = results["policies"]
    for name, policy in POLICIES.items():
        found = [rows[object].get(name) for object in OBJECTS]
        if any(found):
            cells = [cell for row in found for cell in _list_cells(row)]
            lines.append(f"| {policy.label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def make_folding_sentence(results: Results) -> str:
    """How many rollouts count, and what caution brings."""
    said = [f"{object.capitalize()}: {_say_object(results['policies'][object])}" for object in OBJECTS]
    return f"{'. '.join(said)}."


def _say_object(rows: Mapping[str, Any]) -> str:
    truth = rows["truth"]
    counted = truth["reachable"]["success"]["count"] if "reachable" in truth else 0
    parts = [f"{counted} of {truth['all']['success']['count']} rollouts count"]
    sure = rows.get("mmgsd", {}).get("cautious", {"count": 0})
    if sure["count"]:
        parts.append(f"MMGSD succeeds in {100 * sure['mean']:.0f} % of the {sure['count']} whose modes agree most")
    return "; ".join(parts)


def _list_cells(row: Mapping[str, Any] | None) -> list[str]:
    if not row or "reachable" not in row:
        return ["–"] * len(HEADS)
    found = row["reachable"]
    success = found["success"]
    interval = f"{100 * success['mean']:.0f} % ({100 * success['low']:.0f} to {100 * success['high']:.0f})"
    more = row["beyond"]["error"]
    beside = "{} ({} to {})".format(*(f"{100 * more[key]:+.1f}".replace("-", "−") for key in ("mean", "low", "high")))
    shares = (found["error"], found["overlap"], row["all"]["error"])
    error, overlap, every = (f"{100 * value['mean']:.1f} %" for value in shares)
    return [interval, error, beside, overlap, every]
