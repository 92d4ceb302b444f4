"""The main study: the methods' errors on the test images, how they are spread, and what the methods answer."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter1d

from mmgsd.config import METHODS, N_POINTS, OBJECTS, TrainConfig, load_preset
from mmgsd.dataset import load_dataset
from mmgsd.figures import style
from mmgsd.figures.plots import plot_teaser
from mmgsd.match.match import Match
from mmgsd.measure import evaluation
from mmgsd.measure.metrics import BIN_PX
from mmgsd.measure.questions import choose_points
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_root
from mmgsd.studies import figure_data
from mmgsd.studies.claims import MARGIN, Claim, get, is_at_least, list_errors, list_shares, say
from mmgsd.studies.figure_data import FigureData, load_figure_data
from mmgsd.studies.matrix import ALL, run_each, write_main_table
from mmgsd.studies.models import CHANCE_STYLES, PAPER, configure_study, get_label, get_line_style
from mmgsd.studies.parameters import Reader, among, check_images, check_made, listed
from mmgsd.studies.registry import ERROR_MEASURES, Finding, Results, Shown, Study
from mmgsd.studies.sample import load_sample, load_shipped
from mmgsd.studies.seeds import LEVEL, SEEDS, average_seeds, mark_tested, say_count, tell_apart
from mmgsd.studies.table import LABELS, Table, describe_errors, describe_objects

IMPROVEMENT = 0.477  # on SPCL, as the paper reports it
DRAWN, POINTS = ("sift", "orb"), (0, 104, 208, 312)  # in the figures: hand-made descriptors, and material points
OURS = {"mmgsd_plain": "its own loss alone", "mmgsd": "a dense supervision besides, which the paper does not have"}
HEADLINE = (
    "mmgsd", "mmgsd_plain", "mmgsd_long", "mmgsd_muon", "spcl_dense", "spcl", "unimodal", "pcl", "sift", "centre",
)  # fmt: skip
SEGMENTS = 25  # of a rope
SHOWN = 0.95  # share of a method's errors that the axis of their distribution holds


def read_points(preset: str) -> Reader:
    """A reader of material points that a preset asks about."""
    points = choose_points(load_preset(preset).evaluate.points, N_POINTS)
    return listed(among(points, "the points that the preset asks about"))


def check(paths: Paths, **options: Any) -> None:
    """ValueError where test images are not rendered, or the models of the preset not trained."""
    check_images(paths, OBJECTS)
    models = load_preset(paths.preset).train.values()
    check_made(paths, "03_train with run=True", [paths.model(m) / WEIGHTS for m in models])


def run(
    paths: Paths, *, overwrite: bool = False, drawn: Sequence[str] = DRAWN, points: Sequence[int] = POINTS
) -> Path:
    """Ask all models of the main table that are trained, hand-made descriptors and chance; rmse.json.

    The figures get those ``drawn`` besides the four methods, and answers about material ``points`` of one example.
    """
    config, untrained = load_preset(paths.preset), evaluation.BASELINES + evaluation.CHANCE
    tasks, weights = {}, {}
    for name in OBJECTS:
        models = configure_study(config, name, "main")
        weights[name] = {m: paths.model(model) / WEIGHTS for m, model in models.items()}
        there = [m for m in models if m == "mmgsd" or weights[name][m].is_file()]
        tasks |= {(name, m): (name, m, models.get(m)) for m in (*there, *untrained)}
    answers = dict(run_each(partial(_ask, paths=paths, overwrite=overwrite), tasks, desc="methods"))
    query_files = {name: {m: path for (object, m), path in answers.items() if object == name} for name in OBJECTS}
    stored = write_main_table(config, paths.root)
    for name, files in query_files.items():
        queries = {m: evaluation.load_queries(path) for m, path in files.items()}
        evaluation.check_same_questions(queries)
        trained = {m: weights[name][m] for m in METHODS if m in files}
        errors = {m: queries[m] for m in (*trained, *drawn, *evaluation.CHANCE)}
        data, file = load_dataset(paths.dataset(name), "test"), paths.results / f"figures_{name}.safetensors"
        gathered = figure_data.gather_figure_data(errors, trained, data, points=points)
        figure_data.save_figure_data(figure_data.keep_stored(gathered, file, stored[name]), file)
    return paths.results / "rmse.json"


def _ask(task: tuple[str, str, TrainConfig | None], *, paths: Paths, **how: bool) -> Path:
    """The table of answers of an object's method, of which a trained one has a model."""
    name, method, model = task
    question = paths.dataset(name), load_preset(paths.preset).evaluate
    if model is None:
        return evaluation.evaluate_baseline(method, *question, paths.queries(f"{name}-{method}"), **how)
    return evaluation.evaluate_model(paths.model(model) / WEIGHTS, *question, paths.queries(model.name), **how)


