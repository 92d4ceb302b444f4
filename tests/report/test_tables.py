"""The README's tables say what the results say."""

import json
from pathlib import Path

import pytest

from mmgsd.report import latex
from mmgsd.report.tables import update_tables
from mmgsd.studies import main
from mmgsd.studies.broken_symmetry import describe_fixes
from mmgsd.studies.errors import describe_difficulties
from mmgsd.studies.places import describe_places
from mmgsd.studies.seeds import (
    SAME_SUPERVISION,
    STUDY,
    compare_seeds,
    describe_seeds,
    list_means,
    make_first_seed_sentence,
    say_p,
)
from mmgsd.studies.sigma import describe_sigma
from mmgsd.studies.symmetry import describe_symmetry
from mmgsd.studies.table import LABELS, Column, Table, describe_errors, lay_out, to_markdown
from mmgsd.studies.uncertainty import describe_uncertainty

RESULTS = {
    object: {method: {"rmse_mean": 10.0 * i + 1, "median": 5.0, "pck@20px": 0.5} for i, method in enumerate(LABELS)}
    for object in ("cloth", "rope")
}
BEGIN, END = "<!-- quick: made by `make readme` -->", "<!-- end of quick -->"


def read_page(table: Table) -> list[str]:
    """The lines of a page's table."""
    return to_markdown(table).splitlines()


def test_every_method_has_a_row_with_its_numbers() -> None:
    rows = read_page(main.describe_main(RESULTS))
    assert len(rows) == 2 + len(LABELS) + 1
    assert rows[2].startswith("| **MMGSD** (ours) | 1.0 | 5.0 | 50 % | 1.0")
    assert "32.4" in rows[-1] and "31.3" in rows[-1]


def test_the_headline_is_rows_of_the_main_table() -> None:
    rows = read_page(main.describe_main(RESULTS))
    headline = read_page(main.describe_main(RESULTS, methods=main.HEADLINE))
    assert set(headline) < set(rows) and len(headline) == 2 + 11


def test_some_queries_errors_are_a_row_each() -> None:
    lines = read_page(describe_difficulties({"cloth": {"all": 26.09, "no match hidden": 18.9}, "rope": {"all": 24.4}}))
    assert lines[2:] == ["| all | 26.1 | 24.4 |", "| no match hidden | 18.9 | – |"]


def test_a_table_of_pages_and_report_has_one_description() -> None:
    told = {"mmgsd": RESULTS["cloth"]["mmgsd"], "shipped": {"rmse_mean": 4.0, "median": 3.0, "pck@20px": 0.25}}
    table = describe_sigma({"cloth": {"4": told["mmgsd"]}, "rope": {"4": told["shipped"]}})
    assert to_markdown(table).splitlines()[-1] == "| 4 | 1.0 | 5.0 | 50 % | 4.0 | 3.0 | 25 % |"
    assert "4 & 1.0 & 5.0 & 50.0 & 4.0 & 3.0 & 25.0" in latex.to_latex(table)


def test_objects_stand_below_each_other_where_they_are_too_wide() -> None:
    columns = [Column(f"k{k}", "head", "page" if k < 2 else "") for k in range(5)]
    row = {name: {f"k{k}": float(k) for k in range(5)} for name in ("cloth", "rope")}
    table = Table("", {"": columns}, {"row": row}, ("cloth", "rope"))
    assert lay_out(table, page=True).beside and not lay_out(table, page=False).beside
    assert [title for title, _ in lay_out(table, page=False).sections] == ["cloth", "rope"]


@pytest.mark.parametrize("method", ["mmgsd", "sift"])
def test_a_measure_that_was_not_written_is_an_error_and_none_a_dash(method: str) -> None:
    with pytest.raises(KeyError, match="median"):
        read_page(describe_errors({"cloth": {method: {"rmse_mean": 1.0}}}))
    row = {"rmse_mean": 1.0, "median": None, "pck@20px": None}
    assert read_page(describe_errors({"cloth": {method: row}}))[-1].endswith("| 1.0 | – | – | – | – | – |")


def test_places_and_presets_are_a_row_each() -> None:
    places = read_page(describe_places({"places": {"cloth": {"corner": 27.76}, "rope": {"end": 14.8}}}))
    assert places[2:] == ["| cloth: corner | 27.8 |", "| rope: end | 14.8 |"]
    assert read_page(main.describe_presets({"quick/rmse.json": RESULTS}))[2:] == ["| `quick` | 1 | 1 |"]


def test_the_equal_budget_is_not_compared_with_the_paper() -> None:
    assert read_page(describe_errors(RESULTS)) == read_page(main.describe_main(RESULTS))[:-1]


