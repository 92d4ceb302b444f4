"""The table of the folding bench (`mmgsd.fold.rollouts`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.fold.policies import POLICIES

Results = Mapping[str, Any]  # data/results/<preset>/folding.json
HEADS = ("success", "error", "overlap", "error of all")
COMPARED = {"mmgsd_joint": "the surest joint answer",
            "mmgsd_best": "each pixel's surest mode", "spcl": "SPCL"}  # with MMGSD's agreeing modes  # fmt: skip


def make_folding_table(results: Results) -> str:
    """Markdown, a row a policy: success, error and overlap of the rollouts that count, and the error of all.

    Those count that the true matches succeed in, and that are no success before anything is done. With 95 % intervals
    of the success; what was not measured is a dash.
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
    """How many rollouts count, what caution brings, and the difference of others' errors from that of MMGSD's."""
    said = [f"{object.capitalize()}: {_say_object(results['policies'][object])}" for object in OBJECTS]
    return f"{'. '.join(said)}."


def _say_object(rows: Mapping[str, Any]) -> str:
    truth = rows["truth"]
    counted = truth["reachable"]["success"]["count"] if "reachable" in truth else 0
    parts = [f"{counted} of {truth['all']['success']['count']} rollouts count"]
    sure = rows.get("mmgsd", {}).get("cautious", {"count": 0})
    if sure["count"]:
        parts.append(f"MMGSD succeeds in {100 * sure['mean']:.0f} % of the {sure['count']} whose modes agree most")
    for name, label in COMPARED.items():
        more = rows.get(name, {}).get("beyond", {"error": {"count": 0}})["error"]
        if more["count"]:
            mean, low, high = (f"{100 * more[key]:+.1f}".replace("-", "−") for key in ("mean", "low", "high"))
            parts.append(f"{mean} points ({low} to {high}) of error by {label}")
    return "; ".join(parts)


def _list_cells(row: Mapping[str, Any] | None) -> list[str]:
    if not row or "reachable" not in row:
        return ["–"] * len(HEADS)
    found = row["reachable"]
    success = found["success"]
    interval = f"{100 * success['mean']:.0f} % ({100 * success['low']:.0f} to {100 * success['high']:.0f})"
    means = (found["error"], found["overlap"], row["all"]["error"])
    return [interval, *(f"{100 * value['mean']:.1f} %" for value in means)]
