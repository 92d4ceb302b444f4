"""What was found, in sentences whose numbers come from the results, and the table of the paper's claims.

Each study judges its claims, by a rule that is written there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.studies.claims import NOT_MEASURED, Claim, get
from mmgsd.studies.registry import list_studies
from mmgsd.studies.table import Column, Table

DETAIL = "data/results/README.md"  # seen from the README


def list_claims(results: Mapping[str, Any]) -> list[Claim]:
    """Every claim, judged from {name of the results file: its content}."""
    return [judge(results) for study in list_studies() for judge in study.claims]


def make_findings(results: Mapping[str, Any]) -> str:
    """A Markdown list of the main findings, each with a link to its section of the results page."""
    found = sorted((f for study in list_studies() for f in study.findings), key=lambda finding: finding.place)
    return "\n".join(f"- [**{f.name}**]({DETAIL}#{f.section}){f.sentence.format(**f.count(results))}" for f in found)


def describe_claims(results: Mapping[str, Any]) -> Table:
    """The paper's claims: the rule, verdict, what was measured, what repeats it, minutes of training."""
    columns = [
        Column("rule", "counts as held where"), Column("verdict", "verdict", "here"),
        Column("measured", "measured", "measured"), Column("command", page="repeat it by"),
        Column("minutes", page="minutes"),
    ]  # fmt: skip
    rows = {}
    for study in list_studies():
        for claim in (judge(results) for judge in study.claims):
            measured = "no results for this preset" if claim.verdict == NOT_MEASURED else claim.measured
            said = {"rule": claim.rule, "verdict": f"**{claim.verdict}**", "measured": measured}
            command = claim.command or f"`{study.notebook}`"
            rows[claim.claim] = {"": {**said, "command": command, "minutes": sum_minutes(results, claim)}}
    return Table("claim", {"": columns}, rows)


def sum_minutes(results: Mapping[str, Any], claim: Claim) -> str:
    """Minutes that training a claim's models took, of both objects together; a dash where no file says."""
    runs = [get(results, "runs", f"{name}-{model}") for name in OBJECTS for model in claim.models]
    if claim.runs:
        rows = results.get(claim.runs, {})
        parts = [rows[name] for name in OBJECTS if name in rows] or [rows]
        runs = [row.get("run") for part in parts for row in part.values()]
    known = [run["minutes"] for run in runs if run]
    return f"{sum(known):.0f}" if known else "–"
