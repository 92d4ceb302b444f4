"""Which symmetry group a square cloth has: where on it the errors lie under each, as maps, by ring, and by region."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import spearmanr

from mmgsd.config import TrainConfig, load_preset
from mmgsd.figures.style import PAGE_IN, finish_axes, name_grid, save_figure, styled
from mmgsd.measure.evaluation import load_queries, read_results, summarise, write_results
from mmgsd.measure.regions import MAP, SIDE, measure_rings, summarise_places
from mmgsd.model.tensors import describe_run
from mmgsd.paths import Paths
from mmgsd.studies.claims import RANKED, Claim, get, say
from mmgsd.studies.matrix import train_and_ask
from mmgsd.studies.models import ROWS, configure_study, get_colour, get_label
from mmgsd.studies.parameters import check_training
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Column, Table

GROUPS = ("v4", "c4", "d4")  # that the network is taught, and then asked about
REGIONS = {"corner": "corners", "edge": "edges", "interior": "interior"}  # and their heads on a page


def list_models(preset: str, groups: Sequence[str] = GROUPS) -> dict[str, TrainConfig]:
    """{group: training}, of one budget for all."""
    return configure_study(load_preset(preset), "cloth", "symmetry", [ROWS[group] for group in groups])


def check(paths: Paths, *, groups: Sequence[str] = GROUPS, overwrite: bool = False) -> None:
    """ValueError where images are missing."""
    check_training(paths, list_models(paths.preset, groups).values(), overwrite=overwrite)


def run(paths: Paths, *, groups: Sequence[str] = GROUPS, overwrite: bool = False) -> Path:
    """Train each model and ask it for the matches that it was taught; symmetry.json, and its figure."""
    summary = {}
    for group, model in list_models(paths.preset, groups).items():
        weights, answers = train_and_ask(model, paths, group=group, overwrite=overwrite)
        cost = {"run": describe_run(weights)}
        summary[group] = summarise({group: answers})[group] | cost | summarise_places(load_queries(answers))
    file = write_results(summary, paths.results / "symmetry.json")
    save_figure(plot_symmetry_study(summary), paths.figures / "symmetry_study")
    return file


def replace_maps(folder: Path, results: Results) -> dict[str, Any]:
    """The study with the errors by ring, `rings`, in place of its maps, which are for its figure."""
    rows = results.get("symmetry", {})
    short = {g: {key: value for key, value in row.items() if key != MAP} |
             ({"rings": measure_rings(row[MAP])} if MAP in row else {}) for g, row in rows.items()}  # fmt: skip
    return {"symmetry": short} if "symmetry" in results else {}


def describe_symmetry(results: Results) -> Table:
    """Error and entropy by the region of the cloth and the group that the network is taught and asked."""
    rows = {get_label(group): {"": {"all": row["rmse_mean"]} | {f"{region} {name}": value[name]
            for region, value in row["regions"].items() for name in ("rmse_px", "entropy") if name in value}}
            for group, row in results.items()}  # fmt: skip
    errors = [Column(f"{region} rmse_px", region, head) for region, head in REGIONS.items()]
    entropies = [Column(f"{region} entropy", region, form=".2f") for region in REGIONS]
    blocks = {"": [Column("all", "all", "all")], "RMSE (px)": errors, "entropy (nats)": entropies}
    return Table("taught and asked", blocks, rows)


def judge_group(results: Results) -> Claim:
    """This project's own conjecture about the paper's error map, in which the error grows inwards."""
    rings = {group: get(results, "symmetry", group, "rings") for group in ("v4", "c4")}
    inwards = {group: None if row is None else float(spearmanr(range(len(row) - 1), row[:-1]).statistic)
               for group, row in rings.items()}  # fmt: skip  # without the centre, which is one point
    complete = None not in inwards.values()
    texts = [f"`{group}`: {say(row[0])} … {say(row[-2])} px, rank correlation {say(inwards[group], 'share')}"
             for group, row in rings.items() if row]  # fmt: skip
    return Claim(
        "group", "Our conjecture: the errors inside are those of the group `v4`, not of cloth.",
        f"From the border inwards the error grows, ring by ring (rank correlation of {RANKED} or more), under `v4` "
        "and not under `c4`.", f"rings, outermost … next to the centre, {'; '.join(texts) or '–'}; one seed",
        (inwards["v4"] >= RANKED > inwards["c4"] if complete else None,), runs="symmetry",
    )  # fmt: skip


def draw_symmetry(folder: Path) -> Figure | None:
    """`plot_symmetry_study` of a preset's results; None where it has none."""
    results = read_results(folder / "symmetry.json")
    return plot_symmetry_study(results) if results else None


@styled
def plot_symmetry_study(places: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Maps of the RMSE over the cloth on one scale, and the error by ring, from the border inwards, and by region.

    ``places`` {group: what `mmgsd.measure.regions.summarise_places` gives}.
    """
    ratios = [1.0] * len(places) + [1.4, 1.4]
    figure, axes = plt.subplots(1, len(ratios), figsize=(PAGE_IN, 1.9), layout="constrained", width_ratios=ratios)
    maps = [np.array(row[MAP], float).reshape(SIDE, SIDE) for row in places.values()]
    for axis, group, values in zip(axes, places, maps, strict=False):
        image = axis.imshow(values, cmap=colormaps["viridis"].with_extremes(bad="0.85"), vmin=0, vmax=np.nanmax(maps))
        axis.set_title(group)
    name_grid(axes[: len(places)])
    bar = figure.colorbar(image, ax=axes[: len(places)], shrink=0.75)
    bar.ax.set_title("RMSE\n(px)", fontsize=7)
    for group, row in places.items():
        axes[-2].plot(np.array(measure_rings(row[MAP]), float), color=get_colour(group))
    axes[-2].set(xlabel="Points from the border", ylabel="RMSE (px)", ylim=(0, None), xlim=(0, SIDE // 2))
    _draw_regions(axes[-1], {group: {r: row["rmse_px"] for r, row in summary["regions"].items()}
                             for group, summary in places.items()})  # fmt: skip
    axes[-1].set_ylabel("RMSE (px)")
    figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside upper right", ncols=len(places), handlelength=1)
    return finish_axes(figure, keep_box=axes[: len(places)])


def _draw_regions(axis: Axes, groups: Mapping[str, Mapping[str, float | None]]) -> None:
    """A bar from 0 for each region's value in each group, which is written in it."""
    width = 0.86 / len(groups)
    for k, (group, rows) in enumerate(groups.items()):
        heights = [np.nan if value is None else value for value in rows.values()]
        places = np.arange(len(rows)) + (k - (len(groups) - 1) / 2) * width
        axis.bar(places, heights, 0.92 * width, color=get_colour(group), label=group)
        for x, height in zip(places, heights, strict=True):
            if np.isfinite(height):
                axis.text(x, 0, f" {height:.1f}", ha="center", va="bottom", fontsize=5.5, c="w", rotation=90)
    axis.set_xticks(range(len(rows)), rows, rotation=30, ha="right", rotation_mode="anchor")
    axis.set_ylim(min(0, *axis.get_ylim()), None)


STUDY = Study(
    "symmetry", 120, run, check, "08_symmetry_study", ("symmetry",), derive=replace_maps,
    tables={"symmetry": Shown("paper/symmetry.json", describe_symmetry, "symmetry_table")},
    figures={"symmetry_study": draw_symmetry}, claims=(judge_group,),
)  # fmt: skip
