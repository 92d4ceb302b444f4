"""The tables of Markdown files, made from the results: ``python -m mmgsd tables data/results README.md``.

What was found, and the paper's claims, are made from the results of all studies, which judge their claims by a rule.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from mmgsd.command import Option
from mmgsd.config import OBJECTS
from mmgsd.files import write_text
from mmgsd.studies.claims import NOT_MEASURED, Claim, get
from mmgsd.studies.registry import Results, Shown, list_studies, load_results, read_table, told_where
from mmgsd.studies.table import Column, Table, to_markdown

DETAIL = "data/results/README.md"  # seen from the README
BEGIN, END = "<!-- NAME: made by `make readme` -->", "<!-- end of NAME -->"
MARKED = re.compile(
    r"(?P<begin><!-- (?P<name>\w+): made by `make readme` -->\n).*?(?P<end>\n<!-- end of (?P=name) -->)", re.DOTALL
)


def list_claims(results: Results) -> list[Claim]:
    """Every claim, judged from {name of the results file: its content}."""
    return [judge(results) for study in list_studies() for judge in study.claims]


def describe_findings(results: Results) -> Table:
    """The main findings, each with a link to its section of the results page."""
    findings = sorted((f for study in list_studies() for f in study.findings), key=lambda finding: finding.place)
    columns = [Column(key, page=key, optional=True) for key in (*OBJECTS, "seeds")]
    rows = {f"[{f.name}]({DETAIL}#{f.section}){f.text}": {"": f.count(results)} for f in findings}
    return Table("finding", {"": columns}, rows)


def describe_claims(results: Results) -> Table:
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
            cells = {"rule": claim.rule, "verdict": f"**{claim.verdict}**", "measured": measured}
            command = claim.command or f"`{study.notebook}`"
            rows[claim.claim] = {"": {**cells, "command": command, "minutes": sum_minutes(results, claim)}}
    return Table("claim", {"": columns}, rows)


def sum_minutes(results: Results, claim: Claim) -> str:
    """Minutes that training a claim's models took, of both objects together; a dash where no file says."""
    runs = [get(results, "runs", f"{name}-{model}") for name in OBJECTS for model in claim.models]
    if claim.runs:
        rows = results.get(claim.runs, {})
        parts = [rows[name] for name in OBJECTS if name in rows] or [rows]
        runs = [row.get("run") for part in parts for key, row in part.items()
                if not claim.models or key.rpartition("-")[0] in claim.models]  # fmt: skip
    minutes = [run["minutes"] for run in runs if run]
    return f"{sum(minutes):.0f}" if minutes else "–"


def list_tables() -> dict[str, Shown]:
    """{name by which documents mark it: table or sentence} of all studies, and of what is made from all of them."""
    tables = {name: table for study in list_studies() for name, table in study.tables.items()}
    return tables | {"findings": Shown("paper", describe_findings), "claims": Shown("paper", describe_claims)}


def update_tables(document: Path, results: Path) -> None:
    """Make every marked table of a Markdown file anew from the folder of results.

    Raises ValueError where the file marks no table, or one that `list_tables` does not have, DamagedFileError where a
    results file is damaged.
    """
    entries = list_tables()

    def fill(marked: re.Match[str]) -> str:
        """What stands between two marks, made anew."""
        if marked["name"] not in entries:
            raise ValueError(f"{document} marks a table {marked['name']!r}, accepted are {', '.join(entries)}")
        file, make = entries[marked["name"]].file, entries[marked["name"]].make
        with told_where(results / file if isinstance(file, str) else results):
            return marked["begin"] + to_markdown(make(_read(results, file))) + marked["end"]

    text, tables = MARKED.subn(fill, document.read_text())
    if not tables or text.count("made by `make readme`") != tables:
        raise ValueError(f"{document} must hold at least one table, each between {BEGIN!r} and {END!r}")
    write_text(document, text)


def _read(results: Path, file: str | tuple[str, ...]) -> dict[str, Any]:
    """A results file; all of a preset's, where a folder is named; or {name: content} of several files."""
    if not isinstance(file, str):
        return {name: read_table(results / name) for name in file}
    return load_results(results / file) if (results / file).is_dir() else read_table(results / file)


def main(
    results: Annotated[Path, Option("the folder of results, data/results")],
    *documents: Annotated[Path, Option("Markdown files that mark tables")],
) -> None:
    """Update the tables of some documents."""
    for document in documents:
        update_tables(document, results)
