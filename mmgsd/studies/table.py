"""A table of results as its study describes it, for a page and for the report: which rows, columns and formats.

A page has room for fewer columns than the report. Texts are those of Markdown: ``**bold**``, ``*quoted*``, ```code```.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.studies.models import MODELS, UNTRAINED

TABLED = ("main", "robustness", "hand_made", "chance")
LABELS = {row.name: row.label for row in (*MODELS, *UNTRAINED) if {*row.studies} & {*TABLED}}  # rows in their order
BESIDE = 8  # columns: parts that have no more in all stand beside each other, else one below the other
MISSING = "–"

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
    blocks = {title: [c for c in columns if (c.page if page else c.head)] for title, columns in table.blocks.items()}
    blocks = {title: columns for title, columns in blocks.items() if columns}
    columns = [column for block in blocks.values() for column in block]
    beside = len(columns) * len(table.parts) <= BESIDE
    if beside and len(table.parts) > 1:
        blocks = dict.fromkeys(table.parts, columns)
    heads = [(title, [c.page if page else c.head for c in block]) for title, block in blocks.items()]
    groups = [("", table.parts)] if beside else [(part, (part,)) for part in table.parts]
    sections = [(title, _list_lines(table, columns, parts, page=page)) for title, parts in groups]
    return Layout(beside and len(table.parts) > 1, heads, [section for section in sections if section[1]])


def _list_lines(table: Table, columns: Sequence[Column], parts: Sequence[str], *, page: bool) -> list[list[str]]:
    def say(column: Column, row: Results | None, mark: str) -> str:
        """A cell of the table."""
        missing = not row or (mark and column.key not in row)
        return MISSING if missing else f"{mark}{column.say(row, page=page)}{mark}"

    return [[label, *(say(column, row.get(part), mark) for part in parts for column in columns)]
            for rows, mark in ((table.rows, ""), (table.quoted, "*"))
            for label, row in rows.items() if any(row.get(part) for part in parts)]  # fmt: skip


def to_markdown(table: Table | str) -> str:
    """A table as Markdown; a sentence stays as it is.

    Parts beside each other name their first column, those below each other have a column for it.
    """
    if isinstance(table, str):
        return table
    layout = lay_out(table, page=True)
    heads = [f"{title}: {head}" if layout.beside and not k else head
             for title, block in layout.blocks for k, head in enumerate(block)]  # fmt: skip
    stacked = len(table.parts) > 1 and not layout.beside
    lines = [[title, *line] if stacked else line for title, lines in layout.sections for line in lines]
    heads = ["", table.first, *heads] if stacked else [table.first, *heads]
    return "\n".join([_join(heads), "|---" * len(heads) + "|", *map(_join, lines)])


def _join(cells: Sequence[str]) -> str:
    return "|" + "|".join(f" {cell.strip()} " if cell else " " for cell in cells) + "|"


def make_page_table(heads: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Table:
    """A table of texts for a page alone, {label: cells under ``heads``}; the labels have no head."""
    columns = [Column(str(k), page=head) for k, head in enumerate(heads)]
    return Table(" ", {"": columns}, {label: {"": {str(k): cell for k, cell in enumerate(cells)}}
                                      for label, cells in rows.items()})  # fmt: skip


def say_value(row: Results | None, key: str, scale: float, form: str, unit: str = "") -> str:
    """A number of a row with its unit, times ``scale``; a dash where it is missing."""
    value = None if row is None else row.get(key)
    return MISSING if value is None else format(scale * value, form) + unit


def _describe_queries(which: str = "", *, page: bool = False) -> list[Column]:
    """Errors over the queries with a visible source, or over ``"_all"``; ``page``: shown there as well."""
    shares = [Column(f"pck@{px}px{which}", f"≤{px}", f"pck@{px}px" if page and px == 20 else "", page_form=".0f",
                     scale=100) for px in (5, 10, 20)]  # fmt: skip
    return [
        Column(f"rmse_mean{which}", "RMSE", "RMSE px" if page else ""), Column(f"rmse_pooled{which}", "pooled"),
        Column(f"median{which}", "median", "median px" if page else ""), *shares,
        Column(f"swap_rate{which}", "swaps", scale=100, optional=True),
    ]  # fmt: skip


SEEN = _describe_queries(page=True)
ERRORS = [column for column in SEEN if column.page]


def collect_rows(results: Results, labels: Mapping[str, str], parts: Iterable[str] = OBJECTS) -> dict[str, Any]:
    """Rows of those ``labels`` {key: label} whose key some part of the results {part: {key: row}} has."""
    rows = {label: {part: results.get(part, {}).get(key) for part in parts} for key, label in labels.items()}
    return {label: row for label, row in rows.items() if any(row.values())}


def describe_errors(results: Results, *, methods: Iterable[str] = tuple(LABELS)) -> Table:
    """The ``methods``' errors on both objects, of queries with a visible source and of all."""
    labels = {method: label for method, label in LABELS.items() if method in methods}
    blocks = {"visible source": SEEN, "all points": _describe_queries("_all")}
    return Table("", blocks, collect_rows(results, labels), OBJECTS)


def describe_objects(
    first: str, rows: Mapping[str, Results], heads: Mapping[str, str] | None = None, form: str = ""
) -> Table:  # fmt: skip
    """A number of each object, ``rows`` {label: {object: value}}, under ``heads`` {object: head on a page}."""
    heads = heads or {name: name for name in OBJECTS}
    columns = [Column(name, name, head, form or ".1f", optional=True) for name, head in heads.items()]
    return Table(first, {"": columns}, {label: {"": row} for label, row in rows.items()})
