"""Does an answer know how wrong it is: entropy against error, ellipses that hold what they promise, hidden matches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmgsd.config import METHODS, OBJECTS, TrainConfig, load_preset
from mmgsd.figures.style import COLUMN_IN, add_legend, finish_axes, save_figure, styled
from mmgsd.match.matcher import find_weights
from mmgsd.measure import uncertainty as measured
from mmgsd.measure.evaluation import BASELINES, check_same_questions, evaluate_model, load_queries, write_results
from mmgsd.model.tensors import WEIGHTS, load_metadata
from mmgsd.paths import Paths
from mmgsd.studies.claims import NATS, RANKED, Claim, get, get_regions, hold_all, is_above, is_at_least, say
from mmgsd.studies.models import CHANCE_STYLES, SHIPPED, configure_model, get_line_style
from mmgsd.studies.parameters import check_images, check_made
from mmgsd.studies.registry import Experiment, Finding, Measure, Results, Shown, Study
from mmgsd.studies.sample import PAPER_SIZE, ask_sample, load_sample, load_shipped
from mmgsd.studies.table import LABELS, Column, Table, collect_rows

CURVE_POINTS = 200  # of a risk-coverage curve: a PDF of all queries would be large
_ORDER = ("mmgsd", "unimodal", "spcl", "pcl", "sift", "orb")
_THIN = {"linestyle": (0, (4, 1.5)), "linewidth": 0.8}

Tables = Mapping[str, Mapping[str, pd.DataFrame]]


COLUMNS = {
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


def list_models(paths: Paths) -> list[TrainConfig]:
    """The four methods' models, of both objects; all but MMGSD's only where they are trained."""
    config = load_preset(paths.preset)
    models = [configure_model(config, name, method) for name in OBJECTS for method in METHODS]
    return [model for model in models if model.method == "mmgsd" or (paths.model(model) / WEIGHTS).is_file()]


def check(paths: Paths, **options: object) -> None:
    """ValueError where images, models or their calibrated answers are missing."""
    check_images(paths, OBJECTS)
    models, untrained = list_models(paths), [f"{name}-{method}" for name in OBJECTS for method in BASELINES]
    check_made(paths, "03_train with run=True", [paths.model(model) / WEIGHTS for model in models])
    check_made(paths, "04_evaluate with run=True", map(paths.queries, [*(m.name for m in models), *untrained]))


def run(paths: Paths, *, classical: Sequence[str] = ("sift", "orb"), overwrite: bool = False) -> Path:
    """Ask the models once more at temperature 1, as they left training; uncertainty.json, and two figures.

    `mmgsd.studies.main` asked the calibrated ones. The figures have those hand-made descriptors that are ``classical``.
    """
    config = load_preset(paths.preset).evaluate
    before, after = ({name: {} for name in OBJECTS} for _ in range(2))
    for model in list_models(paths):
        inputs = (paths.model(model) / WEIGHTS, paths.dataset(model.object), config)
        out = evaluate_model(*inputs, paths.queries(f"{model.name}-uncalibrated"), temperature=1.0, overwrite=overwrite)
        before[model.object][model.method] = load_queries(out)
        after[model.object][model.method] = load_queries(paths.queries(model.name))
    tables = {name: methods | {m: load_queries(paths.queries(f"{name}-{m}")) for m in BASELINES}
              for name, methods in after.items()}  # fmt: skip
    for name, methods in tables.items():
        check_same_questions(methods | {f"{m}, uncalibrated": table for m, table in before[name].items()})
    summary = {when: {name: {m: measured.summarise_uncertainty(table) for m, table in methods.items()}
                      for name, methods in by_object.items()}
               for when, by_object in {"calibrated": tables, "temperature 1": before}.items()}  # fmt: skip
    file = write_results(summary, paths.results / "uncertainty.json")
    selected_tables = {o: {m: t for m, t in ts.items() if m in (*METHODS, *classical)} for o, ts in tables.items()}
    save_figure(plot_risk_coverage(selected_tables), paths.figures / "risk_coverage")
    save_figure(plot_calibration(before, after), paths.figures / "calibration")
    return file


def read_temperatures(study: Experiment) -> pd.DataFrame:
    """What the heatmaps' logits are divided by, of the trained models or else of the shipped ones."""
    weights = {(o, m): find_weights(o + SHIPPED[m]) for o in OBJECTS for m in PAPER_SIZE}
    if study.runs:
        weights = {(m.object, m.method): study.paths.model(m) / WEIGHTS for m in list_models(study.paths)}
    return pd.Series({key: float(load_metadata(path)["temperature"]) for key, path in weights.items()}).unstack()


