"""What each table says, whichever way it is set: Markdown on a page (`tables`), LaTeX in the report (`latex_tables`).

A page has room for fewer columns than the report. Texts are those of Markdown: ``**bold**``, ``*quoted*``, ```code```.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scipy import stats

from mmgsd.config import OBJECTS
from mmgsd.report.claims import get
from mmgsd.studies.models import MODELS, PAPER, UNTRAINED, get_label

TABLED = ("main", "robustness", "hand_made", "chance")
LABELS = {row.name: row.label for row in (*MODELS, *UNTRAINED) if {*row.studies} & {*TABLED}}  # rows in their order
HEADLINE = (
    "mmgsd", "mmgsd_plain", "mmgsd_long", "mmgsd_fine_deep", "spcl_dense", "spcl", "unimodal", "pcl", "sift", "centre",
)  # fmt: skip
LONGER_ROWS = ("mmgsd", "mmgsd_deep", "mmgsd_long", "mmgsd_fine", "mmgsd_fine_deep", "mmgsd_muon")
BESIDE = 8  # columns: parts that have no more in all stand beside each other, else one below the other
MISSING = "–"
LEVEL = 0.05  # of p, from which seeds do not tell two methods apart

Results = Mapping[str, Any]
Rows = Mapping[str, Mapping[str, Results]]  # {label: {part: {key: value}}}


@dataclass(frozen=True)
class Column:
    """A measure: where a row has it, and its head and format in the report and on a page; without a head, not there."""

    key: str
    head: str = ""  # in the report
    page: str = ""  # its head on a page, where no block's title stands above it
    form: str = ".1f"
    page_form: str = ""  # where it is another than the report's
    scale: float = 1  # 100: %
    changes: bool = False  # from what the row has "before"
    of: str = ""  # on a page: the key of what it is a part of
    optional: bool = False  # where rows may lack it

    def say(self, row: Results, *, page: bool) -> str:
        """The cell's text; a string stands as it is, a dash for None. KeyError where the row must not lack it."""
        rows = [row["before"], row] if self.changes and row.get("before") else [row]
        values = [one.get(self.key) if self.optional else one[self.key] for one in rows]
        form = page and self.page_form or self.form
        text = " → ".join(self._say_one(value, form) for value in values)
        if page and self.of:
            text += f" of {self._say_one(row[self.of], form)}"
        return f"{text} %" if page and self.scale == 100 and values != [None] else text

    def _say_one(self, value: float | str | None, form: str) -> str:
        if value is None or isinstance(value, str):
            return value or MISSING
        return format(self.scale * value, form)


@dataclass(frozen=True)
class Table:
    """Rows under columns, which form blocks; a row has its values in each part."""

    first: str  # head of the labels
    blocks: Mapping[str, Sequence[Column]]  # by their titles, which a page does not show
    rows: Rows
    parts: Sequence[str] = ("",)
    quoted: Rows = field(default_factory=dict)  # what others report: last, in italics, with dashes for the rest


@dataclass(frozen=True)
class Layout:
    """A table's texts in their places."""

    beside: bool  # several parts beside each other: they are the blocks; below each other they are the sections
    blocks: list[tuple[str, list[str]]]  # title and heads
    sections: list[tuple[str, list[list[str]]]]  # title and lines of cells, the label first


def lay_out(table: Table, *, page: bool) -> Layout:
    """The texts of a table's ``page``, or else of the report's."""
    shown = {title: [c for c in columns if (c.page if page else c.head)] for title, columns in table.blocks.items()}
    shown = {title: columns for title, columns in shown.items() if columns}
    columns = [column for block in shown.values() for column in block]
    beside = len(columns) * len(table.parts) <= BESIDE
    if beside and len(table.parts) > 1:
        shown = dict.fromkeys(table.parts, columns)
    heads = [(title, [c.page if page else c.head for c in block]) for title, block in shown.items()]
    groups = [("", table.parts)] if beside else [(part, (part,)) for part in table.parts]
    sections = [(title, _list_lines(table, columns, parts, page=page)) for title, parts in groups]
    return Layout(beside and len(table.parts) > 1, heads, [section for section in sections if section[1]])


def _list_lines(table: Table, columns: Sequence[Column], parts: Sequence[str], *, page: bool) -> list[list[str]]:
    def say(column: Column, row: Results | None, mark: str) -> str:
        missing = not row or (mark and column.key not in row)
        return MISSING if missing else f"{mark}{column.say(row, page=page)}{mark}"

    return [[label, *(say(column, row.get(part), mark) for part in parts for column in columns)]
            for rows, mark in ((table.rows, ""), (table.quoted, "*"))
            for label, row in rows.items() if any(row.get(part) for part in parts)]  # fmt: skip


