"""The replication report's tables as LaTeX, one function a table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.report.claims import NOT_MEASURED, Claim, get
from mmgsd.report.results import PAPER
from mmgsd.report.tables import LABELS

NOT_RUN = r"\emph{Not run for this preset.}"
RULE = r"\midrule"
SPECIAL = {c: rf"\{c}" for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "°": r"$^\circ$",
    "→": r"$\to$", "σ": r"$\sigma$", "×": r"$\times$", "–": "--",
}  # fmt: skip

Results = Mapping[str, Any]


def escape(text: str) -> str:
    """Text in which LaTeX's special characters, and those of ours that it lacks, stand for themselves."""
    return "".join(SPECIAL.get(character, character) for character in text)


def make_main_table(rmse: Results) -> str:
    """Every method's errors on both objects, of queries with a visible source and of all; the paper's beside."""
    theirs = {name: [r"\emph{the paper's MMGSD}", rf"\emph{{{error}}}"] for name, error in PAPER.items()}
    return _make_error_table(rmse, theirs)


def make_budget_table(budget: Results) -> str:
    """The same of the models with the studies' equal, smaller budget."""
    return _make_error_table(budget, {})


def _make_error_table(results: Results, last: Mapping[str, list[str]]) -> str:
    rows: list[Sequence[str] | str] = []
    for name in OBJECTS:
        if results.get(name) or name in last:
            rows += [RULE, [name.capitalize()]]
        for method, label in _choose(results.get(name, {})):
            row = results[name][method]
            rows.append([label, *_describe_errors(row, ""), *_describe_errors(row, "_all")])
        rows += [last[name]] if name in last else []
    measures = ["RMSE", "pooled", "median", r"$\le$5", r"$\le$10", r"$\le$20", "swaps"]
    title = r" & \multicolumn{7}{c}{visible source} & \multicolumn{7}{c}{all points} \\"
    title += r"\cmidrule(lr){2-8}\cmidrule(l){9-15}"
    return make_tabular("@{}l*{14}{r}@{}", ["", *measures, *measures], rows, title=title)


def _describe_errors(row: Results, which: str) -> list[str]:
    pixels = [_say(row.get(f"{measure}{which}")) for measure in ("rmse_mean", "rmse_pooled", "median")]
    shares = [f"{measure}{which}" for measure in ("pck@5px", "pck@10px", "pck@20px", "swap_rate")]
    return pixels + [_say(row.get(share), ".1f", 100) for share in shares]


def make_sigma_table(sigma: Results) -> str:
    """MMGSD's errors against the std of its targets."""
    widths = sorted({width for rows in sigma.values() for width in rows}, key=float)
    rows = [[width, *(_say(get(sigma, name, width, measure), ".1f", scale) for name in OBJECTS
                      for measure, scale in (("rmse_mean", 1), ("median", 1), ("pck@20px", 100)))]
            for width in widths]  # fmt: skip
    return _make_object_table(r"$\sigma$ (px)", ["RMSE", "median", r"$\le$20"], rows)


def make_symmetry_table(symmetry: Results) -> str:
    """Error and entropy by the region of the cloth and the group that the network is taught and asked."""
    regions = ("corner", "edge", "interior")
    rows = [[rf"\texttt{{{escape(group)}}}", _say(row["rmse_mean"]),
             *(_say(get(row, "regions", r, "rmse_px")) for r in regions),
             *(_say(get(row, "regions", r, "entropy"), ".2f") for r in regions)]
            for group, row in symmetry.items()]  # fmt: skip
    title = r" & & \multicolumn{3}{c}{RMSE (px)} & \multicolumn{3}{c}{entropy (nats)} \\"
    return make_tabular("@{}lrrrrrrr@{}", ["group", "all", *2 * regions], [RULE, *rows],
                        title=title + r"\cmidrule(lr){3-5}\cmidrule(l){6-8}")  # fmt: skip


def make_uncertainty_table(uncertainty: Results) -> str:
    """Quality of the uncertainties; an arrow leads from temperature 1 to the calibrated one."""
    rows: list[Sequence[str] | str] = []
    for name in OBJECTS:
        rows += [RULE, [name.capitalize()]]
        for method, label in _choose(get(uncertainty, "calibrated", name) or {}):
            before, after = (get(uncertainty, when, name, method) for when in ("temperature 1", "calibrated"))
            rows.append([label, *_describe_uncertainty(before, after)])
    header = ["", "Spearman", "AURC", "mean", "share", r"50\,\%", r"90\,\%", r"95\,\%", "ECE", "occluded", "absent"]
    title = r" & \multicolumn{4}{c}{entropy and error} & \multicolumn{4}{c}{coverage (\%)}"
    title += r" & \multicolumn{2}{c}{AUROC} \\\cmidrule(lr){2-5}\cmidrule(lr){6-9}\cmidrule(l){10-11}"
    return make_tabular("@{}l*{10}{r}@{}", header, rows, title=title)


