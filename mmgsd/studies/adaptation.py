"""How many photographs of one's own does `mmgsd.adapt` need? Measured by repositories of photographs that others took.

    python -m mmgsd run adaptation FOLDER                   every cell -> data/results/adaptation.json
    python -m mmgsd run adaptation FOLDER --object cloth --counts 5 --splits 1 --steps 32     a few of them

FOLDER holds photographs and an index.json with marks and the ``repo`` of each (`mmgsd.measure.photographs`). Of each
repository that has enough, some are learnt from, with their marks or without; asked about are those of it that no count
of the split learns from, and those of all others, each by the same two pictures and by name. The weights are thrown
away. What is measured is kept, so that a killed call goes on.
"""

from __future__ import annotations

import tempfile
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.command import Option
from mmgsd.config import OBJECTS
from mmgsd.figures.style import PAGE_IN, add_legend, finish_axes, save_figure, styled
from mmgsd.files import write_json
from mmgsd.learn.adapt import LABELS, STEPS, adapt, ask_left_out, read_adaptation
from mmgsd.match.matcher import Matcher, load
from mmgsd.measure.evaluation import read_results
from mmgsd.measure.photographs import Photograph, read_photographs
from mmgsd.paths import Paths, find_root
from mmgsd.progress import ProgressBar
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import MISSING, Table, make_page_table, to_markdown

RESULTS = "adaptation.json"
COUNTS = (2, 5, 10, 20)  # photographs that are learnt from
KINDS = {"marked": "with marks", "unmarked": "without marks"}
SPLITS = 5
SOURCES = 2  # photographs of every split that are asked by
LEFT = 4  # a part so large of a repository, at least, is left to be asked about
COLOURS = {"marked": "#D55E00", "unmarked": "#0072B2"}
ASKED = {"own": "same repository", "others": "other repositories"}
COLUMNS = ["found@5%", "spurious"]

Cell = tuple[str, str, str, int, int]  # object, repository, kind, count, split; count 0: the weights as they are


def list_cells(
    photographs: Mapping[str, Sequence[Photograph]], *, counts: Sequence[int] = COUNTS, splits: int = SPLITS
) -> Iterator[Cell]:
    """What is measured of {object: photographs}, the weights as they are first in each split."""
    for name, all_of_it in photographs.items():
        for repository, number in Counter(photograph.source for photograph in all_of_it).items():
            feasible = [count for count in counts if count <= find_most(number)]
            ways = [("marked", 0), *((kind, count) for count in feasible for kind in KINDS)] if feasible else []
            yield from ((name, repository, *way, split) for split in range(splits) for way in ways)


