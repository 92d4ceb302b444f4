"""How wide a target should be: MMGSD with each σ, the std of a target's modes at the end of training."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.config import OBJECTS, TrainConfig, load_preset
from mmgsd.figures.style import COLUMN_IN, add_legend, finish_axes, styled
from mmgsd.measure.evaluation import load_queries, read_results, write_results
from mmgsd.paths import Paths
from mmgsd.studies.claims import Claim, get, is_better, say
from mmgsd.studies.main import compute_density
from mmgsd.studies.matrix import run_each, train_and_ask, write_study_table
from mmgsd.studies.models import configure_study, get_colour, vary_sigma
from mmgsd.studies.parameters import check_training
from mmgsd.studies.registry import ERROR_MEASURES, Results, Shown, Study
from mmgsd.studies.table import ERRORS, Table, collect_rows

OTHER_SEED = re.compile(r"mmgsd-[1-9]")
BIN_PX, SMOOTH_PX, SHOWN = 4, 5.0, 0.99  # of the errors' distributions: bins, their smoothing, the share that is drawn


def list_models(preset: str, sigmas_px: Sequence[float] = (), *, steps: int = 0) -> list[TrainConfig]:
    """A model for each object and σ (px), by default the preset's; 0 ``steps`` are those of the studies' budget."""
    config = load_preset(preset)
    rows = vary_sigma(sigmas_px or config.sigmas_px)
    return [m for name in OBJECTS for m in configure_study(config, name, "sigma", rows, steps=steps).values()]


def check(paths: Paths, *, sigmas_px: Sequence[float] = (), steps: int = 0, overwrite: bool = False) -> None:
    """ValueError where images are missing."""
    check_training(paths, list_models(paths.preset, sigmas_px, steps=steps), overwrite=overwrite)


def run(paths: Paths, *, sigmas_px: Sequence[float] = (), steps: int = 0, overwrite: bool = False) -> Path:
    """Train and ask each model; sigma.json, or of other ``steps`` sigma_4000.json, and `count_errors` beside it."""
    models = {model.name: model for model in list_models(paths.preset, sigmas_px, steps=steps)}
    dict(run_each(partial(train_and_ask, paths=paths, overwrite=overwrite), models, desc="models"))
    write_study_table(load_preset(paths.preset), paths.root, "sigma", values=sigmas_px, steps=steps)
    file = list_shown(paths, steps=steps)[0]
    count_errors(paths, models.values(), file.with_name(f"errors_by_{file.name}"))
    return file


def count_errors(paths: Paths, models: Iterable[TrainConfig], file: Path) -> Path:
    """Write {object: {σ: [queries in each bin of `BIN_PX` of the error]}}, of queries with a visible source."""
    counts = read_results(file, depth=1)
    for model in models:
        queries = load_queries(paths.queries(model.name))
        bins = (queries[queries.visible].rmse_px.to_numpy(float) // BIN_PX).astype(int)
        counts.setdefault(model.object, {})[f"{model.sigma_px:g}"] = np.bincount(bins).tolist()
    return write_results(counts, file)


def list_shown(paths: Paths, *, steps: int = 0, **_: Any) -> list[Path]:
    """The results file of so many steps."""
    return [paths.results / (f"sigma_{steps}.json" if steps else "sigma.json")]


def tabulate(results: Results, measure: str = "rmse_mean") -> pd.DataFrame:
    """A measure, a row for each σ and a column for each object."""
    values = {name: {sigma: row[measure] for sigma, row in rows.items()} for name, rows in results.items()}
    return pd.DataFrame(values).rename_axis("σ (px)")


def tabulate_longer(folder: Path) -> pd.DataFrame:
    """The mean errors with other steps than the studies', of a preset's folder of results: a row a file and object."""
    stored = {path.stem: read_results(path, depth=2) for path in sorted(folder.glob("sigma_*.json"))}
    tables = {name: tabulate(results).T for name, results in stored.items()}
    return pd.concat(tables).rename_axis(columns="σ (px)") if tables else pd.DataFrame()


def describe_sigma(results: Results) -> Table:
    """MMGSD's errors against the std of its targets."""
    widths = sorted({width for rows in results.values() for width in rows}, key=float)
    return Table("σ px", {"": ERRORS}, collect_rows(results, {width: width for width in widths}), OBJECTS)


