"""Whether the answers to several pixels belong together (`mmgsd.measure.joint`).

    python -m mmgsd run joint cloth rope    of shipped weights -> data/results/joint.json
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from mmgsd.command import Option
from mmgsd.config import OBJECTS
from mmgsd.measure.evaluation import read_results, write_results
from mmgsd.measure.joint import RESULTS, measure_joint
from mmgsd.paths import Paths, find_root
from mmgsd.studies.registry import Shown, Study
from mmgsd.studies.shipped import SETS, say_hardware
from mmgsd.studies.table import Table, make_page_table, say_value

HEADS = {"heaviest": "right: heaviest modes", "joint": "first joint answer", "any_joint": "mean of joint answers",
         "possible": "best choice of modes", "true_modes": "true matches, sorted",
         "swaps_heaviest": "swaps: heaviest modes", "swaps_joint": "first joint answer"}  # fmt: skip


def run(paths: Paths, *, names: Sequence[str] = OBJECTS) -> Path:
    """Ask shipped weights by some names; joint.json, in which rows of other names stay."""
    out = paths.root / "data" / "results" / RESULTS
    for name in names:
        write_results(read_results(out) | {name: measure_joint(name, paths.root)}, out)
    return out


def describe_joint(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """Shares of right questions and of swaps, a row an object and set, clean ones by image1's state."""
    lines, names = {}, {name for row in rows.values() for preset in SETS for name in row.get(preset, {}).get("all", {})}
    heads = {name: head for name, head in HEADS.items() if name in names}
    for row in rows.values():
        for preset, word in SETS.items():
            for kind, shares in row.get(preset, {}).items():
                if kind == "all" or preset == next(iter(SETS)):  # states of clean images alone
                    label = f"{row['object']}, {word}" + ("" if kind == "all" else f", {kind}")
                    lines[label] = [say_value(shares, name, 100, ".0f", " %") for name in heads]
    return make_page_table(list(heads.values()), lines)


def make_joint_sentence(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """How many questions were asked, and what a joint answer costs."""
    questions = sum(row[preset]["all"]["questions"] for row in rows.values() for preset in SETS if preset in row)
    cost = max(row["milliseconds"]["joint"] - row["milliseconds"]["alone"] for row in rows.values())
    hardware = say_hardware(next(iter(rows.values())))
    return f"{questions} questions. A joint answer takes up to {cost} ms more than one that is not ({hardware})."


STUDY = Study(
    "joint", 130, run, shows=lambda paths, **_: [paths.results.parent / RESULTS],
    tables={"joint": Shown(RESULTS, describe_joint), "joint_counts": Shown(RESULTS, make_joint_sentence)},
)  # fmt: skip


def main(*names: Annotated[str, Option("of weights in data/weights, or files")]) -> None:
    """Measure shipped weights, a row each; rows of other names stay."""
    print(f"{run(Paths(find_root(), 'paper'), names=names)}: {', '.join(names)}")