def list_drawn(results: Path) -> dict[str, Path]:
    """{object: the file that figures are drawn from} of a preset's folder of results."""
    return {name: results / f"figures_{name}.safetensors" for name in OBJECTS}


def load_drawn(results: Path) -> dict[str, FigureData]:
    """{object: what the figures are drawn from} of a preset's folder of results."""
    return {name: load_figure_data(path) for name, path in list_drawn(results).items()}


def describe_main(results: Results, *, methods: Iterable[str] = tuple(LABELS)) -> Table:
    """The methods' errors with the paper's own, which are not of the smaller budget."""
    theirs = {name: {"rmse_mean": error} for name, error in PAPER.items()}
    table = describe_errors(results, methods=methods)
    return dataclasses.replace(table, quoted={"*the paper's MMGSD, 3,500 images each*": theirs})


def describe_presets(results: Mapping[str, Results]) -> Table:
    """MMGSD's RMSE by preset, from {path of the results file: errors}."""
    rows = {f"`{Path(path).parent}`": {name: errors[name]["mmgsd"]["rmse_mean"] for name in OBJECTS}
            for path, errors in results.items()}  # fmt: skip
    return describe_objects("preset", rows, {"cloth": "MMGSD's RMSE px: cloth", "rope": "rope"}, ".0f")


def judge_rmse(results: Results, *, row: str = "mmgsd_plain") -> Claim:
    """The paper's headline errors, of the paper's own loss alone."""
    rows, seeds = _read_errors(results, row)
    errors = {name: get(rows, name, row, "rmse_mean") for name in OBJECTS}
    parts = tuple(is_at_least(PAPER[name], errors[name]) for name in OBJECTS)
    claim = " and ".join(f"{PAPER[name]} px on {name}" for name in OBJECTS)
    plain = row == "mmgsd_plain"
    return Claim(
        "rmse" if plain else "rmse-dense", f"MMGSD's error is {claim}; here with {OURS[row]}.",
        "Ours is no larger; a part each object.", f"{list_errors(errors)}, {say_count(seeds)}", parts,
        models=(row,), **_say_runs(seeds, ALL if plain else "`03_train`, `04_evaluate`"),
    )  # fmt: skip


def judge_better(results: Results) -> Claim:
    """Whether it errs less than the contrastive baseline, neither with dense supervision; other pairs beside."""
    gains, seeds = _list_gains(results, "mmgsd_plain", "spcl")
    budget = {name: _compute_gain(get(results, "budget", name), "mmgsd_plain", "spcl") for name in OBJECTS}
    others = {
        "SPCL taught hidden matches too": _list_gains(results, "mmgsd_plain", "spcl_hidden"),
        "the same at the studies' budget": (budget, 1),
        "both with dense supervision": _list_gains(results, "mmgsd", "spcl_dense"),
        "MMGSD alone with it": _list_gains(results, "mmgsd", "spcl"),
    }
    beside = "".join(f"; {other}: {list_shares(row)}, {say_count(count)}" for other, (row, count) in others.items()
                     if any(row.values()))  # fmt: skip
    told = tell_apart(results, "spcl").values()
    return Claim(
        "better", "MMGSD's error is below SPCL's; here each with its own loss alone.",
        f"It is by {100 * MARGIN:.0f} % or more, a part each object; three seeds tell it from chance on both, a part.",
        f"{list_shares(gains)}, {say_count(seeds)}{beside}",
        (*(is_at_least(each, MARGIN) for each in gains.values()), all(p < LEVEL for _, p in told) if told else None),
        models=("mmgsd_plain", "mmgsd", "spcl", "spcl_dense", "spcl_hidden"), **_say_runs(seeds, ALL),
    )  # fmt: skip


