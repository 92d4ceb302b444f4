"""docs/api.md, the interface in tables and in full, made from docstrings: ``python -m mmgsd interface``."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from mmgsd.__main__ import COMMANDS, load_function
from mmgsd.command import Option
from mmgsd.files import write_text

HEAD = """# The interface

Made from the docstrings by `make readme`, which writes it anew. Images are RGB, pixels (column, row), the centre of the
top left one (0, 0); S counts the pixels asked about, n their modes. `pip install mmgsd` brings what answers need,
`'mmgsd[plot]'` what draws them, and `'mmgsd[notebooks]'` baselines, ONNX, pages and measuring. Each command has a
`--help`.
"""
PARTS = {  # title: names below `mmgsd`, of classes with all their public members
    "Loading": ("load", "read_image", "find_samples", "compute_rays"),
    "Asking": ("match.matcher.Matcher", "match.pair.Pair"),
    "Following": ("match.track.Tracker", "match.track.Track"),
    "Answers": ("match.match.Match", "match.match.Best", "match.describe.describe_answer"),
    "Baselines and features of others": ("match.baselines.FeatureMatcher", "match.baselines.BaselineMatcher"),
    "Folding by a demonstration": ("fold.demonstration.read_demonstration", "fold.moves.answer_picture"),
    "Photographs": ("measure.photographs.read_photographs", "measure.photographs.measure_photographs", "adapt"),
    "Other programs": ("extras.exporting.export_onnx", "extras.page.make_page"),
}


def make_interface() -> str:
    """The page's Markdown: a table of each part, then every docstring in full."""
    parts = {title: [entry for name in names for entry in _list_entries(name)] for title, names in PARTS.items()}
    commands = [(f"`mmgsd {name}`", _shorten(text)) for name, text in _list_commands()]
    lines = [HEAD, *_make_table("From a shell", commands)]
    for title, entries in parts.items():
        lines += _make_table(title, [(f"[`{name}`](#{_anchor(name)})", _shorten(text)) for name, _, text in entries])
    lines.append("## In full\n")
    for entries in parts.values():
        lines += [f"### {name}\n\n`{call}`\n\n{text}\n" for name, call, text in entries]
    return "\n".join(lines)


def _list_entries(place: str) -> Iterator[tuple[str, str, str]]:
    """Name, call and docstring of what a dotted name below `mmgsd` is, and of a class's own public members."""
    module, _, name = place.rpartition(".")
    thing = getattr(importlib.import_module(f"mmgsd.{module}" if module else "mmgsd"), name)
    name = name if module else f"mmgsd.{name}"
    yield name, name + _sign(thing), _to_markdown(thing)
    for member, value in vars(thing).items() if inspect.isclass(thing) else ():
        value = getattr(value, "__func__", getattr(value, "fget", getattr(value, "func", value)))  # of a property
        if inspect.isfunction(value) and not member.startswith("_") and not hasattr(value, "renamed"):
            called = _sign(value) if callable(getattr(thing, member)) else ""
            yield f"{name}.{member}", f"{name}.{member}{called}", _to_markdown(value)


def _list_commands() -> Iterator[tuple[str, str]]:
    for name, (place, _) in COMMANDS.items():
        if place.startswith("cli."):  # what asks weights
            yield name, inspect.getdoc(load_function(place)).partition("\n\n")[0]


def _sign(thing: Any) -> str:
    """The parameters, without what their docstring says of them."""
    signature = inspect.signature(thing)
    parameters = [one for name, one in signature.parameters.items() if name not in ("self", "cls")]
    plain = [one.replace(annotation=one.empty) for one in parameters]
    text = str(signature.replace(parameters=plain, return_annotation=signature.empty))
    return re.sub(r"=<.*? at 0x[0-9a-f]+>", "=…", text)  # of a function, which has another address each time


def _to_markdown(thing: Any) -> str:
    text = re.sub(r"^(``\w+``(?:, ``\w+``)*)  ", r"- \1: ", inspect.getdoc(thing) or "", flags=re.MULTILINE)
    return text.replace("``", "`")


def _shorten(text: str) -> str:
    """The first sentence, in a cell of a table."""
    return re.split(r"(?<=[.;])\s", " ".join(text.split()).replace("``", "`"))[0].rstrip(".;").replace("|", "\\|")


def _anchor(name: str) -> str:
    return re.sub(r"[^\w-]", "", name.lower())


def _make_table(title: str, rows: list[tuple[str, str]]) -> list[str]:
    return [f"## {title}\n", "| | |", "|---|---|", *(f"| {name} | {text} |" for name, text in rows), ""]


def main(document: Annotated[Path, Option("the file to write, docs/api.md")]) -> None:
    """Write the page."""
    write_text(document, make_interface())
