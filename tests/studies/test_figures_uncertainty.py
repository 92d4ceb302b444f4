"""The lines of both figures hold the curves of the tables that went in."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from mmgsd.figures import style as drawing
from mmgsd.measure.uncertainty import LEVELS, compute_coverage
from mmgsd.studies.models import get_colour
from mmgsd.studies.uncertainty import CURVE_POINTS, plot_calibration, plot_reliability, plot_risk_coverage


def make_table(scale: float = 1.0, rows: int = 4) -> pd.DataFrame:
    """Errors 1, 2 … in the reverse order of the entropy, and a query with a hidden source that must not count."""
    error = np.append(scale * np.arange(1.0, rows + 1), 1e6)
    distances = [scale * np.array([0.5, e]) for e in error]
    visible = np.arange(rows + 1) < rows
    return pd.DataFrame({"visible": visible, "rmse_px": error, "entropy": -error, "mahalanobis2": distances})


def make_tables(*methods: str, scale: float = 1.0) -> dict[str, dict[str, pd.DataFrame]]:
    return {o: {m: make_table(scale * (1 + i)) for i, m in enumerate(methods)} for o in ("cloth", "rope")}


def get_labels(figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_risk_coverage_draws_methods_in_order_with_the_oracle():
    figure = plot_risk_coverage(make_tables("random", "imagenet", "sift", "mmgsd", "unimodal"))
    assert [axis.get_title() for axis in figure.axes] == ["Cloth", "Rope"]
    assert get_labels(figure) == ["MMGSD", "MMGSD, oracle", "Unimodal", "SIFT", "ImageNet features"]
    line, oracle, unimodal, *others = figure.axes[0].lines
    assert len(others) == 2
    assert line.get_xdata() == pytest.approx([25, 50, 75, 100])
    assert line.get_ydata() == pytest.approx([16, 14, 12, 10])  # mmgsd has scale 4, least entropy at the largest error
    assert oracle.get_ydata() == pytest.approx([4, 6, 8, 10])
    assert unimodal.get_ydata() == pytest.approx([20, 17.5, 15, 12.5])
    assert line.get_color() == oracle.get_color() == get_colour("mmgsd")
    assert line.get_linestyle() == "-" and oracle.get_linestyle() == "--"
    assert figure.get_figwidth() == pytest.approx(drawing.COLUMN_IN)


@pytest.mark.parametrize("rows", [1, 199, 200, 201, 12345])
def test_curves_are_thinned_but_reach_the_end(rows):
    line = plot_risk_coverage({"rope": {"spcl": make_table(rows=rows)}}).axes[0].lines[0]
    assert len(line.get_xdata()) == min(rows, CURVE_POINTS)
    assert line.get_xdata()[-1] == 100 and line.get_ydata()[-1] == pytest.approx((rows + 1) / 2)


def test_calibration_draws_coverage_before_and_after():
    before, after = make_tables("spcl", "mmgsd", "centre"), make_tables("spcl", "mmgsd", scale=0.5)
    figure = plot_calibration(before, after)
    assert get_labels(figure) == ["MMGSD", "SPCL", "Before calibration"]
    for axis, name in zip(figure.axes, ("cloth", "rope"), strict=True):
        diagonal, *lines = axis.lines[:5]
        assert list(diagonal.get_xdata()) == list(diagonal.get_ydata()) == [0, 100]
        assert [line.get_linestyle() for line in lines] == ["-", "-", "--", "--"]
        asked = [(t, m) for t in (after, before) for m in ("mmgsd", "spcl")]
        for line, (tables, method) in zip(lines, asked, strict=True):
            distances = np.concatenate(list(tables[name][method].mahalanobis2[:4]))
            assert line.get_xdata() == pytest.approx(100 * np.array(LEVELS))
            assert line.get_ydata() == pytest.approx(100 * compute_coverage(distances))
            assert line.get_color() == get_colour(method)


def test_method_without_calibration_keeps_its_name():
    figure = plot_calibration(make_tables("mmgsd", "pcl"), make_tables("mmgsd"))
    assert get_labels(figure) == ["MMGSD", "PCL", "Before calibration"]
    assert len(figure.axes[1].lines) == 4


def test_reliability_draws_rings_before_and_intervals_after():
    rows = pd.DataFrame({"expected": [0.1, 0.9], "observed": [0.3, 0.8], "margin": [0.1, 0.05], "count": [10, 20]})
    figure = plot_reliability({"cloth": rows, "rope": rows.iloc[:1]}, {"cloth": rows, "rope": rows})
    assert [axis.get_title() for axis in figure.axes] == ["Cloth", "Rope"]
    assert get_labels(figure) == ["Gaussian", "Calibrated"]
    diagonal, before, after, *_ = figure.axes[0].lines
    assert list(diagonal.get_xdata()) == list(diagonal.get_ydata()) == [0, 100]
    for line in (before, after):
        np.testing.assert_allclose(line.get_xydata(), [[10, 30], [90, 80]])
    (bars,) = figure.axes[0].collections
    np.testing.assert_allclose([path.vertices[:, 1] for path in bars.get_paths()], [[20, 40], [75, 85]])
