"""The README's results table, made from the results files: ``python -m mmgsd.tables data/results/quick README.md``."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

PAPER = {"cloth": 32.4, "rope": 31.3}  # px, MMGSD's RMSE as the paper reports it
LABELS = {
    "mmgsd": "**MMGSD** (ours)", "spcl": "SPCL", "unimodal": "Unimodal", "pcl": "PCL",
    "sift": "SIFT", "orb": "ORB", "random": "random points", "centre": "object's centre",
}  # fmt: skip
BEGIN, END = "<!-- results: made by `make readme` -->", "<!-- end of results -->"


def make_results_table(results: dict[str, dict[str, dict[str, float]]]) -> str:
    """Markdown from {object: {method: {metric: value}}}: RMSE, median and pck of both objects, a method a row."""
    lines = [
        "| | cloth: RMSE px | median px | pck@20px | rope: RMSE px | median px | pck@20px |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, label in LABELS.items():
        rows = [results[object][method] for object in PAPER]
        cells = [f"{r['rmse_mean']:.1f} | {r['median']:.1f} | {100 * r['pck@20px']:.0f} %" for r in rows]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    lines.append(f"| *the paper's MMGSD, 3,500 images each* | *{PAPER['cloth']}* | – | – | *{PAPER['rope']}* | – | – |")
    return "\n".join(lines)


def update_readme(readme: Path, table: str) -> None:
    """Replace what stands between the two markers; ValueError where the markers are missing."""
    text = readme.read_text()
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"{readme} must hold {BEGIN!r} and {END!r} once each")
    head, rest = text.split(BEGIN)
    aside = readme.with_suffix(".tmp")
    aside.write_text(f"{head}{BEGIN}\n{table}\n{END}{rest.split(END)[1]}")
    os.replace(aside, readme)


if __name__ == "__main__":
    update_readme(Path(sys.argv[2]), make_results_table(json.loads((Path(sys.argv[1]) / "rmse.json").read_text())))
