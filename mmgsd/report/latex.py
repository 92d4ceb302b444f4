"""The replication report's numbers, tables and verdicts, made from a preset's results: LaTeX for paper/report.tex.

    python -m mmgsd latex quick        data/results/quick -> paper/generated/results.tex, main_table.tex, …

A stage that was not run for the preset leaves no results file: its table then says so, and the report still builds.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mmgsd.config import IMAGE_SIZE, load_preset
from mmgsd.files import write_text
from mmgsd.paths import Paths, find_root
from mmgsd.report.tables import describe_claims, list_claims
from mmgsd.studies.registry import Results, Shown, list_studies, load_results, told_where
from mmgsd.studies.seeds import list_means
from mmgsd.studies.table import Table, lay_out

NOT_RUN = r"\emph{Not run for this preset.}"
RULE = r"\midrule"
SPECIAL = {c: rf"\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "°": r"$^\circ$",
    "→": r"$\to$", "σ": r"$\sigma$", "×": r"$\times$", "≤": r"$\le$", "–": "--",
}  # fmt: skip
MARKUP = {  # of escaped text
    r"`(.+?)`": r"\\texttt{\1}", r"\*\*(.+?)\*\*": r"\\textbf{\1}", r"\*(.+?)\*": r"\\emph{\1}",
    r"(?<=\d) \\%": r"\\,\\%", r"(?<=\d) (px|nats)\b": r"~\1", r" (\$\\to\$) ": r"\\,\1\\,", r"(?<!\w)-(?=\d)": "$-$",
}  # fmt: skip
WIDE = [rf">{{\hsize={width:g}\hsize}}L" for width in (0.8, 1.05, 1.15)]  # of claims, that they fit a page
CLAIMS = rf"@{{}}{WIDE[0]}{WIDE[1]}>{{\raggedright\arraybackslash}}p{{6.3em}}{WIDE[2]}@{{}}"


def list_tables() -> dict[str, Shown]:
    """{what is input: table} of all studies that the report shows."""
    return {table.report: table for study in list_studies() for table in study.tables.values() if table.report}


def write_report(preset: str, root: Path) -> list[Path]:
    """Write everything that the report inputs into ``paper/generated``; ValueError for an unknown preset.

    DamagedFileError, which names the file or the folder, where a number is missing or is none.
    """
    config, paths = load_preset(preset), Paths(root, preset)
    results = load_results(paths.results)
    with told_where(paths.results):
        claims = list_claims(results)
        described = dataclasses.asdict(config) | {"image_size": IMAGE_SIZE}
        numbers = {**results, "config": described, "verdict": {claim.key: claim.verdict for claim in claims},
                   "means": list_means(results)}  # fmt: skip
        table = to_latex(describe_claims(results), CLAIMS)
        texts = {"results": make_definitions(preset, numbers), "claims_table": table}
    for name, table in list_tables().items():
        file = Path(table.file).name
        with told_where(paths.results / file):
            content = results.get(Path(file).stem)
            texts[name] = NOT_RUN if content is None else to_latex(table.make(content))
    return [write_text(root / "paper" / "generated" / f"{name}.tex", f"{text}\n") for name, text in texts.items()]


def flatten(tree: Mapping[str, Any] | Sequence[Any], prefix: str = "") -> dict[str, str]:
    """{"file/key/.../metric": value as LaTeX} of nested results; what is None is left out.

    Keys keep letters, digits, ``@``, ``_`` and points, all else is a hyphen: "cloth, ±45° only" is "cloth-45-only".
    Raises ValueError where two keys become one.
    """
    flat: dict[str, str] = {}
    for key, value in _walk(tree, prefix):
        if key in flat:
            raise ValueError(f"two results have the one name {key!r}")
        flat[key] = value
    return flat


def _walk(tree: Any, prefix: str) -> Iterator[tuple[str, str]]:
    if isinstance(tree, Mapping | list | tuple):
        pairs = tree.items() if isinstance(tree, Mapping) else enumerate(tree)
        for key, value in pairs:
            name = re.sub(r"[^A-Za-z0-9@._]+", "-", str(key)).strip("-")
            yield from _walk(value, f"{prefix}/{name}" if prefix else name)
    elif tree is not None:
        yield prefix, escape(tree) if isinstance(tree, str) else str(tree).lower()


def make_definitions(preset: str, numbers: Results) -> str:
    r"""``\preset``, and a ``\defresult{key}{value}`` for every number."""
    lines = [rf"\defresult{{{key}}}{{{value}}}" for key, value in flatten(numbers).items()]
    return "\n".join([rf"\newcommand{{\preset}}{{{escape(preset)}}}", *lines])


def escape(text: str) -> str:
    """Text in which LaTeX's special characters, and those of ours that it lacks, stand for themselves."""
    return "".join(SPECIAL.get(character, character) for character in text)


def set_text(text: str) -> str:
    """Text with Markdown's bold, quoted and code, units that stay with their number, and signs of minus."""
    text = escape(text)
    for pattern, latex in MARKUP.items():
        text = re.sub(pattern, latex, text)
    return text


def to_latex(table: Table, columns: str = "") -> str:
    """A described table as LaTeX: its blocks have titles above rules, its sections a line of their own.

    ``columns`` are tabularx's, of a table of sentences that is as wide as the page.
    """
    layout = lay_out(table, page=False)
    heads = [head for _, block in layout.blocks for head in block]
    lines = [r"\toprule", *_set_titles(layout.blocks), _join([table.first, *heads])]
    for title, rows in layout.sections:
        lines += [RULE, *([_join([title.capitalize()])] if title else [])]
        lines.append(("\\addlinespace\n" if columns else "\n").join(map(_join, rows)))
    name = "tabularx" if columns else "tabular"
    shape = rf"{{\textwidth}}{{{columns}}}" if columns else rf"{{@{{}}l*{{{len(heads)}}}{{r}}@{{}}}}"
    return "\n".join([rf"\begin{{{name}}}{shape}", *lines, r"\bottomrule", rf"\end{{{name}}}"])


def _set_titles(blocks: Sequence[tuple[str, Sequence[str]]]) -> list[str]:
    """The line of the blocks' titles, and a rule below each; none where no block has one."""
    cells, rules, first = "", [], 2
    for number, (title, heads) in enumerate(blocks, start=1):
        last = first + len(heads) - 1
        cells += rf" & \multicolumn{{{len(heads)}}}{{c}}{{{set_text(title)}}}" if title else " &" * len(heads)
        rules += [rf"\cmidrule({'l' if number == len(blocks) else 'lr'}){{{first}-{last}}}"] if title else []
        first = last + 1
    return [cells + r" \\" + "".join(rules)] if rules else []


def _join(cells: Sequence[str]) -> str:
    return " & ".join(map(set_text, cells)) + r" \\"


def main(preset: str) -> None:
    """Write the numbers and tables of one preset, from which paper/report.tex is made."""
    print(*write_report(preset, find_root()), sep="\n")
