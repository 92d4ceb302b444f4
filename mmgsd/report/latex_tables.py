"""Described tables as LaTeX, and which of them the replication report has."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mmgsd.report import descriptions as described
from mmgsd.report.descriptions import Table, lay_out

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
CLAIMS = r"@{}>{\hsize=0.85\hsize}L>{\hsize=1.15\hsize}L>{\raggedright\arraybackslash}p{6.3em}L@{}"  # columns


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


TABLES = {
    "main_table": ("rmse", described.describe_main),
    "budget_table": ("budget", described.describe_budget),
    "runs_table": ("runs", described.describe_runs),
    "sigma_table": ("sigma", described.describe_sigma),
    "symmetry_table": ("symmetry", described.describe_symmetry),
    "errors_table": ("errors", described.describe_difficulties),
    "uncertainty_table": ("uncertainty", described.describe_uncertainty),
    "fixes_table": ("broken_symmetry", described.describe_fixes),
}  # what is input: the results file that it is made from, and how
