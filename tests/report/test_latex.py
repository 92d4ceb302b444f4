"""The report says what the results say, and builds with whatever of them is there."""

import copy
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mmgsd.config import METHODS, OBJECTS, PRESETS
from mmgsd.measure.metrics import PCK_PX, summarise_errors
from mmgsd.measure.regions import find_regions
from mmgsd.paths import find_root
from mmgsd.report.latex import (
    CLAIMS,
    NOT_RUN,
    escape,
    flatten,
    list_tables,
    make_definitions,
    set_text,
    to_latex,
    write_report,
)
from mmgsd.report.tables import describe_claims, list_claims
from mmgsd.studies.claims import HELD, IN_PART, NOT_HELD, NOT_MEASURED, get, is_better, judge
from mmgsd.studies.figure_data import FigureData
from mmgsd.studies.places import measure_places
from mmgsd.studies.registry import list_studies, load_results
from mmgsd.studies.table import LABELS

ROOT = find_root(Path(__file__).parent)
TABLES = {name: (Path(shown.file).stem, shown.make) for name, shown in list_tables().items()}
FILES = [name for study in list_studies() for name in study.results if name != "folding"]  # in short in `make_results`
GROUPS, REGIONS = ("v4", "c4", "d4"), ("corner", "edge", "interior")


def make_errors(rmse: float) -> dict[str, float]:
    """A row of results as `mmgsd.measure.evaluation.summarise` writes it."""
    row = {"rmse_mean": rmse, "rmse_pooled": rmse + 1, "median": rmse - 1, "swap_rate": 0.25, "queries": 1234}
    row |= {f"pck@{t}px": t / 100 for t in PCK_PX}
    return row | {f"{name}_all": value for name, value in row.items()}


def make_results() -> dict:
    """Results of every stage, in which every claim holds but those that have a part that nothing measures."""
    rmse = {"mmgsd": 28.0, "mmgsd_plain": 30.0, "spcl": 60.0, "sift": 90.0, "surf": 90.0, "orb": 90.0}
    uncertainty = {"spearman": 0.5, "aurc": 20.0, "aurc_random": 30.0, "aurc_share": 0.4, "ece": 0.02}
    uncertainty |= {"coverage@50%": 0.51, "coverage@90%": 0.91, "coverage@95%": 0.96}
    uncertainty |= {"auroc_occluded": 0.6, "auroc_absent": None}
    inside = {"v4": (30.0, 50.0, 60.0), "c4": (30.0, 31.0, 32.0), "d4": (30.0, 30.0, 30.0)}
    rings = {"v4": [30.0, 40.0, 50.0, 60.0, 20.0], "c4": [40.0, 39.0, 38.0, 37.0, 20.0], "d4": [30.0] * 5}
    regions = {
        group: {r: {"rmse_px": e, "entropy": e / 10, "queries": 9} for r, e in zip(REGIONS, errors, strict=True)}
        for group, errors in inside.items()
    }
    broken = {"cloth, any rotation": 90.0, "cloth, ±45° only": 60.0, "rope, plain": 90.0, "rope, ball at one end": 30.0}
    small = {"mmgsd": make_errors(40.0), "mmgsd_plain": make_errors(60.0), "spcl": make_errors(80.0)}
    run = {"steps": 100, "minutes": 1.5, "images": 95, "seed": 0, "hardware": "CPU, 2 cores"}
    limits = {"15": 80.0, "45": 70.0, "90": 50.0, "180": 41.0}  # Unimodal's error
    poses = {limit: {f"{method}-0": {"within": make_errors(e), "any": make_errors(e)}
                     for method, e in (("mmgsd", 40.0), ("unimodal", error))} for limit, error in limits.items()}
    return {
        "rmse": {name: {method: make_errors(e) for method, e in rmse.items()} for name in OBJECTS},
        "runs": {f"{name}-{method}": run for name in OBJECTS for method in METHODS},
        "budget": {"cloth": {method: {**row, "run": run} for method, row in small.items()}, "rope": {}},
        "sigma": {name: {"1": make_errors(40.0), "4": make_errors(50.0), "16": make_errors(60.0)} for name in OBJECTS},
        "cells": {name: {f"{2 ** k}": make_errors(40.0 + 10 * k) for k in range(4)} for name in OBJECTS},
        "symmetry": {g: {**make_errors(40.0), "regions": regions[g], "rings": rings[g]} for g in GROUPS},
        "broken_symmetry": {name: {**make_errors(e), "right": 1 - e / 100} for name, e in broken.items()},
        "errors": {name: {"all": 30.0, "no match hidden": 25.0, "easiest pair of states": 10.0} for name in OBJECTS},
        "uncertainty": {
            "calibrated": {name: {"mmgsd": {**uncertainty}} for name in OBJECTS},
            "temperature 1": {name: {"mmgsd": {**uncertainty, "coverage@90%": 0.5}} for name in OBJECTS},
        },
        "places": {"cloth": {"corner": 20.0, "edge": 25.0, "interior": 35.0}, "rope": {"end": 20.0, "middle": 40.0}},
        "peaks": dict.fromkeys(OBJECTS, 2),
        "seeds_1000": {name: {f"{m}-{k}": make_errors(e + k * s) for k in range(3)
                              for m, e, s in (("mmgsd", 40.0, 1.0), ("spcl_dense", 60.0, 4.0), ("spcl", 60.0, 0.1))}
                       for name in OBJECTS},
        "seeds": {name: {f"{m}-{k}": make_errors(rmse[m] + k / 10) for k in range(3) for m in ("mmgsd_plain", "spcl")}
                  for name in OBJECTS},
        "pose_range": {name: copy.deepcopy(poses) for name in OBJECTS},
        "continuity": {name: {"mmgsd": {"jumps": 0.1}, "spcl": {"jumps": 0.2}} for name in OBJECTS},
        "entropy": {name: {"seen": 9.0, "hidden": 10.0, "straight": 8.0, "overhand knot": 9.0} for name in OBJECTS},
        "grasp": {"mmgsd": {"surest": {"distance": {"mean": 0.02}, "beyond": {"high": -0.01}}}},
        "folding": {name: {"mmgsd_best": {"success": {"mean": 0.8}, "beyond": {"error": {"low": -0.01}}}}
                    for name in OBJECTS},
    }  # fmt: skip


