"""The tables of the folding bench (`mmgsd.studies.folding`) and of single grasps (`mmgsd.studies.grasp`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.fold.measures import estimate_share
from mmgsd.fold.tasks import GROUNDS, STARTS
from mmgsd.studies.policies import POLICIES

Results = Mapping[str, Any]  # data/results/<preset>/folding.json
HEADS = ("success", "as true matches", "error", "beside MMGSD's", "error of all")
SLACK = 0.03  # of the side, by which an error may be above that of the true matches and be as good
GRASPERS = {"mmgsd": "MMGSD", "mmgsd_paper": "MMGSD of clean images alone", "spcl": "SPCL"}
WAYS = {"surest": "the surest corner", "probable": "the most probable", "any": "any"}


def make_folding_table(results: Results) -> str:
    """Markdown, a row a policy: success and error of the rollouts that count; how many of all end as true matches do.

    Those count that the true matches succeed in, and that are no success before anything is done; all, with an error
    at most `SLACK` above that of the true matches, end as these. With 95 % intervals, of shares Wilson's; what was not
    measured is a dash.
    """
    heads = ["", *(f"{name}: {head}" if head == HEADS[0] else head for name in OBJECTS for head in HEADS)]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    rows = results["policies"]
    for name, policy in POLICIES.items():
        found = [rows[object].get(name) for object in OBJECTS]
        if any(found):
            cells = [cell for object, row in zip(OBJECTS, found, strict=True)
                     for cell in _list_cells(row, _list_like_truth(rows[object], name))]  # fmt: skip
            lines.append(f"| {policy.label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def make_starts_table(results: Results) -> str:
    """Markdown, a row a policy: how many rollouts end as true matches do, by ground and by start, of all."""
    places = {object: (*GROUNDS, *(start.replace(" ", "_") for start in STARTS[object])) for object in OBJECTS}
    heads = [f"{object}: {place.replace('_', ' ')}" for object in OBJECTS for place in places[object]]
    lines = [f"|  | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    for name, policy in POLICIES.items():
        like = {object: _list_like_truth(results["policies"][object], name) for object in OBJECTS}
        if any(like.values()):
            cells = [_count([same for key, same in like[object].items() if place in key.split("-")[1:3]])
                     for object in OBJECTS for place in places[object]]  # fmt: skip
            lines.append(f"| {policy.label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def make_grasp_table(results: Results) -> str:
    """Markdown of single grasps, a row a matcher and way: distance to the nearest corner, beside any mode, lifted.

    ``results`` as `mmgsd.report.results.load_results` has them.
    """
    if "grasp" not in results:
        return "*Not measured yet.*"
    lines = ["|  | distance | beside any | lifted |", "|---|---|---|---|"]
    for name, label in GRASPERS.items():
        for way, row in results["grasp"].get(name, {}).items():
            cells = (f"{100 * row['distance']['mean']:.1f} %", _say_beyond(row["beyond"]), _say_share(row["lifted"]))
            lines.append(f"| {label}, {WAYS[way]} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _list_like_truth(rows: Mapping[str, Any], name: str) -> dict[str, bool]:
    """Whether each rollout that all policies have ends as the true matches do; {} of a policy without any."""
    if name not in rows or "truth" not in rows:
        return {}
    truth, ours = rows["truth"]["rollouts"], rows[name]["rollouts"]
    shared = [key for key in truth if all(key in row["rollouts"] for row in rows.values())]
    return {key: ours[key][0] <= truth[key][0] + SLACK for key in shared}


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


def _list_cells(row: Mapping[str, Any] | None, like: Mapping[str, bool]) -> list[str]:
    if not row or "reachable" not in row:
        return ["–"] * len(HEADS)
    success, same = _say_share(row["reachable"]["success"]), _say_share(estimate_share(list(like.values())))
    error, every = (f"{100 * row[part]['error']['mean']:.1f} %" for part in ("reachable", "all"))
    return [success, same, error, _say_beyond(row["beyond"]["error"]), every]


def _say_share(share: Mapping[str, Any]) -> str:
    if share["mean"] is None:
        return "–"
    return f"{100 * share['mean']:.0f} % ({100 * share['low']:.0f} to {100 * share['high']:.0f})"


def _say_beyond(more: Mapping[str, Any]) -> str:
    """A difference in points, with its interval."""
    numbers = (f"{100 * more[key]:+.1f}".replace("-", "−") for key in ("mean", "low", "high"))
    return "{} ({} to {})".format(*numbers)


def _count(values: Sequence[bool]) -> str:
    return f"{sum(values)} of {len(values)}" if values else "–"
