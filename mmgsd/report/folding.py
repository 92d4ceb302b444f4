"""The table of the folding bench (`mmgsd.fold.rollouts`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.fold.policies import POLICIES

Results = Mapping[str, Any]  # data/results/<preset>/folding.json
HEADS = ("success", "error", "overlap")


def make_folding_table(results: Results) -> str:
    """Markdown, a row a policy: success, error and overlap of the rollouts that the true matches succeed in.

    With 95 % intervals of the success; what was not measured is a dash.
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
    """How many rollouts there were and how many of them the true matches succeed in; what caution brings."""
    said, rows = [], results["policies"]
    for object in OBJECTS:
        reachable = rows[object]["truth"].get("reachable", rows[object]["truth"]["all"])["success"]["count"]
        sure = rows[object].get("mmgsd", {}).get("cautious", {"count": 0})
        caution = f", and MMGSD {100 * sure['mean']:.0f} % of the {sure['count']} it agrees on" if sure["count"] else ""
        count = rows[object]["truth"]["all"]["success"]["count"]
        said.append(f"{object}: the true matches succeed in {reachable} of {count}{caution}")
    run = results["run"]
    return f"Rollouts: {'; '.join(said)} ({run['minutes']:g} minutes, {run['hardware']})."


def _list_cells(row: Mapping[str, Any] | None) -> list[str]:
    found = (row or {}).get("reachable")
    if not found:
        return ["–"] * len(HEADS)
    success = found["success"]
    interval = f"{100 * success['mean']:.0f} % ({100 * success['low']:.0f} to {100 * success['high']:.0f})"
    return [interval, *(f"{100 * found[key]['mean']:.1f} %" for key in HEADS[1:])]
