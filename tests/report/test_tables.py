"""The README's tables say what the results say."""

import json
from pathlib import Path

import pytest

from mmgsd.report.tables import (
    LABELS,
    make_budget_table,
    make_errors_table,
    make_fixes_table,
    make_headline,
    make_longer_table,
    make_places_table,
    make_presets_table,
    make_results_table,
    make_seed_table,
    make_sigma_table,
    make_symmetry_table,
    make_uncertainty_table,
    update_tables,
)

RESULTS = {
    object: {method: {"rmse_mean": 10.0 * i + 1, "median": 5.0, "pck@20px": 0.5} for i, method in enumerate(LABELS)}
    for object in ("cloth", "rope")
}
BEGIN, END = "<!-- quick: made by `make readme` -->", "<!-- end of quick -->"


def test_every_method_has_a_row_with_its_numbers() -> None:
    rows = make_results_table(RESULTS).splitlines()
    assert len(rows) == 2 + len(LABELS) + 1
    assert rows[2].startswith("| **MMGSD** (ours) | 1.0 | 5.0 | 50 % | 1.0")
    assert "32.4" in rows[-1] and "31.3" in rows[-1]


def test_the_headline_and_the_longer_trained_are_rows_of_the_main_table() -> None:
    rows = make_results_table(RESULTS).splitlines()
    assert set(make_headline(RESULTS).splitlines()) < set(rows) and len(make_headline(RESULTS).splitlines()) == 2 + 10
    assert set(make_longer_table(RESULTS).splitlines()) < set(rows[:-1])


def test_some_queries_errors_are_a_row_each() -> None:
    lines = make_errors_table({"cloth": {"all": 26.09, "no match hidden": 18.9}, "rope": {"all": 24.4}}).splitlines()
    assert lines[2:] == ["| all | 26.1 | 24.4 |", "| no match hidden | 18.9 | – |"]


def test_places_and_presets_are_a_row_each() -> None:
    places = make_places_table({"places": {"cloth": {"corner": 27.76}, "rope": {"end": 14.8}}}).splitlines()
    assert places[2:] == ["| cloth: corner | 27.8 |", "| rope: end | 14.8 |"]
    assert make_presets_table({"quick/rmse.json": RESULTS}).splitlines()[2:] == ["| `quick` | 1 | 1 |"]


def test_the_equal_budget_is_not_compared_with_the_paper() -> None:
    assert make_budget_table(RESULTS).splitlines() == make_results_table(RESULTS).splitlines()[:-1]


def test_a_method_that_was_not_at_hand_has_no_row() -> None:
    results = {name: {m: v for m, v in methods.items() if m != "sift"} for name, methods in RESULTS.items()}
    assert "SIFT" not in make_results_table(results) and "SIFT" in make_results_table(RESULTS)


def test_what_was_run_on_one_object_only_has_dashes() -> None:
    results = {**RESULTS, "rope": {}}
    row = make_results_table(results).splitlines()[2]
    assert row == "| **MMGSD** (ours) | 1.0 | 5.0 | 50 % | – | – | – |"


def test_sigmas_are_in_order_of_their_width() -> None:
    row = RESULTS["cloth"]["spcl"]
    rows = make_sigma_table({"cloth": {"16": row, "2": row}, "rope": {"2": row}}).splitlines()
    assert rows[0].startswith("| σ px | cloth: RMSE px | median px | pck@20px | rope: RMSE px")
    assert [line.split(" | ")[0] for line in rows[2:]] == ["| 2", "| 16"]
    assert rows[3].endswith("| 50 % | – | – | – |")


def test_seeds_are_a_mean_and_a_std() -> None:
    cloth = {f"mmgsd-{seed}": {"rmse_mean": error} for seed, error in enumerate((50.0, 51.0, 52.0))}
    rows = make_seed_table({"cloth": cloth | {"spcl-0": {"rmse_mean": 60.0}}, "rope": {"pcl-1": {"rmse_mean": 70.0}}})
    assert rows.splitlines()[2:] == ["| **MMGSD** (ours) | 51.0 ± 1.0 (3) | – |", "| SPCL | 60.0 (1) | – |",
                                     "| PCL | – | 70.0 (1) |"]  # fmt: skip


def test_a_group_has_its_errors_by_place() -> None:
    regions = {region: {"rmse_px": 10.0 * i} for i, region in enumerate(("corner", "edge", "interior"), start=1)}
    table = make_symmetry_table({"c4": {"rmse_mean": 15.04, "regions": regions}})
    assert table.splitlines()[2:] == ["| `c4`, the rotations | 15.0 | 10.0 | 20.0 | 30.0 |"]


def test_the_two_fixes_are_rows_of_their_own() -> None:
    row = RESULTS["rope"]["spcl"] | {"rmse_mean": 42.04, "nearest_of_all": 3.96, "right": 0.25}
    lines = make_fixes_table({"rope, plain": row, "rope, ball at one end": row}).splitlines()
    assert lines[2:] == [f"| rope, {fix} | 42.0 | 5.0 | 50 % | 4.0 | 25 % |" for fix in ("plain", "ball at one end")]


def test_uncertainty_before_and_after() -> None:
    after = {"spearman": 0.4, "aurc": 30.0, "aurc_random": 50.0, "coverage@90%": 0.88, "ece": 0.03}
    before = after | {"coverage@90%": 0.5, "ece": 0.2, "auroc_occluded": 0.9}
    after = {"mmgsd": after | {"auroc_occluded": 0.7}, "sift": after | {"auroc_occluded": None}}
    table = make_uncertainty_table({"calibrated": {"rope": after}, "temperature 1": {"rope": {"mmgsd": before}}})
    assert table.splitlines()[2:] == [
        "| rope | **MMGSD** (ours) | 0.40 | 30.0 of 50.0 | 50 → 88 % | 0.20 → 0.03 | 0.70 |",
        "| rope | SIFT | 0.40 | 30.0 of 50.0 | 88 % | 0.03 | – |",
    ]


@pytest.fixture
def document(tmp_path: Path) -> Path:
    (tmp_path / "quick").mkdir()
    (tmp_path / "quick/rmse.json").write_text(json.dumps(RESULTS))
    path = tmp_path / "README.md"
    path.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    return path


def test_update_replaces_only_what_stands_between_the_markers(document: Path) -> None:
    update_tables(document, document.parent)
    assert document.read_text() == f"before\n{BEGIN}\n{make_results_table(RESULTS)}\n{END}\nafter\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("text", "at least one table"),
        (f"{BEGIN}\nnot closed", "each between"),
        (f"{BEGIN}\n\n{END}".replace("quick", "quack"), "'quack', accepted are presets, findings,"),
    ],
)
def test_a_document_with_wrong_markers_is_left_alone(document: Path, text: str, message: str) -> None:
    document.write_text(text)
    with pytest.raises(ValueError, match=message):
        update_tables(document, document.parent)
    assert document.read_text() == text