def find_most(count: int) -> int:
    """How many photographs of a repository that has so many are learnt from at most, 0 of too small a one."""
    return max((c for c in COUNTS if c <= count - max(1, count // LEFT)), default=0)


def run(
    paths: Paths, *, folder: Path | str, objects: Sequence[str] = OBJECTS, counts: Sequence[int] = COUNTS,
    splits: int = SPLITS, steps: int = STEPS, out: Path | None = None, progress: bool = True,
) -> Path:  # fmt: skip
    """Measure every cell that is missing; the path of the results (default: data/results/adaptation.json).

    Errors are those of `mmgsd.measure.photographs.read_photographs`.
    """
    own, out = out is None, out or paths.results.parent / RESULTS  # the figure is of the repository's results
    photographs = {object: read_photographs(folder, object) for object in objects}
    cells = list(list_cells(photographs, counts=counts, splits=splits))
    for cell in ProgressBar(cells, desc="adaptation", disable=not progress, leave=False):
        rows, key = read_results(out), "/".join(map(str, cell))
        if key not in rows:
            write_json(out, {**rows, key: measure_cell(cell, photographs[cell[0]], steps=steps)})
    if own and (figure := plot_adaptation(read_results(out))):
        save_figure(figure, paths.root / "figures" / "adaptation", kinds=("png",))
    return out


def measure_cell(cell: Cell, photographs: Sequence[Photograph], *, steps: int) -> dict[str, Any]:
    """{"own", "others": {by: {measure: mean}}} and ``rmse_px`` of adapted weights on renders, or why they refused."""
    weights, repository, kind, count, split = cell
    own = [photograph for photograph in photographs if photograph.source == repository]
    order = np.random.default_rng(split).permutation(len(own))
    targets = {"own": [own[k] for k in order[find_most(len(own)) :]],
               "others": [photograph for photograph in photographs if photograph.source != repository]}  # fmt: skip
    sources = [own[k] for k in order[:SOURCES]]
    if not count:
        return _ask(load(weights), sources, targets)
    entries = [{"file": str(photograph.path.absolute())} |
               ({photograph.by: photograph.xy.tolist()} if kind == "marked" else {})
               for photograph in (own[k] for k in order[:count])]  # fmt: skip
    with tempfile.TemporaryDirectory() as place:
        index = write_json(Path(place) / "index.json", entries)
        try:
            file = adapt(index, weights, Path(place) / "adapted.safetensors", steps=steps, folds=0, progress=False)
        except ValueError as error:  # such as nothing that the weights are sure of
            return {"refused": str(error)}
        return _ask(load(file), sources, targets) | {"rmse_px": read_adaptation(file)["rmse_px"]}


def _ask(matcher: Matcher, sources: list[Photograph], targets: Mapping[str, list[Photograph]]) -> dict[str, Any]:
    return {name: ask_left_out(matcher, sources, chosen).groupby("by")[COLUMNS].mean().round(4).to_dict("index")
            for name, chosen in targets.items() if chosen}  # fmt: skip


def tabulate(results: Results) -> pd.DataFrame:
    """A row a cell, place ("own", "others") and way of asking; of cells that were not refused."""
    rows = []
    for key, outcome in results.items():
        object, rest = key.split("/", 1)
        repository, kind, count, split = rest.rsplit("/", 3)
        error = outcome.get("rmse_px")
        columns = {"object": object, "repository": repository, "kind": kind, "count": int(count), "split": int(split),
                   "grown": error["after"] / error["before"] - 1 if error else 0.0}  # fmt: skip
        for place in ASKED:
            rows += [{**columns, "place": place, "by": by, **means} for by, means in outcome.get(place, {}).items()]
    return pd.DataFrame(rows)


def _average(rows: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Means over splits, then over repositories; the weights as they are stand beside only those that were adapted."""
    return rows.groupby([*keys, "repository"])[[*COLUMNS, "grown"]].mean().groupby(keys).mean()


def choose_largest(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of those repositories of which most numbers of photographs were learnt from, of each object."""
    counts = rows.groupby(["object", "repository"])["count"].nunique()
    largest = counts[counts == counts.groupby("object").transform("max")].index
    return rows[pd.MultiIndex.from_frame(rows[["object", "repository"]]).isin(largest)]


def describe_adaptation(results: Results) -> Table:
    """What is found and spurious by number of photographs, and how much renders' error grows, means over splits.

    Of the largest repositories alone: all rows of an object are of the same photographs.
    """
    means = _average(choose_largest(tabulate(results)), ["object", "kind", "count", "place", "by"])
    ways, lines = [(place, by) for place in ASKED for by in ("name", "picture")], {}
    for (object, kind, count), part in means.groupby(level=[0, 1, 2], sort=False):
        label = f"{object}, {count} {KINDS[kind]}" if count else f"{object}, as shipped"
        cells = [_say(part, (object, kind, count, *way)) for way in ways]
        lines[label] = [*cells, f"{part.grown.mean():+.0%}"]
    heads = [f"{ASKED[place]}, by {by}: found / spurious" for place, by in ways]
    return make_page_table([*heads, "renders' error"], lines)


def _say(part: pd.DataFrame, key: tuple[Any, ...]) -> str:
    return " / ".join(f"{100 * part.loc[key, name]:.0f} %" for name in COLUMNS) if key in part.index else MISSING


@styled
def plot_adaptation(results: Results) -> Figure | None:
    """What is found in the rest of a repository by the number of its photographs that were learnt from, a panel each.

    Means over splits, a dot each split; zero photographs are the weights as they are. None where nothing was learnt.
    """
    rows = tabulate(results)
    if rows.empty or not rows["count"].any():
        return None
    rows = rows[(rows.place == "own") & (rows.repository.isin(rows[rows["count"] > 0].repository))]
    panels = list(rows.groupby(["object", "repository"], sort=False))
    size = PAGE_IN, 2.2
    figure, axes = plt.subplots(1, len(panels), figsize=size, layout="constrained", sharey=True, squeeze=False)
    for axis, ((object, repository), part) in zip(axes[0], panels, strict=True):
        for (kind, label), by in product(KINDS.items(), LABELS):
            curve = part[((part.kind == kind) | (part["count"] == 0)) & (part.by == by)]
            mean, line = 100 * curve.groupby("count")["found@5%"].mean(), "o-" if by == "name" else "o--"
            axis.plot(mean.index, mean, line, ms=3.5, mfc=COLOURS[kind] if by == "name" else "white",
                      color=COLOURS[kind], label=f"{label}, {LABELS[by]}")  # fmt: skip
            axis.scatter(curve["count"], 100 * curve["found@5%"], s=4, color=COLOURS[kind], linewidths=0)
        name = textwrap.shorten(repository.rpartition("/")[2].replace("-", " "), 24, placeholder=" …")
        axis.set(title=f"{object}\n{name}", xlabel="photographs learnt from", ylim=(0, 103))
        axis.set_xticks(sorted(part["count"].unique()))
    axes[0, 0].set_ylabel("found (%)")
    add_legend(figure, axes[0])
    return finish_axes(figure)


STUDY = Study(
    "adaptation", 155, run, shows=lambda paths, **_: [paths.results.parent / RESULTS],
    tables={"adaptation": Shown(RESULTS, describe_adaptation)},
)  # fmt: skip


def main(
    folder: Annotated[Path, Option("marked photographs, with index.json", metavar="FOLDER")],
    *,
    object: Annotated[list, Option("one of them alone", choices=OBJECTS, action="append", type=str)] = None,
    counts: Annotated[list[int], Option("of photographs adapted to", nargs="+", choices=COUNTS)] = COUNTS,
    splits: Annotated[int, Option("of each repository's photographs")] = SPLITS,
    steps: Annotated[int, Option("of each training")] = STEPS,
    out: Annotated[Path, Option("another results file")] | None = None,
) -> None:
    """Measure what is missing, and print the table."""
    options = {"objects": object or OBJECTS, "counts": counts, "splits": splits, "steps": steps, "out": out}
    print(to_markdown(describe_adaptation(read_results(run(Paths(find_root(), "paper"), folder=folder, **options)))))
