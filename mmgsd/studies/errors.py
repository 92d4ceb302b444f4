"""Where the error is: against occlusion, the objects' states, the distance to the border and to a fold."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.ndimage import distance_transform_cdt

from mmgsd.config import OBJECTS, TrainConfig, load_preset
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.figures import style
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher
from mmgsd.measure.evaluation import evaluate_model, load_queries, read_results, write_results
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_shipped
from mmgsd.studies.claims import NATS, Claim, get, is_above, say
from mmgsd.studies.models import SHIPPED, configure_model, get_colour
from mmgsd.studies.parameters import check_images, check_made
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import Table, describe_objects

SEEN, KNOT, OTHERS = ("seen", "hidden"), "overhand knot", "other states"  # kinds of queries; a rope's states
FEW_PAIRS = 5  # of images: their mean says as much of them as of their states
QUESTIONS = {
    "hidden": ("hidden\nmatches", [0, 1, 2, 3, 4, 5]),
    "seen_target": ("visible share\nof target", [0, 0.4, 0.6, 0.8, 0.95, 1.01]),
    "border": ("points to\nthe border", [0, 1, 3, 6, 9, 13]),
    "covered": ("points to\na hidden one", [1, 2, 4, 8, 16, 1000]),
}
LENGTHS = {"border": [0, 16, 48, 96, 160, 313], "covered": [1, 4, 16, 48, 96, 1000]}  # the same along a rope


def list_models(preset: str, method: str, objects: Sequence[str]) -> dict[str, TrainConfig]:
    """{object: training} of a method of the main table."""
    return {name: configure_model(load_preset(preset), name, method) for name in objects}


def check(paths: Paths, *, method: str = "mmgsd", objects: Sequence[str] = OBJECTS, worst: int = 24) -> None:
    """ValueError where images or models are missing."""
    check_images(paths, objects)
    files = [find_model(paths, model) for model in list_models(paths.preset, method, objects).values()]
    check_made(paths, "03_train, or python -m mmgsd run models,", files, method=method)


def find_model(paths: Paths, model: TrainConfig) -> Path:
    """The weights of a training as it was done here, else as they are shipped; where neither is, the former's path."""
    trained = paths.model(model) / WEIGHTS
    shipped = (find_shipped() / f"{model.object}{kind}.safetensors" for kind in SHIPPED.values())
    same = (file for file in shipped if file.is_file() and Matcher.load(file).config == model)
    return trained if trained.is_file() else next(same, trained)


def run(paths: Paths, *, method: str = "mmgsd", objects: Sequence[str] = OBJECTS, worst: int = 24) -> Path:
    """Join the answers of a method with what the labels know; errors.json, entropy.json, figures of the ``worst``.

    Where the model was not trained here, the same one is asked that is shipped. Of another method than MMGSD these
    files have its name. An object that is left out stays in them.
    """
    suffix = _get_suffix(method)
    tables, explained, nats = {}, {}, {}
    for name, model in list_models(paths.preset, method, objects).items():
        data = load_dataset(paths.dataset(name), "test")
        weights, questions = find_model(paths, model), load_preset(paths.preset).evaluate
        answers = evaluate_model(weights, data.folder, questions, paths.queries(model.name))
        tables[name] = describe_queries(load_queries(answers), data)
        explained[name], nats[name] = explain_errors(tables[name]), summarise_entropy(tables[name])
        sheet = plot_worst_queries(tables[name], data, Matcher.load(weights), count=worst)
        style.save_figure(sheet, paths.figures / f"worst_{name}{suffix}", kinds=("jpg",))
    style.save_figure(plot_error_analysis(tables), paths.figures / f"error_analysis{suffix}")
    file, other = (paths.results / f"{name}{suffix}.json" for name in ("errors", "entropy"))
    write_results(read_results(other) | nats, other)
    return write_results(read_results(file) | explained, file)


def _get_suffix(method: str) -> str:
    """What the names of a method's files end with."""
    return "" if method == "mmgsd" else f"_{method}"


def list_shown(paths: Paths, *, method: str = "mmgsd", **_: Any) -> list[Path]:
    """The results file of a method's errors."""
    return [paths.results / f"errors{_get_suffix(method)}.json"]


def list_figures(paths: Paths, *, method: str = "mmgsd", objects: Sequence[str] = OBJECTS) -> list[Path]:
    """Those of a method's figures that are there: of some methods the repository holds the numbers alone."""
    suffix = _get_suffix(method)
    names = [f"error_analysis{suffix}.png", *(f"worst_{name}{suffix}.jpg" for name in objects)]
    return [path for path in map(paths.figures.joinpath, names) if path.is_file()]