def _describe_queries(which: str = "", *, page: bool = False) -> list[Column]:
    """Errors over the queries with a visible source, or over ``"_all"``; ``page``: shown there as well."""
    found = [Column(f"pck@{px}px{which}", f"≤{px}", f"pck@{px}px" if page and px == 20 else "", page_form=".0f",
                    scale=100) for px in (5, 10, 20)]  # fmt: skip
    return [
        Column(f"rmse_mean{which}", "RMSE", "RMSE px" if page else ""), Column(f"rmse_pooled{which}", "pooled"),
        Column(f"median{which}", "median", "median px" if page else ""), *found,
        Column(f"swap_rate{which}", "swaps", scale=100, optional=True),
    ]  # fmt: skip


SEEN = _describe_queries(page=True)
ERRORS = [column for column in SEEN if column.page]
REGIONS = {"corner": "corners", "edge": "edges", "interior": "interior"}  # and their heads on a page
UNCERTAINTY = {
    "entropy and error": (
        Column("spearman", "Spearman", "Spearman", ".2f"), Column("aurc", "AURC", "AURC px", of="aurc_random"),
        Column("aurc_random", "mean"), Column("aurc_share", "share", form=".2f"),
    ),
    "coverage (%)": (
        *(Column(f"coverage@{level}%", f"{level} %", "90 % ellipses hold" if level == 90 else "", ".0f", scale=100,
                 changes=True) for level in (50, 90, 95)),
        Column("ece", "ECE", "ECE", ".2f", changes=True),
    ),
    "AUROC": (Column("auroc_occluded", "occluded", "AUROC occluded", ".2f"),
              Column("auroc_absent", "absent", form=".2f")),
}  # fmt: skip


def _collect(results: Results, labels: Mapping[str, str], parts: Iterable[str] = OBJECTS) -> dict[str, Any]:
    """Rows of those ``labels`` {key: label} whose key some part of the results {part: {key: row}} has."""
    rows = {label: {part: results.get(part, {}).get(key) for part in parts} for key, label in labels.items()}
    return {label: row for label, row in rows.items() if any(row.values())}


def describe_budget(results: Results, *, methods: Collection[str] = tuple(LABELS)) -> Table:
    """The ``methods``' errors on both objects, of queries with a visible source and of all."""
    labels = {method: label for method, label in LABELS.items() if method in methods}
    blocks = {"visible source": SEEN, "all points": _describe_queries("_all")}
    return Table("", blocks, _collect(results, labels), OBJECTS)


def describe_main(results: Results, *, methods: Collection[str] = tuple(LABELS)) -> Table:
    """The same with the paper's own errors, which are not of the smaller budget."""
    theirs = {name: {"rmse_mean": error} for name, error in PAPER.items()}
    table = describe_budget(results, methods=methods)
    return dataclasses.replace(table, quoted={"*the paper's MMGSD, 3,500 images each*": theirs})


def describe_sigma(results: Results) -> Table:
    """MMGSD's errors against the std of its targets."""
    widths = sorted({width for rows in results.values() for width in rows}, key=float)
    return Table("σ px", {"": ERRORS}, _collect(results, {width: width for width in widths}), OBJECTS)


def describe_runs(results: Results) -> Table:
    """What each model's training took."""
    rows = {name: {method: results.get(f"{name}-{method}") for method in LABELS} for name in OBJECTS}
    columns = [Column("steps", "steps", form="d", optional=True), Column("minutes", "minutes", optional=True)]
    return Table("", {"": columns}, _collect(rows, LABELS), OBJECTS)


def _describe_objects(first: str, rows: Mapping[str, Results], heads: Sequence[str] = OBJECTS, form: str = "") -> Table:
    """A number of each object, ``rows`` {label: {object: value}}."""
    columns = [Column(n, n, head, form or ".1f", optional=True) for n, head in zip(OBJECTS, heads, strict=True)]
    return Table(first, {"": columns}, {label: {"": row} for label, row in rows.items()})


def describe_presets(results: Mapping[str, Results]) -> Table:
    """MMGSD's RMSE by preset, from {path of the results file: errors}."""
    rows = {f"`{Path(path).parent}`": {name: errors[name]["mmgsd"]["rmse_mean"] for name in OBJECTS}
            for path, errors in results.items()}  # fmt: skip
    return _describe_objects("preset", rows, ("MMGSD's RMSE px: cloth", "rope"), ".0f")


def describe_difficulties(results: Results) -> Table:
    """What would be left of MMGSD's RMSE if some difficulty went away, from {object: {which queries: error}}."""
    kinds = dict.fromkeys(kind for row in results.values() for kind in row)
    rows = {kind: {name: get(results, name, kind) for name in OBJECTS} for kind in kinds}
    return _describe_objects("MMGSD's RMSE px", rows)


