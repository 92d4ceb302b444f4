"""Before and after in one figure: a bar where something was measured, none where not, and axes from 0."""

from __future__ import annotations

from mmgsd.studies.robustness import plot_robustness

ROWS = {
    "cloth": {"paper": {"rmse_mean": 20.0}, "workspace": {"rmse_mean": 30.0}, "photographs": {"found@5%": 0.6}},
    "cloth-paper": {"paper": {"rmse_mean": 26.0}, "workspace": {"rmse_mean": 90.0}},
    "rope-orb": {"paper": {"rmse_mean": 70.0}},
}


def test_bars_are_what_was_measured() -> None:
    figure = plot_robustness(ROWS)
    widths = [[round(bar.get_width(), 6) for bar in axis.patches] for axis in figure.axes]
    assert widths == [[20, 26, 70], [30, 90], [60]]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        "Cloth: MMGSD, shipped", "Cloth: MMGSD, clean images only", "Rope: ORB",
    ]  # fmt: skip


def test_bars_are_of_one_reading() -> None:
    own = {"power": 1.0, "sharpness": 6.0}
    alike = {"cloth-paper@1,6": own | {"photographs": {"found@5%": 0.64}}}
    figure = plot_robustness(ROWS | {"cloth": ROWS["cloth"] | own} | alike)
    widths = [[round(bar.get_width(), 6) for bar in axis.patches] for axis in figure.axes]
    assert widths == [[20, 70], [30], [60, 64]]  # on renders cloth-paper was read otherwise


def test_errors_share_an_axis_from_zero() -> None:
    limits = [axis.get_xlim() for axis in plot_robustness(ROWS).axes]
    assert limits[0] == limits[1] and limits[0][0] == 0 and limits[0][1] > 90 and limits[2][0] == 0


def test_what_is_found_by_name_is_drawn_and_said_beside_the_bar() -> None:
    found = {"found@5%": 0.6, "by_name": {"found@5%": 0.8}}
    axis = plot_robustness(ROWS | {"cloth": ROWS["cloth"] | {"photographs": found}}).axes[2]
    assert [round(bar.get_width()) for bar in axis.patches[:2]] == [60, 80] and not axis.patches[1].get_fill()
    assert axis.texts[0].get_text() == "60, by name 80" and axis.get_xticks().max() == 100