def judge_all(results: dict) -> dict[str, str]:
    return {claim.key: claim.verdict for claim in list_claims(results)}


def write_results(results: dict, root: Path, preset: str = "quick") -> None:
    folder = root / "data" / "results" / preset
    folder.mkdir(parents=True)
    for name in set(results) & set(FILES):
        (folder / f"{name}.json").write_text(json.dumps(results[name]))


@pytest.mark.parametrize(
    ("parts", "verdict"),
    [
        ((True, True), HELD), ((True, False), IN_PART), ((False, False), NOT_HELD), ((None, None), NOT_MEASURED),
        ((True, None), IN_PART), ((False, None), NOT_HELD), ((), NOT_MEASURED),
    ],
)  # fmt: skip
def test_verdict_follows_from_the_parts(parts: tuple, verdict: str) -> None:
    assert judge(parts) == verdict


def test_errors_within_the_margin_are_not_told_apart() -> None:
    assert is_better(94.0, 100.0) and not is_better(96.0, 100.0) and not is_better(100.0, 94.0)
    assert is_better(None, 1.0) is None and is_better(1.0, None) is None


def test_every_claim_can_hold() -> None:
    verdicts = judge_all(make_results())
    partly = {"rotation-limit", "continuous"}  # a part of them is measured by nothing
    assert verdicts == {key: IN_PART if key in partly else HELD for key in verdicts}
    assert len(verdicts) == sum(len(study.claims) for study in list_studies())