def _describe_uncertainty(before: Results | None, after: Results) -> list[str]:
    ranking = {"spearman": ".2f", "aurc": ".1f", "aurc_random": ".1f", "aurc_share": ".2f"}
    cells = [_say(after[measure], form) for measure, form in ranking.items()]
    cells += [_change(before, after, f"coverage@{level}%", ".0f", 100) for level in (50, 90, 95)]
    cells.append(_change(before, after, "ece", ".2f"))
    return cells + [_say(after[f"auroc_{match}"], ".2f") for match in ("occluded", "absent")]


def make_fixes_table(broken: Results) -> str:
    """PCL's errors with and without prior work's ways to break the symmetry."""
    heads = ["images", "RMSE", "median", r"$\le$20", "nearest", "right", "trained on"]
    rows = []
    for name, row in broken.items():
        errors = [_say(row["rmse_mean"]), _say(row["median"]), _say(row["pck@20px"], ".1f", 100)]
        errors += [_say(row.get("nearest_of_all")), _say(row.get("right"), ".0f", 100)]
        rows.append([escape(name), *errors, _say(row.get("train_images"), ",d")])
    return make_tabular("@{}lrrrrrr@{}", heads, [RULE, *rows])


def make_errors_table(errors: Results) -> str:
    """What would be left of MMGSD's mean error if some difficulty went away."""
    questions = list(dict.fromkeys(question for rows in errors.values() for question in rows))
    rows = [[escape(question), *(_say(get(errors, name, question)) for name in OBJECTS)] for question in questions]
    return make_tabular("@{}lrr@{}", ["queries", *OBJECTS], [RULE, *rows])


def make_runs_table(runs: Results) -> str:
    """What each model's training took."""
    rows = []
    for method, label in LABELS.items():
        costs = [runs.get(f"{name}-{method}", {}) for name in OBJECTS]
        cells = [cell for cost in costs for cell in (_say(cost.get("steps"), "d"), _say(cost.get("minutes")))]
        rows += [[_strip(label), *cells]] if any(costs) else []
    return _make_object_table("", ["steps", "minutes"], rows)


def make_claims_table(claims: Sequence[Claim]) -> str:
    """The paper's claims with the rule, the measurement and the verdict of each."""
    rows = [[claim.claim, claim.rule, "no results for this preset" if claim.verdict == NOT_MEASURED else claim.measured,
             rf"\textbf{{{claim.verdict}}}"] for claim in claims]  # fmt: skip
    lines = [r" & ".join(cells) + r" \\" for cells in (["claim", "counts as held where", "measured", "verdict"], *rows)]
    body = [r"\toprule", lines[0], RULE, "\\addlinespace\n".join(lines[1:]), r"\bottomrule"]
    columns = r"@{}>{\hsize=0.85\hsize}L>{\hsize=1.15\hsize}LL>{\raggedright\arraybackslash}p{6.3em}@{}"
    return "\n".join([rf"\begin{{tabularx}}{{\textwidth}}{{{columns}}}", *body, r"\end{tabularx}"])


def make_tabular(columns: str, header: Sequence[str], rows: Sequence[Sequence[str] | str], *, title: str = "") -> str:
    """A LaTeX table: ``rows`` of cells, or of lines as they stand; ``title`` is a line above the header."""
    lines = [r"\toprule", title, " & ".join(header) + r" \\"]
    lines += [row if isinstance(row, str) else " & ".join(row) + r" \\" for row in rows]
    return "\n".join([rf"\begin{{tabular}}{{{columns}}}", *filter(None, lines), r"\bottomrule", r"\end{tabular}"])


def _make_object_table(first: str, measures: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same measures of both objects side by side."""
    count = len(measures)
    title = "".join(rf" & \multicolumn{{{count}}}{{c}}{{{name}}}" for name in OBJECTS) + r" \\"
    title += rf"\cmidrule(lr){{2-{1 + count}}}\cmidrule(l){{{2 + count}-{1 + 2 * count}}}"
    columns = "@{}l" + "r" * len(OBJECTS) * count + "@{}"
    return make_tabular(columns, [first, *measures, *measures], [RULE, *rows], title=title)


def _choose(methods: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(method, label) of those that are there, in the README's order."""
    return [(method, _strip(label)) for method, label in LABELS.items() if method in methods]


def _strip(label: str) -> str:
    return escape(label.replace("*", ""))


def _say(value: float | None, form: str = ".1f", scale: float = 1) -> str:
    return "--" if value is None else re.sub("^-", "$-$", format(scale * value, form))


def _change(before: Results | None, after: Results, measure: str, form: str, scale: float = 1) -> str:
    values = [row[measure] for row in (before, after) if row is not None]
    return r"\,$\to$\,".join(_say(value, form, scale) for value in values)


TABLES = {
    "main_table": ("rmse", make_main_table),
    "budget_table": ("budget", make_budget_table),
    "runs_table": ("runs", make_runs_table),
    "sigma_table": ("sigma", make_sigma_table),
    "symmetry_table": ("symmetry", make_symmetry_table),
    "errors_table": ("errors", make_errors_table),
    "uncertainty_table": ("uncertainty", make_uncertainty_table),
    "fixes_table": ("broken_symmetry", make_fixes_table),
}  # what is input: the results file that it is made from, and how
