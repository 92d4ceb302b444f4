"""Sentences and the table of claims take every number from the results."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest

from mmgsd.config import OBJECTS
from mmgsd.report.tables import describe_claims, describe_findings, list_claims, sum_minutes
from mmgsd.studies.claims import Claim
from mmgsd.studies.registry import list_studies, load_results
from mmgsd.studies.table import to_markdown

RESULTS = load_results(Path(__file__).resolve().parents[2] / "data" / "results" / "paper")


def test_a_finding_changes_with_its_results() -> None:
    results = copy.deepcopy(RESULTS)
    results["rmse"]["cloth"]["mmgsd_plain"]["rmse_mean"] = results["rmse"]["cloth"]["spcl"]["rmse_mean"] / 2
    head, _, *lines = to_markdown(describe_findings(results)).splitlines()
    assert head == "| finding | cloth | rope | seeds |"
    assert len(lines) == sum(len(study.findings) for study in list_studies())
    assert "| 50 % |" in lines[0] and lines[0].endswith("| 1 |")  # seeds of another training are no other seeds of it


def test_findings_of_three_seeds_say_so_and_mark_what_they_tell() -> None:
    results = copy.deepcopy(RESULTS)
    for name, spread in (("cloth", 0.1), ("rope", 10.0)):
        for method in ("mmgsd", "unimodal"):
            first = results["seeds"][name][f"{method}-0"]["rmse_mean"]
            rows = {f"{method}-{k}": {"rmse_mean": first + (k - k * k / 2) * spread} for k in range(3)}
            results["seeds"][name] |= rows
    line = next(line for line in to_markdown(describe_findings(results)).splitlines() if "Unimodal" in line)
    assert line.endswith("| 3 % * | 3 % | 3 |")


def test_every_claim_is_a_row_with_what_repeats_it() -> None:
    claims, rows = list_claims(RESULTS), to_markdown(describe_claims(RESULTS)).splitlines()[2:]
    for claim, row in zip(claims, rows, strict=True):
        assert f"| **{claim.verdict}** |" in row and "| `" in row
        assert not set(row) & set("\\~$"), row


def test_a_claim_without_results_is_not_measured() -> None:
    assert "**not measured**" in to_markdown(describe_claims({}))


@pytest.mark.parametrize(
    ("runs", "minutes"),
    [("", "50"), ("seeds_1000", "3"), ("broken_symmetry", "–"), ("sigma", "7"), ("symmetry", "9")],
)
def test_minutes_are_summed_over_the_runs_that_are_stored(runs: str, minutes: str) -> None:
    results = {"runs": {"cloth-mmgsd": {"minutes": 20.2}, "rope-mmgsd": {"minutes": 30.1}},
               "seeds_1000": {"rope": {"spcl-0": {"run": {"minutes": 3.0}}}},
               "sigma": {"cloth": {"1": {"run": {"minutes": 7.0}}}},
               "symmetry": {"c4": {"run": {"minutes": 4.0}}, "d4": {"run": {"minutes": 5.0}}},
               "broken_symmetry": {"plain": {"rmse_mean": 3.0}}}  # fmt: skip
    models = () if runs else ("mmgsd",)
    assert sum_minutes(results, Claim("", "", "", "", (), models=models, runs=runs)) == minutes


def test_minutes_of_a_claims_models_are_those_of_all_their_seeds() -> None:
    rows = {key: {"run": {"minutes": 2.0}} for key in ("mmgsd-0", "mmgsd-1", "mmgsd_plain-0", "spcl-2")}
    claim = Claim("", "", "", "", (), models=("mmgsd", "spcl"), runs="seeds")
    assert sum_minutes({"seeds": {"cloth": rows, "rope": {}}}, claim) == "6"


def test_a_claim_is_of_three_seeds_where_they_are_of_the_same_run() -> None:
    rmse = {name: {"mmgsd_plain": {"rmse_mean": 30.0}, "spcl": {"rmse_mean": 50.0}} for name in OBJECTS}
    seeds = {name: {f"{method}-{k}": {"rmse_mean": row["rmse_mean"] + k} for method, row in rows.items()
                    for k in range(3)} for name, rows in rmse.items()}  # fmt: skip
    claims = {claim.key: claim for claim in list_claims({"rmse": rmse, "seeds": seeds})}
    assert claims["rmse"].measured == "cloth 31.0, rope 31.0 px, three seeds" and "--seeds 3" in claims["rmse"].command
    assert claims["better"].measured == "cloth 39 %, rope 39 %, three seeds" and all(claims["better"].parts)
    assert "--seeds" not in claims["rmse-dense"].command
    for key, value in (("spcl-0", 51.0), ("spcl-2", None)):  # another run's, and one that is missing
        other = copy.deepcopy(seeds)
        if value is None:
            del other["rope"][key]
        else:
            other["rope"][key]["rmse_mean"] = value
        better = next(claim for claim in list_claims({"rmse": rmse, "seeds": other}) if claim.key == "better")
        assert better.measured == "cloth 40 %, rope 40 %, one seed" and better.parts == (True, True, None)


def test_stability_is_that_of_the_main_tables_seeds_where_they_are_there() -> None:
    results = copy.deepcopy(RESULTS)
    results["seeds"] = {name: {f"{m}-{k}": {"rmse_mean": results["rmse"][name][m]["rmse_mean"] + k * spread}
                               for m, spread in (("mmgsd", 1.0), ("spcl_dense", 2.0), ("spcl", 3.0)) for k in range(3)}
                        for name in OBJECTS}  # fmt: skip
    of_main = next(claim for claim in list_claims(results) if claim.key == "stable")
    assert of_main.measured.startswith("std, MMGSD: cloth 1.0, rope 1.0 px, SPCL with dense supervision: cloth 2.0")
    assert of_main.parts == (True, True) and of_main.command.endswith("--seeds 3`") and of_main.runs == "seeds"
    of_small = next(claim for claim in list_claims({**results, "seeds": {}}) if claim.key == "stable")
    assert of_small.measured.startswith("std at the studies' budget, MMGSD: cloth 3.2")
    assert of_small.command.endswith("--steps 1000`") and of_small.runs == "seeds_1000"