def test_a_method_that_was_not_at_hand_has_no_row() -> None:
    results = {name: {m: v for m, v in methods.items() if m != "sift"} for name, methods in RESULTS.items()}
    without, with_sift = (str(read_page(main.describe_main(table))) for table in (results, RESULTS))
    assert "SIFT" not in without and "SIFT" in with_sift


def test_what_was_run_on_one_object_only_has_dashes() -> None:
    results = {**RESULTS, "rope": {}}
    row = read_page(main.describe_main(results))[2]
    assert row == "| **MMGSD** (ours) | 1.0 | 5.0 | 50 % | – | – | – |"


def test_sigmas_are_in_order_of_their_width() -> None:
    row = RESULTS["cloth"]["spcl"]
    rows = read_page(describe_sigma({"cloth": {"16": row, "2": row}, "rope": {"2": row}}))
    assert rows[0].startswith("| σ px | cloth: RMSE px | median px | pck@20px | rope: RMSE px")
    assert [line.split(" | ")[0] for line in rows[2:]] == ["| 2", "| 16"]
    assert rows[3].endswith("| 50 % | – | – | – |")


def test_seeds_are_a_mean_and_a_std() -> None:
    cloth = {f"mmgsd-{seed}": {"rmse_mean": error} for seed, error in enumerate((50.0, 51.0, 52.0))}
    seeds = {"cloth": cloth | {"spcl-0": {"rmse_mean": 60.0}}, "rope": {"pcl-1": {"rmse_mean": 70.0}}}
    lines = read_page(describe_seeds(seeds))[2:]
    assert lines == ["| **MMGSD** (ours) | 51.0 ± 1.0 (3) | – |", "| SPCL | 60.0 (1) | – |", "| PCL | – | 70.0 (1) |"]


def test_the_error_of_seen_matches_is_of_the_seeds_that_have_it() -> None:
    seen = {f"mmgsd-{k}": {"rmse_mean": 26.0, "rmse_seen": 22.0 + k} for k in (1, 3)}
    cloth = {"mmgsd-0": {"rmse_mean": 26.0}} | seen
    lines = read_page(describe_seeds({"cloth": cloth}, seen=True))
    each = "mean ± std (seeds) | of seen matches"
    assert lines[0] == f"| RMSE px | cloth: {each} | rope: {each} |"
    assert lines[2] == "| **MMGSD** (ours) | 26.0 ± 0.0 (3) | 24.0 ± 1.4 (2) | – | – |"


def test_what_seeds_tell_apart_from_mmgsd_is_marked() -> None:
    errors = {"mmgsd": (50.0, 51.0, 52.0), "spcl": (60.0, 61.0, 62.5), "pcl": (49.0, 53.0, 58.0)}
    cloth = {f"{name}-{seed}": {"rmse_mean": e} for name, found in errors.items() for seed, e in enumerate(found)}
    rows = {line.split(" | ")[0]: line.split(" | ")[1] for line in read_page(describe_seeds({"cloth": cloth}))[2:]}
    assert rows == {"| **MMGSD** (ours)": "51.0 ± 1.0 (3)", "| SPCL": "61.2 ± 1.3 (3) *", "| PCL": "53.3 ± 4.5 (3)"}


def test_the_report_has_p_where_a_page_has_marks() -> None:
    errors = {"mmgsd": (50.0, 51.0, 52.0), "spcl": (60.0, 61.0, 62.5)}
    cloth = {f"{name}-{seed}": {"rmse_mean": e} for name, found in errors.items() for seed, e in enumerate(found)}
    p = say_p(compare_seeds({"cloth": cloth}), "cloth", "spcl")
    lines = latex.to_latex(describe_seeds({"cloth": cloth})).splitlines()
    assert rf"SPCL & 61.2 $\pm$ 1.3 (3) & {p} & -- & -- \\" in lines
    assert r"\textbf{MMGSD} (ours) & 51.0 $\pm$ 1.0 (3) & -- & -- & -- \\" in lines


def test_means_are_over_the_seeds_of_the_same_training() -> None:
    rmse = {"cloth": {"mmgsd": {"rmse_mean": 26.0}, "spcl": {"rmse_mean": 39.0}, "pcl": {"rmse_mean": 40.0}}}
    seeds = {"cloth": {"mmgsd-0": {"rmse_mean": 26.0}, "mmgsd-1": {"rmse_mean": 27.0},
                       "spcl-0": {"rmse_mean": 39.5}, "spcl-1": {"rmse_mean": 41.0}}}  # fmt: skip
    means = list_means({"rmse": rmse, "seeds": seeds})["cloth"]
    assert {method: row["rmse_mean"] for method, row in means.items()} == {"mmgsd": 26.5, "spcl": 39.0, "pcl": 40.0}