@pytest.mark.parametrize(
    ("key", "path", "value", "verdict"),
    [
        ("rmse", ("rmse", "cloth", "mmgsd_plain", "rmse_mean"), 36.1, IN_PART),  # whatever dense supervision gives
        ("rmse-dense", ("rmse", "cloth", "mmgsd", "rmse_mean"), 32.5, IN_PART),
        ("better", ("rmse", "rope", "mmgsd_plain", "rmse_mean"), 58.0, IN_PART),  # within the margin
        ("better", ("seeds", "rope", "mmgsd_plain-2", "rmse_mean"), 90.0, IN_PART),  # one seed far off tells nothing
        ("improvement", ("seeds", "cloth", "spcl-1", "rmse_mean"), 40.0, NOT_HELD),  # 44 % there, of three seeds
        ("improvement", ("rmse", "rope", "mmgsd_plain", "rmse_mean"), 40.0, NOT_HELD),  # 33 % there, 42 % on average
        ("stable", ("seeds_1000", "rope", "mmgsd-2", "rmse_mean"), 90.0, IN_PART),
        ("stable", ("seeds_1000", "rope", "spcl_dense-2", "rmse_mean"), 65.0, IN_PART),  # less than 5 % of its mean
        ("continuous", ("continuity", "cloth", "spcl", "jumps"), 0.1, IN_PART),
        ("bimodal", ("peaks", "cloth"), 1, IN_PART),
        ("hidden", ("entropy", "rope", "overhand knot"), 8.0, IN_PART),
        ("hidden", ("entropy", "rope", "loops"), 10.5, IN_PART),  # above straight ropes, below others
        ("surest", ("grasp", "mmgsd", "surest", "beyond", "high"), 0.001, NOT_HELD),
        ("sigma", ("sigma", "cloth", "4", "rmse_mean"), 41.0, IN_PART),  # within the margin
        ("fine", ("cells", "rope", "2", "rmse_mean"), 41.0, IN_PART),
        ("interior", ("places", "rope", "middle"), 20.0, IN_PART),
        ("interior", ("places", "cloth", "edge"), 36.0, IN_PART),
        ("hand-made", ("rmse", "rope", "orb", "pck@20px"), 0.6, IN_PART),
        ("rotation-limit", ("broken_symmetry", "cloth, ±45° only", "right"), 0.96, NOT_HELD),
        ("ball", ("broken_symmetry", "rope, ball at one end", "right"), 0.5, NOT_HELD),
        ("one-match", ("pose_range", "rope", "45", "unimodal-0", "within", "rmse_mean"), 41.5, IN_PART),
        ("entropy", ("uncertainty", "calibrated", "rope", "mmgsd", "spearman"), 0.29, IN_PART),
        ("inward", ("symmetry", "c4", "regions", "interior", "entropy"), 3.0, NOT_HELD),
        ("inward", ("symmetry", "c4", "regions", "edge", "entropy"), 3.19, IN_PART),  # least outside alone
        ("group", ("symmetry", "v4", "rings"), [78.0, 65.0, 54.0, 29.0, 20.0], NOT_HELD),  # worse, and falling inwards
        ("group", ("symmetry", "c4", "rings"), [30.0, 31.0, 32.0, 33.0, 20.0], NOT_HELD),  # as of cloth
        ("several", ("folding", "rope", "mmgsd_best", "beyond", "error", "low"), 0.01, IN_PART),
    ],
)
def test_one_number_changes_the_verdict(key: str, path: tuple[str, ...], value: float, verdict: str) -> None:
    results = make_results()
    get(results, *path[:-1])[path[-1]] = value
    changed = judge_all(results)
    assert changed[key] == verdict


