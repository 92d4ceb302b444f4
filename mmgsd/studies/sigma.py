"""The study of σ, the width of the targets."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.figures.style import (
    COLUMN_IN,
    check_filled,
    finish_axes,
    styled,
)
from mmgsd.studies.models import get_colour

OTHER_SEED = re.compile(r"mmgsd-[1-9]")


@styled
def plot_sigma_ablation(
    results: Mapping[str, Mapping[str, Mapping[str, float]]], *, seeds: Mapping[str, Mapping[str, Any]] | None = None
) -> Figure:
    """``rmse_mean`` of MMGSD against the std σ of its targets: ``results`` {object: {σ px: {metric: value}}}.

    Rings at σ = 1 px are ``seeds`` {object: {"mmgsd-1": {metric: value}}} of the same training, but for the seed 0.
    """
    for name, rows in {"": results, **results}.items():
        check_filled(f"results[{name!r}]" if name else "results", rows)
    figure, axes = plt.subplots(1, len(results), figsize=(COLUMN_IN, 1.7), layout="constrained", squeeze=False)
    for axis, (name, rows) in zip(axes[0], results.items(), strict=True):
        points = sorted((float(sigma), metrics["rmse_mean"]) for sigma, metrics in rows.items())
        sigma, error = zip(*points, strict=True)
        axis.plot(sigma, error, "o-", ms=3.5, color=get_colour("mmgsd"))
        others = [row["rmse_mean"] for key, row in (seeds or {}).get(name, {}).items() if OTHER_SEED.match(key)]
        axis.plot([1.0] * len(others), others, "o", ms=3.5, mfc="none", color=get_colour("mmgsd"))
        for x, y in points:
            axis.annotate(f"{y:.1f}", (x, y), xytext=(0, 4), textcoords="offset points", ha="center", fontsize=6.5)
        axis.set_xscale("log", base=2)
        axis.set_xticks(sigma, [f"{s:g}" for s in sigma])
        axis.set(title=name.capitalize(), xlabel="σ of the targets (px)", ylim=(0, 1.2 * max(error)))
        axis.margins(x=0.15)
    axes[0, 0].set_ylabel("RMSE of MMGSD (px)")
    return finish_axes(figure)