def explain_errors(described: pd.DataFrame) -> dict[str, float]:
    """Mean RMSE (px) of `describe_queries`: of all, and if some difficulty went away."""
    states = summarise_states(described)
    means = {"all": described.rmse_px.mean(), "no match hidden": described[described.hidden == 0].rmse_px.mean(),
             "easiest pair of states": states.min().min()}  # fmt: skip
    hardest = described.groupby("state1", observed=True).rmse_px.mean().idxmax()
    spared = described[(described.state0 != hardest) & (described.state1 != hardest)]
    if len(spared):  # smoke may hold but that state
        means["hardest state left out"] = spared.rmse_px.mean()
    return {question: round(float(mean), 2) for question, mean in means.items()}


def describe_queries(queries: pd.DataFrame, data: Dataset) -> pd.DataFrame:
    """The queries with a visible source, each with what may explain its error.

    ``state0``, ``state1`` of source and target; ``seen_target``, the visible share of the target's points; ``border``,
    material points from the source point to the object's border or end; ``covered``, to the nearest hidden point.
    """
    table = queries[queries.visible].copy()
    states = data.labels.state.to_numpy()
    table["state0"], table["state1"] = states[table.image0], states[table.image1]
    table["seen_target"] = data.visible.mean(1)[table.image1]
    shape = (25, 25) if data.object == "cloth" else (data.n_points,)
    inside = np.pad(np.ones(shape, np.uint8), 1)
    border = distance_transform_cdt(inside, "chessboard")[(slice(1, -1),) * len(shape)].ravel() - 1
    covered = np.stack([_measure_covered(seen.reshape(shape)) for seen in data.visible])
    return table.assign(border=border[table.point], covered=covered[table.image0, table.point])


def _measure_covered(seen: np.ndarray) -> np.ndarray:
    """Material points from each one to the nearest hidden one; 999 where all are seen."""
    if seen.all():
        return np.full(seen.size, 999)
    return distance_transform_cdt(seen.astype(np.uint8), "chessboard").ravel()


def summarise_states(described: pd.DataFrame) -> pd.DataFrame:
    """Mean ``rmse_px`` by the states of source (rows) and target (columns)."""
    return described.pivot_table("rmse_px", "state0", "state1", observed=True)


def summarise_entropy(described: pd.DataFrame) -> dict[str, float]:
    """Mean entropy (nats): ``seen`` and ``hidden``, of queries with every and with not every match seen; by target."""
    kinds = described.hidden.gt(0).map({False: "seen", True: "hidden"})
    means = [described.groupby(key, observed=True).entropy.mean() for key in (kinds, "state1")]
    return {str(kind): round(float(mean), 3) for kind, mean in pd.concat(means).items()}


def describe_difficulties(results: Results) -> Table:
    """What would be left of MMGSD's RMSE if some difficulty went away, from {object: {which queries: error}}."""
    kinds = dict.fromkeys(kind for row in results.values() for kind in row)
    rows = {kind: {name: get(results, name, kind) for name in OBJECTS} for kind in kinds}
    return describe_objects("MMGSD's RMSE px", rows)


def judge_hidden(results: Results) -> Claim:
    """Uncertainty where something covers the match; of the heatmap's entropy, not of its mass outside the modes."""
    nats = {name: get(results, "entropy", name) or {} for name in OBJECTS}
    others = [value for state, value in nats["rope"].items() if state not in (*SEEN, KNOT)]
    nats["rope"] = nats["rope"] | ({OTHERS: statistics.mean(others)} if others else {})
    pairs = {f"{name}, {high}": (nats[name].get(high), nats[name].get(low), low)
             for name, low, high in (*((name, *SEEN) for name in OBJECTS), ("rope", OTHERS, KNOT))}  # fmt: skip
    texts = [f"{kind} {say(high, 'share')}, {other} {say(low, 'share')}"
             for kind, (high, low, other) in pairs.items()]  # fmt: skip
    return Claim(
        "hidden", "Uncertainty is high at rope knots and at what is occluded.",
        f"MMGSD's entropy is at least {NATS} nats higher where a match is hidden, a part each object, and on knotted "
        "ropes than in a rope's other states on average, a part.", f"nats, {'; '.join(texts)}; one seed",
        tuple(is_above(high, low) for high, low, _ in pairs.values()), models=("mmgsd",),
    )  # fmt: skip


@style.styled
def plot_error_analysis(tables: Mapping[str, pd.DataFrame]) -> Figure:
    """A row an object ({object: `describe_queries`}): mean RMSE by states, and against what may explain it.

    In brackets where fewer than ``FEW_PAIRS`` pairs of images have these states.
    """
    size, ratios = (style.PAGE_IN, 2.1 * len(tables)), [1.5] + [1] * len(QUESTIONS)
    figure, axes = plt.subplots(len(tables), len(ratios), figsize=size, squeeze=False, layout="constrained",
                                width_ratios=ratios)  # fmt: skip
    for line, (name, table) in zip(axes, tables.items(), strict=True):
        _draw_states(line[0], table, name)
        for axis, (column, (label, edges)) in zip(line[1:], QUESTIONS.items(), strict=True):
            _draw_bins(axis, table, column, edges if name == "cloth" else LENGTHS.get(column, edges))
            axis.set(xlabel=label, ylim=(0, None))
        line[1].set_ylabel("RMSE (px)")
    return style.finish_axes(figure, keep_box=axes[:, 0].tolist())