def test_no_claim_holds_where_all_is_otherwise() -> None:
    results = make_results()
    for name in OBJECTS:
        for metrics in results["rmse"][name].values():
            metrics |= {"rmse_mean": 60.0, "pck@20px": 0.9}
        for width, metrics in results["sigma"][name].items():
            metrics["rmse_mean"] = 60.0 / float(width)
        results["cells"][name] = {width: make_errors(60.0 / float(width)) for width in results["cells"][name]}
        results["uncertainty"]["calibrated"][name]["mmgsd"]["spearman"] = -0.1
    results["places"] = {"cloth": dict.fromkeys(REGIONS, 30.0), "rope": {"end": 30.0, "middle": 30.0}}
    for metrics in results["broken_symmetry"].values():
        metrics |= {"rmse_mean": 50.0, "pck@20px": 0.9, "right": 0.5}
    results["broken_symmetry"]["cloth, ±45° only"]["right"] = 1.0
    for row in results["symmetry"].values():
        row |= {"regions": {r: {"rmse_px": 30.0, "entropy": 9.0} for r in REGIONS}, "rings": [3.0, 2.0, 1.0]}
    results["peaks"] = dict.fromkeys(OBJECTS, 1)
    for name in OBJECTS:
        results["seeds_1000"][name]["spcl_dense-2"] = results["seeds_1000"][name]["spcl_dense-1"]
        results["seeds_1000"][name]["mmgsd-2"]["rmse_mean"] = 90.0
        results["continuity"][name]["mmgsd"]["jumps"] = 0.3
        results["pose_range"][name]["15"]["unimodal-0"]["within"]["rmse_mean"] = 40.0
        results["entropy"][name] = dict.fromkeys(results["entropy"][name], 9.0)
    results["grasp"]["mmgsd"]["surest"]["beyond"]["high"] = 0.1
    for rows in results["folding"].values():
        rows["mmgsd_best"]["beyond"]["error"]["low"] = 0.1
    assert set(judge_all(results).values()) == {NOT_HELD}


def test_what_was_not_run_is_not_measured() -> None:
    assert set(judge_all({}).values()) == {NOT_MEASURED}
    started = {"rmse": {"cloth": {"mmgsd": make_errors(30.0)}, "rope": {}}, "runs": {}}  # one model is done
    verdicts = judge_all(started)
    assert verdicts.pop("rmse-dense") == IN_PART and set(verdicts.values()) == {NOT_MEASURED}
    assert "30.0" in make_table("main_table", started["rmse"]) and make_table("runs_table", started["runs"])


def test_without_places_the_interior_is_the_studys() -> None:
    results = make_results()
    del results["places"]
    interior = next(claim for claim in list_claims(results) if claim.key == "interior")
    assert interior.parts == (False, None)  # 32.0 inside is within the margin of 31.0 at the edge
    assert "interior 32.0" in interior.measured


def test_flatten_names_every_number_once() -> None:
    flat = flatten({"rmse": {"cloth": {"pck@20px": 0.5, "absent": None}}, "sizes": (1, 2.5), "on": True})
    assert flat == {"rmse/cloth/pck@20px": "0.5", "sizes/0": "1", "sizes/1": "2.5", "on": "true"}
    assert flatten({"cloth, ±45° only": {"coverage@90%": 1}}) == {"cloth-45-only/coverage@90": "1"}
    with pytest.raises(ValueError, match="one name 'a-b'"):
        flatten({"a b": 1, "a-b": 2})


def test_escape_leaves_no_special_character() -> None:
    assert escape("100 % of a_b & c#1 {$} ~^\\") == (
        r"100 \% of a\_b \& c\#1 \{\$\} \textasciitilde{}\textasciicircum{}\textbackslash{}"
    )
    assert escape("±45°") == r"$\pm$45$^\circ$"
    assert r"\defresult{a}{50 \% \_}" in make_definitions("quick", {"a": "50 % _"})


def make_table(name: str, results: dict) -> str:
    return to_latex(TABLES[name][1](results))


def read_rows(table: str) -> dict[str, list[str]]:
    """{first cell: the others} of a table's rows; of equal ones, the last."""
    lines = [line.removesuffix(r" \\").split(" & ") for line in table.splitlines() if line.endswith(r" \\")]
    return {cells[0]: cells[1:] for cells in lines}


def test_main_table_has_every_method_with_its_numbers() -> None:
    rmse = json.loads((ROOT / "data/results/quick/rmse.json").read_text())
    rows = read_rows(make_table("main_table", rmse))
    for method, metrics in rmse["rope"].items():
        cells = rows[set_text(LABELS[method])]
        assert [float(c) for c in cells[:3]] == pytest.approx(
            [metrics[m] for m in ("rmse_mean", "rmse_pooled", "median")], abs=0.051
        )
        assert [float(c) for c in cells[3:6]] == pytest.approx([100 * metrics[f"pck@{t}px"] for t in PCK_PX], abs=0.051)
        assert float(cells[7]) == pytest.approx(metrics["rmse_mean_all"], abs=0.051) and len(cells) == 14
    assert rows[r"\emph{the paper's MMGSD, 3,500 images each}"] == [r"\emph{31.3}"] + ["--"] * 13