def judge_improvement(results: Results) -> Claim:
    """The paper's number for that distance."""
    gains, seeds = _list_gains(results, "mmgsd_plain", "spcl")
    mean = None if None in gains.values() else sum(gains.values()) / len(gains)
    return Claim(
        "improvement",
        f"MMGSD's error is {100 * IMPROVEMENT:.1f} % below SPCL's on average; here each with its own loss alone.",
        "MMGSD's mean improvement over the objects is as large.",
        f"{list_shares(gains)}, mean {say(mean, 'percent')}; {say_count(seeds)}", (is_at_least(mean, IMPROVEMENT),),
        models=("mmgsd_plain", "spcl"), **_say_runs(seeds, ALL),
    )  # fmt: skip


def _read_errors(results: Results, *rows: str) -> tuple[Results, int]:
    """{object: {row: errors}} of some rows, means over seeds where all have enough, and of how many seeds they are."""
    means = average_seeds(results, *rows)
    return (means, SEEDS) if means else (results.get("rmse", {}), 1)


def _say_runs(seeds: int, command: str) -> dict[str, str]:
    """What repeats a claim's numbers, and the results file that says what it took, of so many ``seeds``."""
    return {"command": f"{ALL[:-1]} --seeds {SEEDS}`", "runs": "seeds"} if seeds > 1 else {"command": command}


def _list_gains(results: Results, row: str, other: str) -> tuple[dict[str, float | None], int]:
    """By how much the error of one row is below the other's, of each object, and of how many seeds (`_read_errors`)."""
    errors, seeds = _read_errors(results, row, other)
    return {name: _compute_gain(errors.get(name), row, other) for name in OBJECTS}, seeds


def _compute_gain(methods: Mapping[str, Any] | None, method: str, other: str) -> float | None:
    ours, theirs = (get(methods, name, "rmse_mean") for name in (method, other))
    return None if ours is None or theirs is None else 1 - ours / theirs


def count_finding(results: Results, *, row: str, other: str) -> dict[str, str]:
    """By how much of the larger error's the two of a finding differ, of each object; marked where seeds tell."""
    gains, seeds = _list_gains(results, row, other)
    told = tell_apart(results, other)
    each = {name: say(gain, "percent") + mark_tested(told, name, other) for name, gain in gains.items()}
    return each | {"seeds": f"{seeds}"}


@style.styled
def plot_rmse_pdf(drawn: Mapping[str, FigureData]) -> Figure:
    """Probability density of the error of a query with a visible source, as a percentage of the object's size.

    A panel an object, a line a method, chance dashed. The object's size is the diagonal of its bounding box, mean over
    the test images (``compute_object_size``). Smoothed with a std of 1 %.
    """
    figure, axes = plt.subplots(len(drawn), 1, figsize=(style.COLUMN_IN, 0.4 + 1.4 * len(drawn)), layout="constrained",
                                sharex=True, squeeze=False)  # fmt: skip
    far = 0.0
    for axis, (name, data) in zip(axes[:, 0], drawn.items(), strict=True):
        step = 100 * BIN_PX / data.object_size_px  # %
        for method, summary in data.errors.items():
            axis.plot(*compute_density(summary.histogram, step), **get_line_style(method))
            cumulated = np.cumsum(summary.histogram)
            if method not in CHANCE_STYLES:  # chance would leave half of the axis empty
                far = max(far, step * (1 + int(np.searchsorted(cumulated, SHOWN * cumulated[-1]))))
        axis.set(title=name.capitalize(), ylabel="Density per %", ylim=(0, None))
    axes[-1, 0].set(xlabel="Error (% of the object's bounding-box diagonal)", xlim=(0, far))
    style.add_legend(figure, axes[:, 0])
    return style.finish_axes(figure)


