"""What was found, in sentences whose numbers come from the results, and the table of the paper's claims."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.report.claims import NOT_MEASURED, Claim, get, list_claims
from mmgsd.report.descriptions import LEVEL, Column, Table, compare_seeds

DETAIL = "data/results/README.md"  # seen from the README
FINDINGS = (  # a name, a sentence, the section of the results page that it leads to
    ("The paper's own loss", " has {plain} px on cloth and rope, {gain} below SPCL.", "main"),
    ("With dense supervision", " MMGSD's error is {spcl} below SPCL's without it, {dense} with it.", "main"),
    ("Seeds", ", three at a smaller budget, tell MMGSD from SPCL {apart}, from SPCL with it {apart_dense}.", "budget"),
    ("Telling all matches", " instead of one changes little: Unimodal has at most {unimodal} more error.", "main"),
    ("More training", ", larger images and a deeper network take MMGSD to {deep}.", "longer"),
    ("Hidden matches", " are a part of the cloth's error: {seen} of it remain without them.", "where"),
    ("Entropy ranks errors", " by a rank correlation of {ranks}: the less certain can be refused.", "uncertainty"),
)
SECTIONS = {
    "main": "which-method-is-best", "budget": "what-does-a-smaller-equal-budget-give",
    "longer": "does-more-training-help", "where": "where-is-the-error",
    "uncertainty": "does-an-answer-know-how-wrong-it-is",
}  # fmt: skip
MATRIX = "`.venv/bin/python -m mmgsd run models paper`"
REPEATS = {  # claim: what repeats it, and the models of runs.json that it trains
    "rmse": (MATRIX, ("mmgsd_plain",)),
    "rmse-dense": ("`03_train`, `04_evaluate`", ("mmgsd",)),
    "improvement": (MATRIX, ("mmgsd_plain", "mmgsd", "spcl", "spcl_dense")),
    "sigma": ("`05_sigma_ablation`", ()),
    "stable": (f"{MATRIX[:-1]} --seeds 3 --steps 1000`", ()),
    "continuous": ("`.venv/bin/python -m mmgsd run continuity`", ("mmgsd", "spcl")),
    "interior": ("`04_evaluate`, `07_figures`", ("mmgsd",)),
    "bimodal": ("`04_evaluate`, `07_figures`", ("mmgsd",)),
    "hand-made": ("`04_evaluate`", ()),
    "rotation-limit": ("`11_broken_symmetry`", ()),
    "ball": ("`11_broken_symmetry`", ()),
    "entropy": ("`06_uncertainty`", ("mmgsd",)),
    "inward": ("`08_symmetry_study`", ()),
    "hidden": ("`09_error_analysis`", ("mmgsd",)),
    "surest": ("`.venv/bin/python -m mmgsd run grasp paper`", ()),
    "several": ("`.venv/bin/python -m mmgsd run folding paper`", ()),
    "group": ("`08_symmetry_study`", ()),
}
STUDIES = {
    "inward": "symmetry",
    "group": "symmetry",
    "rotation-limit": "broken_symmetry",
    "ball": "broken_symmetry",
    "sigma": "sigma",
    "stable": "seeds_1000",
}  # claim: the results file whose runs it rests on


def make_findings(results: Mapping[str, Any]) -> str:
    """A Markdown list of the main findings, each with a link to its section of the results page."""
    errors = {method: [results["rmse"][name][method]["rmse_mean"] for name in OBJECTS]
              for method in ("mmgsd", "mmgsd_plain", "spcl", "spcl_dense", "unimodal", "mmgsd_fine_deep")}  # fmt: skip
    ranks = (get(results, "uncertainty", "calibrated", name, "mmgsd", "spearman") for name in OBJECTS)
    hidden = results["errors"]["cloth"]
    numbers = {
        "plain": _join(f"{error:.1f}" for error in errors["mmgsd_plain"]),
        "gain": _format_gains(errors["mmgsd_plain"], errors["spcl"]),
        "apart": _say_apart(results["seeds_1000"], "spcl"),
        "apart_dense": _say_apart(results["seeds_1000"], "spcl_dense"),
        "spcl": _format_gains(errors["mmgsd"], errors["spcl"]),
        "dense": _format_gains(errors["mmgsd"], errors["spcl_dense"]),
        "unimodal": f"{max(100 * (a / b - 1) for a, b in zip(errors['unimodal'], errors['mmgsd'], strict=True)):.0f} %",
        "deep": _join(f"{error:.1f} px" for error in errors["mmgsd_fine_deep"]),
        "seen": f"{100 * hidden['no match hidden'] / hidden['all']:.0f} %",
        "ranks": _join(f"{rank:.2f}" for rank in ranks),
    }  # fmt: skip
    links = (f"[**{name}**]({DETAIL}#{SECTIONS[section]})" for name, _, section in FINDINGS)
    return "\n".join(f"- {link}{row[1].format(**numbers)}" for link, row in zip(links, FINDINGS, strict=True))


def describe_claims(results: Mapping[str, Any]) -> Table:
    """The paper's claims: the rule, verdict, what was measured, what repeats it, minutes of training."""
    columns = [
        Column("rule", "counts as held where"), Column("verdict", "verdict", "here"),
        Column("measured", "measured", "measured"), Column("command", page="repeat it by"),
        Column("minutes", page="minutes"),
    ]  # fmt: skip
    return Table("claim", {"": columns}, {claim.claim: {"": _tell(claim, results)} for claim in list_claims(results)})


def _tell(claim: Claim, results: Mapping[str, Any]) -> dict[str, str]:
    command, models = REPEATS[claim.key]
    measured = "no results for this preset" if claim.verdict == NOT_MEASURED else claim.measured
    return {"rule": claim.rule, "verdict": f"**{claim.verdict}**", "measured": measured, "command": command,
            "minutes": sum_minutes(results, claim.key, models)}  # fmt: skip


def sum_minutes(results: Mapping[str, Any], key: str, models: Iterable[str]) -> str:
    """Minutes that training a claim's models took, of both objects together; a dash where no file says."""
    runs = [get(results, "runs", f"{name}-{model}") for name in OBJECTS for model in models]
    if key in STUDIES:
        rows = results.get(STUDIES[key], {})
        parts = [rows[name] for name in OBJECTS if name in rows] or [rows]
        runs = [row.get("run") for part in parts for row in part.values()]
    known = [run["minutes"] for run in runs if run]
    return f"{sum(known):.0f}" if known else "–"


def _format_gains(ours: Iterable[float], theirs: Iterable[float]) -> str:
    """By how much of theirs ours are smaller."""
    return _join(f"{100 * (1 - a / b):.0f} %" for a, b in zip(ours, theirs, strict=True))


def _say_apart(seeds: Mapping[str, Any], method: str) -> str:
    """On which objects seeds tell a method from MMGSD, corrected for all that are compared."""
    tested = compare_seeds(seeds)
    found = [name for name in OBJECTS if tested.get((name, method), (1.0, 1.0))[1] < LEVEL]
    return {0: "on neither", len(OBJECTS): "on both"}.get(len(found), f"on the {_join(found)} alone")


def _join(texts: Iterable[str]) -> str:
    return " and ".join(texts)