def test_budget_table_has_the_objects_that_were_trained() -> None:
    results = make_results()
    text = make_table("budget_table", results["budget"])
    assert read_rows(text)["SPCL"][0] == "80.0" and "Cloth" in text and "Rope" not in text and "31.3" not in text
    better = next(claim for claim in list_claims(results) if claim.key == "better")
    assert "the same at the studies' budget: cloth 25 %, rope –, one seed; " in better.measured  # own loss alone


def test_a_longer_training_is_a_row_that_latex_can_set() -> None:
    row = make_results()["rmse"]["cloth"]["mmgsd"]
    assert r"MMGSD, 3 $\times$ the steps" in read_rows(make_table("main_table", {"cloth": {"mmgsd_long": row}}))


def test_swap_rate_has_its_column_where_it_was_measured() -> None:
    results = make_results()["rmse"]
    assert read_rows(make_table("main_table", results))[r"\textbf{MMGSD} (ours)"][6] == "25.0"
    del results["rope"]["mmgsd"]["swap_rate"]
    assert read_rows(make_table("main_table", results))[r"\textbf{MMGSD} (ours)"][6] == "--"


def test_other_tables_have_their_numbers() -> None:
    results = make_results()
    rows = {name: read_rows(to_latex(make(results[file]))) for name, (file, make) in TABLES.items()}
    assert rows["sigma_table"]["4"] == ["50.0", "49.0", "20.0"] * 2
    assert list(rows["sigma_table"])[-3:] == ["1", "4", "16"]
    assert rows["symmetry_table"][r"\texttt{v4}, the flips"] == ["40.0", "30.0", "50.0", "60.0", "3.00", "5.00", "6.00"]
    assert rows["uncertainty_table"][r"\textbf{MMGSD} (ours)"][5] == r"50\,$\to$\,91"
    assert rows["uncertainty_table"][r"\textbf{MMGSD} (ours)"][-2:] == ["0.60", "--"]
    assert rows["fixes_table"][r"cloth, $\pm$45$^\circ$ only"] == ["60.0", "59.0", "20.0", "--", "40", "--"]
    assert rows["pose_range_table"][r"any, Unimodal"] == ["41.0 (1)", "20", "--", "--"] * 2
    assert rows["errors_table"]["no match hidden"] == ["25.0", "25.0"]
    assert rows["runs_table"]["SPCL"] == ["100", "1.5"] * 2


@pytest.mark.parametrize(("text", "latex"), [
    ("-0.05 → -1", r"$-$0.05\,$\to$\,$-$1"),
    ("8-15, a-b", "8-15, a-b"),
    ("**ours**, *theirs*, `v_4`", r"\textbf{ours}, \emph{theirs}, \texttt{v\_4}"),
    ("50 % within 20 px; σ px", r"50\,\% within 20~px; $\sigma$ px"),
])  # fmt: skip
def test_markup_units_and_signs_are_set(text: str, latex: str) -> None:
    assert set_text(text) == latex


def test_claims_table_prints_each_verdict() -> None:
    table = to_latex(describe_claims(make_results()), CLAIMS)
    assert [c for c in re.findall(r"\\textbf\{([^}]*)\}", table)] == list(judge_all(make_results()).values())
    assert "no results for this preset" in to_latex(describe_claims({}), CLAIMS)


def test_a_preset_without_results_has_every_file(tmp_path: Path) -> None:
    texts = {path.stem: path.read_text() for path in write_report("paper", tmp_path)}
    assert set(texts) == {"results", "claims_table", *TABLES}
    assert all(texts[name].strip() == NOT_RUN for name in TABLES)
    assert r"\newcommand{\preset}{paper}" in texts["results"]
    assert r"\defresult{config/render/cloth/train_images}{3500}" in texts["results"]