def tabulate(results: Results) -> pd.DataFrame:
    """The measures before and after the calibration, a row each of an object and a method."""
    when = {"1 before": "temperature 1", "2 after": "calibrated"}
    rows = {(o, m, w): v for w, key in when.items() for o, methods in results[key].items() for m, v in methods.items()}
    columns = ["spearman", "aurc", "aurc_share", "coverage@50%", "coverage@90%", "coverage@95%", "ece"]
    columns += ["auroc_occluded", "auroc_absent"]
    return pd.DataFrame(rows).T.sort_index()[columns].astype(float)


def tabulate_nearest(errors: Results) -> pd.DataFrame:
    """Mean distance (px) to the nearest match of the most probable and of the narrowest mode, from rmse.json."""
    rows = {(name, m): row for name, methods in errors.items() for m, row in methods.items() if m in METHODS}
    return pd.DataFrame(rows).T[["nearest_mean", "best_mean"]].astype(float)


def ask_surer_half(root: Path) -> pd.DataFrame:
    """The mean error (px) of the shipped weights about the sample: of all queries, and of those with less entropy."""
    rows = {}
    for name, method in ((name, method) for name in OBJECTS for method in PAPER_SIZE):
        table = ask_sample(load_shipped(name, method), load_sample(root, name))
        seen = table[table.visible]
        surer = seen[seen.entropy <= seen.entropy.median()]
        rows[name, method] = {"all": seen.rmse_px.mean(), "surer half": surer.rmse_px.mean()}
    return pd.DataFrame(rows).T


def describe_uncertainty(results: Results) -> Table:
    """Quality of the uncertainties; an arrow leads from temperature 1 to the calibrated one."""
    before = results["temperature 1"]
    joined = {name: {method: {**row, "before": get(before, name, method)} for method, row in methods.items()}
              for name, methods in results["calibrated"].items()}  # fmt: skip
    return Table("", COLUMNS, collect_rows(joined, LABELS), OBJECTS)


def judge_entropy(results: Results) -> Claim:
    """Entropy as a measure of uncertainty."""
    ranks = {name: get(results, "uncertainty", "calibrated", name, "mmgsd", "spearman") for name in OBJECTS}
    return Claim(
        "entropy", "The heatmap's entropy measures uncertainty.",
        f"Rank correlation of MMGSD's entropy and error of {RANKED} or more; a part each object.",
        ", ".join(f"{name} {say(rank, 'share')}" for name, rank in ranks.items()),
        tuple(is_at_least(rank, RANKED) for rank in ranks.values()), models=("mmgsd",),
    )  # fmt: skip


def judge_inward(results: Results) -> Claim:
    """Where the uncertainty lies, as the symmetry study's model of c4 has it."""
    nats = get_regions(results, "c4", "entropy")
    corner, edge, interior = (nats.get(region) for region in ("corner", "edge", "interior"))
    least = hold_all([is_above(edge, corner), is_above(interior, corner)])
    text = ", ".join(f"{region} {say(value, 'share')}" for region, value in nats.items())
    return Claim(
        "inward", "Uncertainty is least at the extremities and grows inwards.",
        f"MMGSD's entropy is at least {NATS} nats lower at the cloth's corners than at edges and inside, a part, and "
        "lower at edges than inside, a part.", f"nats: {text}; studies' budget, one seed",
        (least, is_above(interior, edge)), "`08_symmetry_study`", runs="symmetry",
    )  # fmt: skip


def count_finding(results: Results) -> dict[str, str]:
    """The rank correlations."""
    rows = results["uncertainty"]["calibrated"]
    return {name: f"{rows[name]['mmgsd']['spearman']:.2f}" for name in OBJECTS} | {"seeds": "1"}


@styled
def plot_risk_coverage(queries: Tables) -> Figure:
    """Mean error of the queries kept against their share, least entropy first; dashed: MMGSD ordered by its errors.

    ``queries`` {object: {method: table}}, a panel an object, a line a method; chance, which is never certain, is left
    out, as are queries with a hidden source.
    """
    figure, axes = _make_row(len(queries))
    for axis, (name, methods) in zip(axes, queries.items(), strict=True):
        for method in _sort_methods(methods):
            seen = methods[method][methods[method].visible]
            style = get_line_style(method)
            _draw_risk(axis, seen.rmse_px, seen.entropy, style)
            if method == "mmgsd":
                _draw_risk(axis, seen.rmse_px, seen.rmse_px, style | _THIN | {"label": f"{style['label']}, oracle"})
        axis.set(title=name.capitalize(), xlabel="Queries kept (%)", xlim=(0, 100), ylim=(0, None))
    axes[0].set_ylabel("Mean RMSE (px)")
    add_legend(figure, axes)
    return finish_axes(figure)