@style.styled
def plot_spatial_rmse(drawn: Mapping[str, FigureData], *, mapped: Sequence[str] = ("mmgsd", "spcl")) -> Figure:
    """Mean error over the rope's length for every method (1-D), and over the cloth's area for those ``mapped`` (2-D).

    Each map has a scale of its own, so that a lesser error's map is not flat; points never asked stay grey.
    """
    errors = {name: data.errors for name, data in drawn.items()}
    mapped = [method for method in mapped if method in errors["cloth"]]
    figure, axes = plt.subplots(1, 1 + len(mapped), figsize=(style.PAGE_IN, 2.1), layout="constrained",
                                width_ratios=[1.8] + [1.0] * len(mapped))  # fmt: skip
    for method, summary in errors["rope"].items():
        seen = np.flatnonzero(summary.asked)
        mean = pd.Series(summary.mean_px[seen]).groupby(seen * SEGMENTS // N_POINTS).mean()
        axes[0].plot((mean.index + 0.5) * 100 / SEGMENTS, mean, **get_line_style(method))
    axes[0].set(title="Rope", xlabel="Position along the rope (%)", ylabel="RMSE (px)", xlim=(0, 100), ylim=(0, None))
    maps = [errors["cloth"][method].mean_px.reshape(25, 25) for method in mapped]
    for axis, method, values in zip(axes[1:], mapped, maps, strict=True):
        image = axis.imshow(values, cmap=colormaps["viridis"].with_extremes(bad="0.85"))
        axis.set_title(f"Cloth · {get_label(method, short=True)}, RMSE (px)")
        figure.colorbar(image, ax=axis, shrink=0.8)
    style.name_grid(axes[1:])
    style.add_legend(figure, axes[:1])
    return style.finish_axes(figure, keep_box=axes[1:])


@style.styled
def plot_combined(drawn: Mapping[str, FigureData], *, sigma_px: float = 10.0) -> Figure:
    """A: contrastive answers, B: the true and MMGSD's distribution of the same query, C: queries moved inwards.

    A and B are about the example's query of which the methods differ most (`choose_contrast`), contrastive ones where
    they are trained; true matches are crosses, and in B Gaussians of ``sigma_px``, wide enough to be seen. C is about
    all four queries, extremity first. Modes are rings with their 1-std ellipses.
    """
    ours = [data.answers["mmgsd"] for data in drawn.values()]
    aspects = [match.image1.shape[0] / match.image1.shape[1] for match in ours]
    figure, axes = style.make_grid(2 * aspects, 5, style.PAGE_IN)
    for line, inwards, (name, data) in zip(axes, axes[len(drawn) :], drawn.items(), strict=False):
        query = figure_data.choose_contrast(data)
        answers = {method: match[query] for method, match in data.answers.items()}
        _draw_comparison(line, answers, data.true[query], sigma_px)
        _draw_inwards(inwards, data.answers["mmgsd"])
        for axis in (line[0], inwards[0]):
            axis.set_ylabel(name.capitalize())
    for axis, title in zip(axes[0], (r"$\bf{A}$  Source", "PCL", "SPCL", r"$\bf{B}$  True", "MMGSD"), strict=True):
        axis.set_title(title)
    axes[len(drawn), 0].set_title(r"$\bf{C}$  Sources 1–4")
    return figure


def _draw_comparison(line: Sequence[Axes], methods: Mapping[str, Match], true: np.ndarray, sigma_px: float) -> None:
    match = methods["mmgsd"]
    style.show_source(line[0], match, 0)
    for axis, method in zip(line[[1, 2, 4]], ("pcl", "spcl", "mmgsd"), strict=True):
        if method in methods:
            style.show_answer(axis, methods[method], 0)
            style.mark_true(axis, true)
        else:
            axis.set_axis_off()
            axis.text(0.5, 0.5, "not trained", ha="center", va="center", fontsize=6, transform=axis.transAxes)
    ys, xs = np.mgrid[: match.image1.shape[0], : match.image1.shape[1]]
    mixture = sum(np.exp(-((xs - x) ** 2 + (ys - y) ** 2) / (2 * sigma_px**2)) for x, y in true)
    line[3].imshow(style.blend_heatmap(match.image1, mixture))
    style.mark_true(line[3], true)


def _draw_inwards(line: Sequence[Axes], match: Match) -> None:
    line[0].imshow(match.image0)
    for index, (x, y) in enumerate(match.xy):
        line[0].text(x, y, str(index + 1), ha="center", va="center", fontsize=5.5, zorder=3,
                     bbox={"boxstyle": "circle,pad=0.15", "fc": style.MARK, "ec": "black", "lw": 0.6})  # fmt: skip
        style.show_answer(line[index + 1], match, index)
        line[index + 1].set_title(f"{index + 1} · {match.entropy[index]:.1f} nats")


def compute_density(histogram: np.ndarray, step: float, *, bandwidth: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Centres (K,) and density (K,) of a histogram of values ≥ 0 in bins of width ``step``.

    It is smoothed by a Gaussian, mirrored at zero.
    """
    padded = np.pad(histogram, (0, int(np.ceil(5 * bandwidth / step))))
    density = gaussian_filter1d(padded / (padded.sum() * step), bandwidth / step, mode="reflect")
    return (np.arange(len(padded)) + 0.5) * step, density


STUDY = Study(
    "main", 10, run, check, "04_evaluate", ("rmse",),
    lambda paths, **_: [paths.results / "rmse.json", *list_drawn(paths.results).values()],
    tables={
        "headline": Shown("paper/rmse.json", partial(describe_main, methods=HEADLINE)),
        "paper": Shown("paper/rmse.json", describe_main, "main_table"),
        "quick": Shown("quick/rmse.json", describe_main),
        "presets": Shown(("quick/rmse.json", "paper/rmse.json"), describe_presets),
    },
    figures={
        "teaser": lambda _: plot_teaser(  # of the sample, as the shipped weights answer it, whatever the results
            {name: figure_data.ask_plain(load_shipped(name), load_sample(find_root(), name)) for name in OBJECTS}),
        "combined": lambda results: plot_combined(load_drawn(results)),
        "rmse_pdf": lambda results: plot_rmse_pdf(load_drawn(results)),
        "spatial_rmse": lambda results: plot_spatial_rmse(load_drawn(results)),
    },
    claims=(judge_rmse, partial(judge_rmse, row="mmgsd"), judge_better, judge_improvement),
    findings=(
        Finding(1, "MMGSD errs less than SPCL", ", each with its own loss alone", "which-method-is-best",
                partial(count_finding, row="mmgsd_plain", other="spcl")),
        Finding(2, "The same where SPCL is taught hidden matches", ", as MMGSD is", "which-method-is-best",
                partial(count_finding, row="mmgsd_plain", other="spcl_hidden")),
        Finding(3, "MMGSD errs less than SPCL", ", both with dense supervision", "which-method-is-best",
                partial(count_finding, row="mmgsd", other="spcl_dense")),
        Finding(4, "MMGSD errs less than Unimodal", ", told one match, where any pose is as probable",
                "which-method-is-best", partial(count_finding, row="mmgsd", other="unimodal")),
    ),
    compared=ERROR_MEASURES,
)  # fmt: skip