def test_at_the_main_size_seeds_are_compared_under_one_supervision() -> None:
    errors = {"mmgsd": (26.0, 26.2), "mmgsd_plain": (36.1, 36.7, 36.3), "spcl": (39.3, 39.7, 39.5), "pcl": (40.1,)}
    cloth = {f"{name}-{seed}": {"rmse_mean": e} for name, found in errors.items() for seed, e in enumerate(found)}
    shown = STUDY.tables["seeds"].make({"cloth": cloth})
    rows = {line.split(" | ")[0]: line.split(" | ")[1] for line in read_page(shown)[2:]}
    assert compare_seeds({"cloth": cloth}, SAME_SUPERVISION).keys() == {("cloth", "spcl")}
    assert rows["| SPCL"] == "39.5 ± 0.2 (3) *" and rows["| MMGSD, own loss alone"] == "36.4 ± 0.3 (3)"


def test_many_comparisons_are_corrected_for_by_hand() -> None:
    errors = {"mmgsd": (42.6, 38.1, 36.3), "spcl": (53.1, 52.7, 52.4), "pcl": (54.3, 54.3, 54.5), "unimodal": (40.0,)}
    seeds = {"cloth": {f"{m}-{k}": {"rmse_mean": e} for m, found in errors.items() for k, e in enumerate(found)}}
    (spcl, spcl_corrected), (pcl, pcl_corrected) = (compare_seeds(seeds)["cloth", m] for m in ("spcl", "pcl"))
    assert pcl < spcl < 0.05 and len(compare_seeds(seeds)) == 2
    assert pcl_corrected == pytest.approx(2 * pcl) and spcl_corrected == pytest.approx(max(spcl, 2 * pcl))
    rope = {"mmgsd": (7.5, 8.0), "a": (7.0, 9.0), "b": (7.0, 9.0), "c": (7.0, 9.0)}
    seeds["rope"] = {f"{m}-{k}": {"rmse_mean": e} for m, found in rope.items() for k, e in enumerate(found)}
    rows = {line.split(" | ")[0]: line.split(" | ")[1] for line in read_page(describe_seeds(seeds))[2:]}
    assert rows["| SPCL"] == "52.7 ± 0.4 (3) †"  # five comparisons: told apart alone, and no longer


def test_the_seed_that_studies_rest_on_is_told_beside_the_others() -> None:
    seeds = {name: {"mmgsd-0": {"rmse_mean": 42.6}, "mmgsd-1": {"rmse_mean": 38.1}} for name in ("cloth", "rope")}
    assert "42.6 px on cloth (others 38.1)" in make_first_seed_sentence(seeds)


def test_a_group_has_its_errors_by_place() -> None:
    regions = {region: {"rmse_px": 10.0 * i} for i, region in enumerate(("corner", "edge", "interior"), start=1)}
    table = read_page(describe_symmetry({"c4": {"rmse_mean": 15.04, "regions": regions}}))
    assert table[2:] == ["| `c4`, the rotations | 15.0 | 10.0 | 20.0 | 30.0 |"]


def test_the_two_fixes_are_rows_of_their_own() -> None:
    row = RESULTS["rope"]["spcl"] | {"rmse_mean": 42.04, "nearest_of_all": 3.96, "right": 0.25}
    lines = read_page(describe_fixes({"rope, plain": row, "rope, ball at one end": row}))
    assert lines[2:] == [f"| rope, {fix} | 42.0 | 5.0 | 50 % | 4.0 | 25 % |" for fix in ("plain", "ball at one end")]


def test_uncertainty_before_and_after() -> None:
    after = {"spearman": 0.4, "aurc": 30.0, "aurc_random": 50.0, "coverage@90%": 0.88, "ece": 0.03}
    before = after | {"coverage@90%": 0.5, "ece": 0.2, "auroc_occluded": 0.9}
    after = {"mmgsd": after | {"auroc_occluded": 0.7}, "sift": after | {"auroc_occluded": None}}
    results = {"calibrated": {"rope": after}, "temperature 1": {"rope": {"mmgsd": before}}}
    table = read_page(describe_uncertainty(results))
    assert table[2:] == [
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
    assert document.read_text() == "\n".join(["before", BEGIN, *read_page(main.describe_main(RESULTS)), END, "after\n"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("text", "at least one table"),
        (f"{BEGIN}\nnot closed", "each between"),
        (f"{BEGIN}\n\n{END}".replace("quick", "quack"), "'quack', accepted are "),
    ],
)
def test_a_document_with_wrong_markers_is_left_alone(document: Path, text: str, message: str) -> None:
    document.write_text(text)
    with pytest.raises(ValueError, match=message):
        update_tables(document, document.parent)
    assert document.read_text() == text


def test_a_p_below_three_decimals_is_not_zero() -> None:
    tested = {("cloth", "spcl"): (0.00001, 0.0001), ("rope", "spcl"): (0.002, 0.0071)}
    assert [say_p(tested, name, "spcl") for name in ("cloth", "rope", "towel")] == ["<0.001", "0.007", None]