@styled
def plot_calibration(before: Tables, after: Tables) -> Figure:
    """Share of true matches inside the ellipses against the share that they promise; grey: perfectly calibrated.

    ``before`` (thin, dashed) and ``after`` (solid) the calibration, {object: {method: table}} of the same
    objects; a method in one of them only has that line only.
    """
    figure, axes = _make_row(len(before))
    for axis, name in zip(axes, before, strict=True):
        _draw_diagonal(axis, name, "Expected coverage (%)")
        for method in _sort_methods(after[name]):
            _draw_coverage(axis, after[name][method], get_line_style(method))
        for method in _sort_methods(before[name]):
            label = "" if method in after[name] else get_line_style(method)["label"]
            _draw_coverage(axis, before[name][method], get_line_style(method) | _THIN | {"label": label})
    axes[0].set_ylabel("Observed coverage (%)")
    axes[0].plot([], [], color="0.3", label="Before calibration", **_THIN)
    add_legend(figure, axes)
    return finish_axes(figure)


@styled
def plot_reliability(before: Mapping[str, pd.DataFrame], after: Mapping[str, pd.DataFrame]) -> Figure:
    """Reliability diagram: how often a match is near a mode, against the confidence that it is; grey: calibrated.

    ``before`` (rings) and ``after`` (dots with 95 % intervals) the calibration, {object: rows} of the same objects by
    `mmgsd.measure.uncertainty.compute_reliability`.
    """
    figure, axes = _make_row(len(before))
    style = get_line_style("mmgsd")
    for axis, name in zip(axes, before, strict=True):
        _draw_diagonal(axis, name, "Confidence (%)")
        axis.plot(100 * before[name].expected, 100 * before[name].observed, "o", ms=3.5, mfc="white", mec="0.45",
                  mew=0.8, ls=_THIN["linestyle"], lw=_THIN["linewidth"], c="0.45", label="Gaussian")  # fmt: skip
        rows = 100 * after[name][["expected", "observed", "margin"]]
        axis.errorbar(rows.expected, rows.observed, rows.margin, fmt="o-", ms=3.5, lw=1, elinewidth=0.8,
                      color=style["color"], label="Calibrated", zorder=style["zorder"])  # fmt: skip
    axes[0].set_ylabel("A match is near (%)")
    add_legend(figure, axes)
    return finish_axes(figure)


def _draw_diagonal(axis: Axes, name: str, promised: str) -> None:
    """Axes in % and the line of what keeps its promise."""
    axis.plot([0, 100], [0, 100], color="0.75", lw=0.8, zorder=1)
    axis.set(title=name.capitalize(), xlabel=promised, xlim=(0, 100), ylim=(0, 100), aspect="equal",
             xticks=range(0, 101, 25), yticks=range(0, 101, 25))  # fmt: skip


def _make_row(count: int) -> tuple[Figure, np.ndarray]:
    figure, axes = plt.subplots(1, count, figsize=(COLUMN_IN, 2.2), layout="constrained", squeeze=False)
    return figure, axes[0]


def _sort_methods(methods: Iterable[str]) -> list[str]:
    """The methods that are not chance: those of the paper's tables in their order, then others."""
    others = [m for m in methods if m not in _ORDER and m not in CHANCE_STYLES]
    return [m for m in _ORDER if m in methods] + others


def _draw_risk(axis: Axes, error: pd.Series, score: pd.Series, style: dict) -> None:
    coverage, risk = measured.compute_risk_coverage(error, score)
    chosen = np.unique((np.arange(1, CURVE_POINTS + 1) * len(risk) - 1) // CURVE_POINTS)  # the last always
    axis.plot(100 * coverage[chosen], risk[chosen], **style)


def _draw_coverage(axis: Axes, queries: pd.DataFrame, style: dict) -> None:
    shares = measured.compute_coverage(measured.get_distances(queries))
    axis.plot(100 * np.array(measured.LEVELS), 100 * shares, **style)


STUDY = Study(
    "uncertainty", 80, run, check, "06_uncertainty", ("uncertainty",),
    lambda paths, **_: [paths.results / "uncertainty.json", paths.results / "rmse.json"],
    tables={"uncertainty": Shown("paper/uncertainty.json", describe_uncertainty, "uncertainty_table")},
    claims=(judge_entropy, judge_inward),
    findings=(
        Finding(6, "Entropy ranks errors", ", so that the less certain can be refused: rank correlation",
                "does-an-answer-know-how-wrong-it-is", count_finding),
    ),
    compared={
        "aurc": Measure(share=0.03, like="rmse_mean"),  # px: a mean of RMSE
        "spearman": Measure(floor=0.05),  # no seeds are stored of this and the next two
        # on another kind of CPU those of a rope's SPCL, before calibration, moved by 0.10 and 0.09 (LOG.md, 2026-11-28)
        "coverage@90%": Measure(floor=0.05, contrastive=0.15),
        "ece": Measure(floor=0.05, contrastive=0.15),
    },
)  # fmt: skip
