"""The tables of Markdown files, made from the results: ``python -m mmgsd.report.tables data/results README.md``."""

from __future__ import annotations

import argparse
import re
import statistics
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from mmgsd.command import run_command
from mmgsd.experiments import MODELS, UNTRAINED, get_label
from mmgsd.files import write_text
from mmgsd.report.findings import make_claims_table, make_findings
from mmgsd.report.results import PAPER, load_results, read_table, told_where
from mmgsd.report.shipped import (
    make_counts_sentence,
    make_knowledge_table,
    make_parts_table,
    make_pictures_table,
    make_sources_sentence,
)

TABLED = ("main", "robustness", "hand_made", "chance")
LABELS = {row.name: row.label for row in (*MODELS, *UNTRAINED) if {*row.studies} & {*TABLED}}  # rows in their order
HEADLINE = ("mmgsd", "mmgsd_long", "mmgsd_fine_deep", "spcl_dense", "spcl", "unimodal", "pcl", "sift", "centre")
LONGER_ROWS = ("mmgsd", "mmgsd_deep", "mmgsd_long", "mmgsd_fine", "mmgsd_fine_deep", "mmgsd_muon")

Errors = dict[str, dict[str, dict[str, float]]]  # {object: {method, or σ: {metric: value}}}


def make_results_table(results: Errors, *, paper: bool = True) -> str:
    """Markdown of RMSE, median and pck of both objects, a method a row; ``paper`` adds the paper's own errors."""
    lines = _make_lines("", results, LABELS)
    if paper:
        theirs = [f"*{PAPER[object]}* | – | –" for object in PAPER]
        lines.append(f"| *the paper's MMGSD, 3,500 images each* | {' | '.join(theirs)} |")
    return "\n".join(lines)


def make_headline(results: Errors) -> str:
    """`make_results_table` of the rows that the README has room for."""
    return make_results_table(_keep(results, HEADLINE))


def make_presets_table(results: dict[str, Errors]) -> str:
    """Markdown of MMGSD's RMSE px by preset, from {path of the results file: errors}."""
    lines = ["| preset | MMGSD's RMSE px: cloth | rope |", "|---|---|---|"]
    for path, errors in results.items():
        cells = " | ".join(f"{errors[name]['mmgsd']['rmse_mean']:.0f}" for name in PAPER)
        lines.append(f"| `{Path(path).parent}` | {cells} |")
    return "\n".join(lines)


def make_longer_table(results: Errors) -> str:
    """`make_budget_table` of MMGSD alone, as it was trained longer and otherwise."""
    return make_budget_table(_keep(results, LONGER_ROWS))


def _keep(results: Errors, methods: Collection[str]) -> Errors:
    return {name: {key: row for key, row in rows.items() if key in methods} for name, rows in results.items()}


def make_errors_table(results: dict[str, dict[str, float]]) -> str:
    """Markdown of MMGSD's RMSE px over some of the queries, from {object: {which queries: error}}."""
    lines = ["| MMGSD's RMSE px | cloth | rope |", "|---|---|---|"]
    for queries in dict.fromkeys(queries for row in results.values() for queries in row):
        errors = (results.get(name, {}).get(queries) for name in PAPER)
        lines.append(f"| {queries} | {' | '.join('–' if error is None else f'{error:.1f}' for error in errors)} |")
    return "\n".join(lines)


def make_places_table(results: dict[str, Any]) -> str:
    """Markdown of MMGSD's mean error px by place on the object, from what `load_results` measured."""
    lines = ["| place | RMSE px |", "|---|---|"]
    return "\n".join(lines + [f"| {name}: {place} | {error:.1f} |"
                              for name, row in results["places"].items() for place, error in row.items()])  # fmt: skip


def make_budget_table(results: Errors) -> str:
    """`make_results_table` without the paper's errors, which are not of this smaller budget."""
    return make_results_table(results, paper=False)


def make_sigma_table(results: Errors) -> str:
    """The same measures of MMGSD by the std of its targets."""
    sigmas = sorted({sigma for rows in results.values() for sigma in rows}, key=float)
    return "\n".join(_make_lines("σ px", results, {sigma: sigma for sigma in sigmas}))


def make_seed_table(results: Errors) -> str:
    """Markdown of the mean and the std of the RMSE over seeds, from {object: {"mmgsd-0": errors}}, a method a row."""
    lines = ["| RMSE px: mean ± std (seeds) | cloth | rope |", "|---|---|---|"]
    for method, label in LABELS.items():
        errors = [_collect_seeds(results.get(object, {}), method) for object in PAPER]
        if any(errors):
            lines.append(f"| {label} | {' | '.join(_format_seeds(values) for values in errors)} |")
    return "\n".join(lines)


def _collect_seeds(rows: dict[str, dict[str, float]], method: str) -> list[float]:
    """The method's RMSE (px) with each seed, of {"mmgsd-0": errors, "mmgsd-1": …}."""
    return [row["rmse_mean"] for key, row in rows.items() if key.rpartition("-")[0] == method]


def _format_seeds(values: list[float]) -> str:
    """Mean, std of the sample, and how many: "54.6 ± 0.8 (3)"; no std of fewer than two."""
    if len(values) < 2:
        return f"{values[0]:.1f} (1)" if values else "–"
    return f"{statistics.mean(values):.1f} ± {statistics.stdev(values):.1f} ({len(values)})"