def judge_sigma(results: Results) -> Claim:
    """The width of the target."""
    errors = {name: {s: row["rmse_mean"] for s, row in (get(results, "sigma", name) or {}).items()} for name in OBJECTS}
    parts = tuple(is_better(row.get("1"), row[s]) for row in errors.values() for s in row if float(s) > 1) or (None,)
    texts = [f"{n}: " + ", ".join(f"{say(e)} at {s}" for s, e in row.items()) for n, row in errors.items()]
    return Claim(
        "sigma", "A target of σ = 1 px is best; every wider one is worse.",
        "The wider target's error is larger; a part each object and width.", f"{'; '.join(texts)}; one seed", parts,
        runs="sigma",
    )  # fmt: skip


def draw_sigma(folder: Path) -> Figure:
    """`plot_sigma_ablation` of a preset's results, and of its other seeds, where they are trained."""
    results, seeds = (read_results(folder / f"{name}.json") for name in ("sigma", "seeds_1000"))
    return plot_sigma_ablation(results, seeds=seeds)


@styled
def plot_sigma_ablation(
    results: Mapping[str, Mapping[str, Mapping[str, float]]], *, seeds: Mapping[str, Mapping[str, Any]] | None = None
) -> Figure:
    """``rmse_mean`` of MMGSD against the std σ of its targets: ``results`` {object: {σ px: {metric: value}}}.

    Rings at σ = 1 px are ``seeds`` {object: {"mmgsd-1": {metric: value}}} of the same training, but for the seed 0.
    """
    figure, axes = plt.subplots(1, len(results), figsize=(COLUMN_IN, 1.7), layout="constrained", squeeze=False)
    for axis, (name, rows) in zip(axes[0], results.items(), strict=True):
        points = sorted((float(sigma), metrics["rmse_mean"]) for sigma, metrics in rows.items())
        sigma, error = zip(*points, strict=True)
        axis.plot(sigma, error, "o-", ms=3.5, color=get_colour("mmgsd"))
        others = [row["rmse_mean"] for key, row in (seeds or {}).get(name, {}).items() if OTHER_SEED.match(key)]
        rings = axis.plot([1.0] * len(others), others, "o", ms=3.5, mfc="none", color=get_colour("mmgsd"))
        if others:
            axis.legend(rings, ["other seeds"], loc="lower left", handletextpad=0.2, fontsize=6)
        for x, y in points:
            axis.annotate(f"{y:.1f}", (x, y), xytext=(0, 4), textcoords="offset points", ha="center", fontsize=6.5)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sigma, [f"{s:g}" for s in sigma])
        axis.set(title=name.capitalize(), xlabel="σ of the targets (px)", ylim=(0, 1.2 * max(error)))
        axis.margins(x=0.15)
    axes[0, 0].set_ylabel("RMSE of MMGSD (px)")
    return finish_axes(figure)


def draw_densities(folder: Path) -> Figure | None:
    """`plot_densities` of a preset's results; None where they have no distributions."""
    counts = read_results(folder / "errors_by_sigma.json", depth=1)
    return plot_densities(counts) if counts else None


@styled
def plot_densities(counts: Mapping[str, Mapping[str, Sequence[int]]]) -> Figure:
    """Probability density of MMGSD's error, a line a σ of its targets: ``counts`` of `count_errors`."""
    figure, axes = plt.subplots(1, len(counts), figsize=(COLUMN_IN, 1.9), layout="constrained", squeeze=False)
    for axis, (name, rows) in zip(axes[0], counts.items(), strict=True):
        widths, far = sorted(rows, key=float), 0.0
        for shade, width in zip(np.linspace(0.0, 0.85, len(widths)), widths, strict=True):
            values = np.array(rows[width])
            density = compute_density(values, BIN_PX, bandwidth=SMOOTH_PX)
            axis.plot(*density, color=plt.get_cmap("viridis")(shade), lw=1, label=f"σ = {width} px")
            far = max(far, BIN_PX * (1 + float(np.searchsorted(values.cumsum(), SHOWN * values.sum()))))
        axis.set(title=name.capitalize(), xlabel="Error (px)", xlim=(0, far), ylim=(0, None))
    axes[0, 0].set_ylabel("Density per px")
    add_legend(figure, axes[0])
    return finish_axes(figure)


STUDY = Study(
    "sigma", 20, run, check, "05_sigma_ablation", ("sigma",), list_shown,
    tables={
        "sigma": Shown("paper/sigma.json", describe_sigma, "sigma_table"),
        "sigma_4000": Shown("paper/sigma_4000.json", describe_sigma),
    },
    figures={"sigma_ablation": draw_sigma, "sigma_pdf": draw_densities}, claims=(judge_sigma,), compared=ERROR_MEASURES,
)  # fmt: skip