def _draw_states(axis: Axes, table: pd.DataFrame, name: str) -> None:
    means = summarise_states(table)
    pairs = table.pivot_table("pair", "state0", "state1", aggfunc="nunique", observed=True).to_numpy()
    axis.imshow(means, cmap="viridis", vmin=0)
    middle = np.nanmax(means) / 2
    for row, column in np.argwhere(pairs > 0):  # NaN where no pair has these states
        value = means.iloc[row, column]
        text = f"({value:.0f})" if pairs[row, column] < FEW_PAIRS else f"{value:.0f}"
        axis.text(column, row, text, ha="center", va="center", fontsize=6, c="w" if value < middle else "k")
    axis.set(xticks=range(means.shape[1]), yticks=range(means.shape[0]), title=f"{name.capitalize()}: RMSE (px)")
    axis.set(ylabel="source", xlabel="target")
    axis.set_xticklabels(means.columns, rotation=40, ha="right")
    axis.set_yticklabels(means.index)


def _draw_bins(axis: Axes, table: pd.DataFrame, column: str, edges: Sequence[float]) -> None:
    groups = table.groupby(pd.cut(table[column], edges, right=False), observed=True).rmse_px
    means, shares = groups.mean(), groups.size() / len(table)
    axis.bar(range(len(means)), means, color=get_colour("mmgsd"), width=0.75)
    for k, share in enumerate(shares):
        axis.text(k, 0, f" {100 * share:.0f} %", ha="center", va="bottom", fontsize=5.5, c="w", rotation=90)
    whole = all(float(e).is_integer() for e in edges)
    labels = [_name_bin(i.left, i.right - 1) if whole else f"{i.left:g}–{min(i.right, 1):g}" for i in means.index]
    axis.set_xticks(range(len(means)), labels, rotation=40, ha="right")


def _name_bin(first: float, last: float) -> str:
    if last > 900:
        return f"{first:g}+"
    return f"{first:g}" if first == last else f"{first:g}–{last:g}"


@style.styled
def plot_worst_queries(described: pd.DataFrame, data: Dataset, matcher: Any, *, count: int = 24) -> Figure:
    """The ``count`` queries with the greatest error, at most one of each pair of images, the worst first.

    Source and target side by side: the heatmap, the modes, and crosses at the true matches; a legend says so. They are
    asked anew, for a table of answers holds no heatmaps.
    """
    rows = described.sort_values("rmse_px", ascending=False).drop_duplicates("pair").head(count)
    (width, height), columns = data.size, 4
    figure, axes = style.make_grid([height / (2 * width)] * -(-len(rows) // columns), columns, style.PAGE_IN)
    for axis, row in zip(axes.flat, rows.itertuples(), strict=False):
        images = map(data.load_image, (row.image0, row.image1))
        _draw_query(axis, matcher.match(*images, data.xy[row.image0, [row.point]], n=int(row.n)))
        style.mark_true(axis, data.xy[row.image1][data.group().distinct_modes(row.point)])
        axis.set_title(f"{row.rmse_px:.0f} px", fontsize=6)
    for axis in axes.flat[len(rows) :]:
        axis.remove()
    signs = {"asked pixel": ("o", style.MARK, "black"), "mode": ("o", "none", style.MODE),
             "true match": ("+", style.TRUE, style.TRUE)}  # fmt: skip
    handles = [Line2D([], [], ls="", marker=m, mfc=face, mec=edge, ms=5, label=label)
               for label, (m, face, edge) in signs.items()]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=len(signs), fontsize=6)
    return figure


def _draw_query(axis: Axes, match: Match) -> None:
    (height, width), left = match.image1.shape[:2], match.image0.shape[1]
    axis.imshow(match.image0, extent=(-0.5 - left, -0.5, height - 0.5, -0.5))
    blended = style.blend_heatmap(match.image1, match.compute_heatmap())
    axis.imshow(blended, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
    axis.set(xlim=(-0.5 - left, width - 0.5), ylim=(height - 0.5, -0.5))
    style.mark_pixel(axis, match.xy[0, 0] - left, match.xy[0, 1])
    style.draw_modes(axis, match, 0)


STUDY = Study(
    "errors", 90, run, check, "09_error_analysis", ("errors", "entropy"), list_shown,
    tables={"errors": Shown("paper/errors.json", describe_difficulties, "errors_table")},
    claims=(judge_hidden,),
)  # fmt: skip
