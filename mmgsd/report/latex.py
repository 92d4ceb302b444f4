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
from mmgsd.report import latex_tables as tables
from mmgsd.report.claims import list_claims
from mmgsd.report.findings import describe_claims
from mmgsd.report.results import load_results, told_where

Results = Mapping[str, Any]


def write_report(preset: str, root: Path) -> list[Path]:
    """Write everything that the report inputs into ``paper/generated``; ValueError for an unknown preset.

    DamagedFileError, which names the file or the folder, where a number is missing or is none.
    """
    config, paths = load_preset(preset), Paths(root, preset)
    results = load_results(paths.results)
    with told_where(paths.results):
        claims = list_claims(results)
        described = dataclasses.asdict(config) | {"image_size": IMAGE_SIZE}
        numbers = {**results, "config": described, "verdict": {claim.key: claim.verdict for claim in claims}}
        table = tables.to_latex(describe_claims(results), tables.CLAIMS)
        texts = {"results": make_definitions(preset, numbers), "claims_table": table}
    for name, (file, make) in tables.TABLES.items():
        with told_where(paths.results / f"{file}.json"):
            texts[name] = tables.to_latex(make(results[file])) if file in results else tables.NOT_RUN
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
        yield prefix, tables.escape(tree) if isinstance(tree, str) else str(tree).lower()


def make_definitions(preset: str, numbers: Results) -> str:
    r"""``\preset``, and a ``\defresult{key}{value}`` for every number."""
    lines = [rf"\defresult{{{key}}}{{{value}}}" for key, value in flatten(numbers).items()]
    return "\n".join([rf"\newcommand{{\preset}}{{{tables.escape(preset)}}}", *lines])


def main(preset: str) -> None:
    """Write the numbers and tables of one preset, from which paper/report.tex is made."""
    print(*write_report(preset, find_root()), sep="\n")