def describe_places(results: Results) -> Table:
    """MMGSD's mean error by place on the object, from what `load_results` measured."""
    rows = {f"{name}: {place}": {"": {"error": error}}
            for name, row in results["places"].items() for place, error in row.items()}  # fmt: skip
    return Table("place", {"": [Column("error", "RMSE", "RMSE px")]}, rows)


def describe_seeds(results: Results) -> Table:
    """The mean and the std of the RMSE over seeds, from {object: {"mmgsd-0": errors}}, a method a row.

    Marked where it differs from MMGSD's by `compare_seeds`: by an asterisk, or by a dagger where it did before Holm's
    correction alone.
    """
    tested = compare_seeds(results)

    def say(name: str, method: str) -> str | None:
        said, (alone, corrected) = say_seeds(results.get(name, {}), method), tested.get((name, method), (1.0, 1.0))
        return f"{said}{' *' if corrected < LEVEL else ' †' if alone < LEVEL else ''}" if said else None

    seeds = {label: {name: say(name, method) for name in OBJECTS} for method, label in LABELS.items()}
    return _describe_objects("RMSE px: mean ± std (seeds)", {k: row for k, row in seeds.items() if any(row.values())})


def compare_seeds(results: Results) -> dict[tuple[str, str], tuple[float, float]]:
    """{(object, method): p of Welch's t-test against MMGSD's seeds, alone and by Holm's correction for all of them}.

    Holm, "A simple sequentially rejective multiple test procedure" (1979). Of methods with two seeds or more.
    """
    alone = {}
    for name, rows in results.items():
        ours, methods = _list_seeds(rows, "mmgsd"), dict.fromkeys(key.rpartition("-")[0] for key in rows)
        for method in (m for m in methods if m != "mmgsd" and min(len(ours), len(_list_seeds(rows, m))) > 1):
            alone[name, method] = float(stats.ttest_ind(_list_seeds(rows, method), ours, equal_var=False).pvalue)
    corrected, least = {}, 0.0
    for k, (key, p) in enumerate(sorted(alone.items(), key=lambda item: item[1])):
        least = corrected[key] = max(least, min(1.0, (len(alone) - k) * p))
    return {key: (p, corrected[key]) for key, p in alone.items()}


def make_first_seed_sentence(results: Results) -> str:
    """What the seed 0 of MMGSD, which other studies rest on, has beside its other seeds."""
    each = {name: _list_seeds(results[name], "mmgsd") for name in OBJECTS}
    said = [f"{values[0]:.1f} px on {name} (others {', '.join(f'{v:.1f}' for v in values[1:])})"
            for name, values in each.items()]  # fmt: skip
    return f"The tables of budget, σ and symmetry rest on MMGSD's seed 0: {', '.join(said)}."


def _list_seeds(rows: Results, method: str) -> list[float]:
    return [row["rmse_mean"] for key, row in rows.items() if key.rpartition("-")[0] == method]


def say_seeds(rows: Results, method: str) -> str | None:
    """Mean, std of the sample, and how many: "54.6 ± 0.8 (3)"; no std of one, None of none."""
    values = _list_seeds(rows, method)
    if len(values) < 2:
        return f"{values[0]:.1f} (1)" if values else None
    return f"{statistics.mean(values):.1f} ± {statistics.stdev(values):.1f} ({len(values)})"


def describe_symmetry(results: Results) -> Table:
    """Error and entropy by the region of the cloth and the group that the network is taught and asked."""
    rows = {get_label(group): {"": {"all": row["rmse_mean"]} | {f"{region} {name}": value[name]
            for region, value in row["regions"].items() for name in ("rmse_px", "entropy") if name in value}}
            for group, row in results.items()}  # fmt: skip
    errors = [Column(f"{region} rmse_px", region, head) for region, head in REGIONS.items()]
    entropies = [Column(f"{region} entropy", region, form=".2f") for region in REGIONS]
    blocks = {"": [Column("all", "all", "all")], "RMSE (px)": errors, "entropy (nats)": entropies}
    return Table("taught and asked", blocks, rows)


def describe_fixes(results: Results) -> Table:
    """PCL's errors with and without prior work's ways to break the symmetry."""
    columns = [
        *ERRORS, Column("nearest_of_all", "nearest", "nearest match px", optional=True),
        Column("right", "right", "the right one", ".0f", scale=100, optional=True),
        Column("train_images", "trained on", form=",d", optional=True),
    ]  # fmt: skip
    return Table("images", {"": columns}, {images: {"": row} for images, row in results.items()})


def describe_uncertainty(results: Results) -> Table:
    """Quality of the uncertainties; an arrow leads from temperature 1 to the calibrated one."""
    before = results["temperature 1"]
    joined = {name: {method: {**row, "before": get(before, name, method)} for method, row in methods.items()}
              for name, methods in results["calibrated"].items()}  # fmt: skip
    return Table("", UNCERTAINTY, _collect(joined, LABELS), OBJECTS)