def make_symmetry_table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown from {group: errors, and under "regions" those by place}, a group a row."""
    lines = ["| taught and asked | all | corners | edges | interior |", "|---|---|---|---|---|"]
    for group, row in results.items():
        errors = [row["rmse_mean"], *(row["regions"][region]["rmse_px"] for region in ("corner", "edge", "interior"))]
        lines.append(f"| {get_label(group)} | {' | '.join(f'{error:.1f}' for error in errors)} |")
    return "\n".join(lines)


def make_fixes_table(results: dict[str, dict[str, float]]) -> str:
    """Markdown of PCL's errors with and without the ways to break the symmetry: {images: errors}, a row each."""
    lines = ["| images | RMSE px | median px | pck@20px | nearest match px | the right one |", "|---" * 6 + "|"]
    for images, row in results.items():
        lines.append(f"| {images} | {_format_errors(row)} | {row['nearest_of_all']:.1f} | {100 * row['right']:.0f} % |")
    return "\n".join(lines)


def _make_lines(first: str, results: Errors, labels: dict[str, str]) -> list[str]:
    """A heading, and a row for each label whose key is in the results; a dash stands for what has not been run."""
    measures = "RMSE px | median px | pck@20px"
    heads = [f"{object}: {measures}" for object in PAPER]
    lines = [f"| {first}".rstrip() + f" | {' | '.join(heads)} |", "|---" * 7 + "|"]
    for key, label in labels.items():
        rows = [results.get(object, {}).get(key) for object in PAPER]
        if any(rows):
            cells = [_format_errors(row) if row else "– | – | –" for row in rows]
            lines.append(f"| {label} | {' | '.join(cells)} |")
    return lines


def _format_errors(row: dict[str, float]) -> str:
    return f"{row['rmse_mean']:.1f} | {row['median']:.1f} | {100 * row['pck@20px']:.0f} %"


def make_uncertainty_table(results: dict[str, dict[str, dict[str, dict[str, float | None]]]]) -> str:
    """Markdown from {"calibrated" or "temperature 1": {object: {method: {measure: value}}}}, a method a row."""
    lines = [
        "| | | Spearman | AURC px | 90 % ellipses hold | ECE | AUROC occluded |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, methods in results["calibrated"].items():
        for method, label in LABELS.items():
            if method in methods:
                before = results["temperature 1"][name].get(method)
                lines.append(f"| {name} | {label} | {_format_uncertainty(methods[method], before)} |")
    return "\n".join(lines)


def _format_uncertainty(after: dict[str, float | None], before: dict[str, float | None] | None) -> str:
    def change(key: str, scale: float, form: str) -> str:
        values = [after[key]] if before is None else [before[key], after[key]]
        return " → ".join("–" if v is None else format(scale * v, form) for v in values)

    measures = [f"{after['spearman']:.2f}", f"{after['aurc']:.1f} of {after['aurc_random']:.1f}"]
    measures += [change("coverage@90%", 100, ".0f") + " %", change("ece", 1, ".2f")]
    return " | ".join([*measures, "–" if after["auroc_occluded"] is None else f"{after['auroc_occluded']:.2f}"])


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
            return marked["begin"] + make(values) + marked["end"]

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
TABLES: dict[str, tuple[str | tuple[str, ...], Callable[[Any], str]]] = {
    "presets": (("quick/rmse.json", "paper/rmse.json"), make_presets_table),
    "findings": ("paper", make_findings),
    "claims": ("paper", make_claims_table),
    "headline": ("paper/rmse.json", make_headline),
    "paper": ("paper/rmse.json", make_results_table),
    "longer": ("paper/rmse.json", make_longer_table),
    "errors": ("paper/errors.json", make_errors_table),
    "places": ("paper", make_places_table),
    "budget": ("paper/budget.json", make_budget_table),
    "robustness": ("paper/robustness.json", make_budget_table),
    "sigma": ("paper/sigma.json", make_sigma_table),
    "sigma_4000": ("paper/sigma_4000.json", make_sigma_table),
    "symmetry": ("paper/symmetry.json", make_symmetry_table),
    "fixes": ("paper/broken_symmetry.json", make_fixes_table),
    "seeds_1000": ("paper/seeds_1000.json", make_seed_table),
    "quick": ("quick/rmse.json", make_results_table),
    "seeds_quick": ("quick/seeds.json", make_seed_table),
    "uncertainty": ("paper/uncertainty.json", make_uncertainty_table),
    "pictures": ("shipped.json", make_pictures_table),
    "parts": ("shipped.json", make_parts_table),
    "knowledge": ("shipped.json", make_knowledge_table),
    "sources": ("shipped.json", make_sources_sentence),
    "counts": ("shipped.json", make_counts_sentence),
}


def main() -> None:
    """Update the tables of some documents."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.report.tables", description=__doc__)
    parser.add_argument("results", type=Path, help="the folder of results, data/results")
    parser.add_argument("documents", type=Path, nargs="+", help="Markdown files that mark tables")
    args = parser.parse_args()
    for document in args.documents:
        update_tables(document, args.results)


if __name__ == "__main__":
    run_command(main)