def test_each_missing_file_is_told_in_its_table_alone(tmp_path: Path) -> None:
    results = make_results()
    for number, missing in enumerate(FILES):
        root = tmp_path / str(number)
        write_results({name: content for name, content in results.items() if name != missing}, root)
        texts = {path.stem: path.read_text() for path in write_report("quick", root)}
        untold = {name for name, text in texts.items() if text.strip() == NOT_RUN}
        assert untold == {name for name, (file, _) in TABLES.items() if file == missing}


def test_a_preset_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="preset must"):
        write_report("papers", tmp_path)
    assert not list(tmp_path.iterdir())


def test_places_are_means_over_visible_queries() -> None:
    points = np.arange(625)
    queries = pd.DataFrame({"point": points, "visible": points != 312, "rmse_px": np.abs(points - 312.0)})
    data = FigureData({"mmgsd": summarise_errors(queries)}, 1.0, {}, [np.zeros((4, 2))])
    rope = measure_places(data, "rope")
    assert rope["end"] > 250 and rope["middle"] == pytest.approx(31.5, abs=1)  # 1 to 62, without the hidden one
    cloth = measure_places(data, "cloth")
    corner = find_regions()["corner"]
    assert cloth["corner"] == pytest.approx(queries.rmse_px[corner].mean()) and set(cloth) == set(REGIONS)


def find_keys(text: str) -> set[str]:
    """Keys that the report asks for, verdicts included; those of macro definitions hold a #, comments none."""
    text = re.sub(r"(?m)(?<!\\)%.*", "", text)
    keys = set(re.findall(r"\\(?:result|percent|textresult|rawresult|ifresult)(?:\[\d\])?\{([^}#]+)\}", text))
    return keys | {f"verdict/{key}" for key in re.findall(r"\\resultverdict\{([^}#]+)\}", text)}


def test_every_key_of_the_report_is_a_result() -> None:
    text = (ROOT / "paper/report.tex").read_text()
    keys = find_keys(text)
    assert len(keys) > 40
    known = set()
    for preset in ("quick", "paper"):  # each has studies that the other has not
        results = load_results(ROOT / "data/results" / preset)
        assert {"rmse", "runs", "sigma"} <= set(results)
        definitions = make_definitions(preset, results | {"verdict": judge_all(results)})
        known |= set(re.findall(r"\\defresult\{([^}]*)\}", definitions))
    assert {key for key in keys if not key.startswith("config/")} <= known


def test_every_setting_of_the_report_is_in_the_configuration(tmp_path: Path) -> None:
    keys = {key for key in find_keys((ROOT / "paper/report.tex").read_text()) if key.startswith("config/")}
    for preset in PRESETS:
        definitions = write_report(preset, tmp_path)[0].read_text()
        assert keys and keys <= set(re.findall(r"\\defresult\{([^}]*)\}", definitions))


def test_the_report_inputs_every_table_and_types_no_verdict() -> None:
    text = (ROOT / "paper/report.tex").read_text()
    assert set(re.findall(r"\\input\{generated/(\w+)\}", text)) == {"results", "claims_table", *TABLES}
    assert set(re.findall(r"\\resultverdict\{([^}#]+)\}", text)) <= set(judge_all({}))


def test_the_only_numbers_typed_are_the_papers_own() -> None:
    body = (ROOT / "paper/report.tex").read_text().split(r"\begin{document}")[1]
    body = re.sub(r"figure\[[^]]*\]", "", body)  # widths
    assert set(re.findall(r"\d+\.\d+", body)) == {"32.4", "31.3", "47.7", "0.5"}  # 0.5: chance of an AUROC


def test_every_citation_is_in_the_bibliography() -> None:
    cited = {
        k for keys in re.findall(r"\\cite\{([^}]*)\}", (ROOT / "paper/report.tex").read_text()) for k in keys.split(",")
    }
    assert cited == set(re.findall(r"@\w+\{([^,]+),", (ROOT / "paper/references.bib").read_text()))
