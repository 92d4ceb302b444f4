"""The tables of Markdown files, made from the results: ``python -m mmgsd tables data/results README.md``."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from mmgsd.command import Option
from mmgsd.files import write_text
from mmgsd.report import descriptions as described
from mmgsd.report.findings import describe_claims, make_findings
from mmgsd.report.results import load_results, read_table, told_where
from mmgsd.studies.folding_tables import make_folding_sentence, make_folding_table, make_grasp_table, make_starts_table
from mmgsd.studies.joint import make_joint_sentence, make_joint_table
from mmgsd.studies.shipped import (
    make_budget_sentence,
    make_by_source_table,
    make_cloth_renders_table,
    make_counts_sentence,
    make_knowledge_table,
    make_limits_table,
    make_parts_table,
    make_pictures_table,
    make_reading_sentence,
    make_readings_table,
    make_sources_sentence,
)


def to_markdown(table: described.Table) -> str:
    """A described table as Markdown: parts beside each other name their first column, those below have one for it."""
    layout = described.lay_out(table, page=True)
    heads = [f"{title}: {head}" if layout.beside and not k else head
             for title, block in layout.blocks for k, head in enumerate(block)]  # fmt: skip
    stacked = len(table.parts) > 1 and not layout.beside
    lines = [[title, *line] if stacked else line for title, lines in layout.sections for line in lines]
    heads = ["", table.first, *heads] if stacked else [table.first, *heads]
    return "\n".join([_join(heads), "|---" * len(heads) + "|", *map(_join, lines)])


def _join(cells: Sequence[str]) -> str:
    return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"


def update_tables(document: Path, results: Path) -> None:
    """Make every marked table of a Markdown file anew from the folder of results.

    Raises ValueError where the file marks no table, or one that `TABLES` does not have, DamagedFileError where a
    results file is damaged.
    """

    def fill(marked: re.Match[str]) -> str:
        if marked["name"] not in TABLES:
            raise ValueError(f"{document} marks a table {marked['name']!r}, accepted are {', '.join(TABLES)}")
        file, make = TABLES[marked["name"]]
        with told_where(results / file if isinstance(file, str) else results):
            values = _read(results, file)
            made = make(values)
            return marked["begin"] + (made if isinstance(made, str) else to_markdown(made)) + marked["end"]

    text, tables = MARKED.subn(fill, document.read_text())
    if not tables or text.count("made by `make readme`") != tables:
        raise ValueError(f"{document} must hold at least one table, each between {BEGIN!r} and {END!r}")
    write_text(document, text)


def _read(results: Path, file: str | tuple[str, ...]) -> dict[str, Any]:
    """A results file; all of a preset's, where a folder is named; or {name: content} of several files."""
    if not isinstance(file, str):
        return {name: read_table(results / name) for name in file}
    return load_results(results / file) if (results / file).is_dir() else read_table(results / file)


BEGIN, END = "<!-- NAME: made by `make readme` -->", "<!-- end of NAME -->"
MARKED = re.compile(
    r"(?P<begin><!-- (?P<name>\w+): made by `make readme` -->\n).*?(?P<end>\n<!-- end of (?P=name) -->)", re.DOTALL
)
TABLES: dict[str, tuple[str | tuple[str, ...], Callable[[Any], described.Table | str]]] = {
    "presets": (("quick/rmse.json", "paper/rmse.json"), described.describe_presets),
    "findings": ("paper", make_findings),
    "claims": ("paper", describe_claims),
    "headline": ("paper/rmse.json", partial(described.describe_main, methods=described.HEADLINE)),
    "paper": ("paper/rmse.json", described.describe_main),
    "longer": ("paper/rmse.json", partial(described.describe_budget, methods=described.LONGER_ROWS)),
    "errors": ("paper/errors.json", described.describe_difficulties),
    "places": ("paper", described.describe_places),
    "budget": ("paper/budget.json", described.describe_budget),
    "robustness": ("paper/robustness.json", described.describe_budget),
    "sigma": ("paper/sigma.json", described.describe_sigma),
    "sigma_4000": ("paper/sigma_4000.json", described.describe_sigma),
    "symmetry": ("paper/symmetry.json", described.describe_symmetry),
    "fixes": ("paper/broken_symmetry.json", described.describe_fixes),
    "seeds_1000": ("paper/seeds_1000.json", described.describe_seeds),
    "first_seed": ("paper/seeds_1000.json", described.make_first_seed_sentence),
    "quick": ("quick/rmse.json", described.describe_main),
    "seeds_quick": ("quick/seeds.json", described.describe_seeds),
    "uncertainty": ("paper/uncertainty.json", described.describe_uncertainty),
    "folding": ("paper/folding.json", make_folding_table),
    "folding_counts": ("paper/folding.json", make_folding_sentence),
    "folding_starts": ("paper/folding.json", make_starts_table),
    "grasp": ("paper", make_grasp_table),
    "joint": ("joint.json", make_joint_table),
    "joint_counts": ("joint.json", make_joint_sentence),
    "limits": ("shipped.json", make_limits_table),
    "pictures": ("shipped.json", make_pictures_table),
    "parts": ("shipped.json", make_parts_table),
    "readings": ("shipped.json", make_readings_table),
    "budget_of_parts": ("shipped.json", make_budget_sentence),
    "knowledge": ("shipped.json", make_knowledge_table),
    "sources": ("shipped.json", make_sources_sentence),
    "by_source": ("shipped.json", make_by_source_table),
    "counts": ("shipped.json", make_counts_sentence),
    "alike": ("shipped.json", make_reading_sentence),
    "cloth_renders": ("shipped.json", make_cloth_renders_table),
}


def main(
    results: Annotated[Path, Option("the folder of results, data/results")],
    *documents: Annotated[Path, Option("Markdown files that mark tables")],
) -> None:
    """Update the tables of some documents."""
    for document in documents:
        update_tables(document, results)
