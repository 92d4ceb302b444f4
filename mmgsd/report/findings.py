"""What was found, in sentences whose numbers come from the results, and the table of the paper's claims."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.report.claims import IMPROVEMENT, NOT_MEASURED, Claim, get, list_claims
from mmgsd.report.descriptions import Column, Table

DETAIL = "data/results/README.md"  # seen from the README
FINDINGS = (  # a name, a sentence, the section of the results page that it leads to
    ("Against SPCL", ": MMGSD has {spcl} less error on cloth and rope; the paper says {paper} over both.", "main"),
    ("Dense supervision", " is most of that: where SPCL has it too, {dense} are left.", "main"),
    ("Telling all matches", " instead of one changes little: Unimodal has {unimodal} more error.", "main"),
    ("More training", ", larger images and a deeper network take MMGSD from {main} to {deep}.", "longer"),
    ("Errors are at what is hidden", " on cloth: without hidden matches {seen}, over all {all}.", "where"),
    ("Entropy ranks errors", " by a rank correlation of {ranks}: the less certain can be refused.", "uncertainty"),
)
SECTIONS = {
    "main": "which-method-is-best", "longer": "does-more-training-help", "where": "where-is-the-error",
    "uncertainty": "does-an-answer-know-how-wrong-it-is",
}  # fmt: skip
MATRIX = "`.venv/bin/python -m mmgsd.measure.matrix paper`"
REPEATS = {  # claim: what repeats it, and the models of runs.json that it trains
    "rmse": ("`03_train`, `04_evaluate`", ("mmgsd",)),
    "improvement": (MATRIX, ("mmgsd", "spcl", "spcl_dense")),
    "sigma": ("`05_sigma_ablation`", ()),
    "interior": ("`04_evaluate`, `07_figures`", ("mmgsd",)),
    "hand-made": ("`04_evaluate`", ()),
    "rotation-limit": ("`11_broken_symmetry`", ()),
    "ball": ("`11_broken_symmetry`", ()),
    "entropy": ("`06_uncertainty`", ("mmgsd",)),
    "inward": ("`08_symmetry_study`", ()),
    "group": ("`08_symmetry_study`", ()),
    "surest": ("`.venv/bin/python -m mmgsd.fold.rollouts paper`", ()),
}

STUDIES = {"inward": "symmetry", "group": "symmetry", "rotation-limit": "broken_symmetry", "ball": "broken_symmetry"}


def make_findings(results: Mapping[str, Any]) -> str:
    """A Markdown list of the main findings, each with a link to its section of the results page."""
    errors = {method: [results["rmse"][name][method]["rmse_mean"] for name in OBJECTS]
              for method in ("mmgsd", "spcl", "spcl_dense", "unimodal", "mmgsd_fine_deep")}  # fmt: skip
    ranks = (get(results, "uncertainty", "calibrated", name, "mmgsd", "spearman") for name in OBJECTS)
    hidden = results["errors"]["cloth"]
    numbers = {
        "paper": f"{100 * IMPROVEMENT:.1f} %",
        "spcl": _format_gains(errors["mmgsd"], errors["spcl"]),
        "dense": _format_gains(errors["mmgsd"], errors["spcl_dense"]),
        "unimodal": _format_gains(errors["unimodal"], errors["mmgsd"], sign=-1),
        "main": _join(f"{error:.1f}" for error in errors["mmgsd"]),
        "deep": _join(f"{error:.1f} px" for error in errors["mmgsd_fine_deep"]),
        "seen": f"{hidden['no match hidden']:.1f} px", "all": f"{hidden['all']:.1f} px",
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
    if key == "sigma":
        runs = [row.get("run") for name in OBJECTS for row in (get(results, "sigma", name) or {}).values()]
    elif key in STUDIES:
        runs = [row.get("run") for row in (get(results, STUDIES[key]) or {}).values()]
    known = [run["minutes"] for run in runs if run]
    return f"{sum(known):.0f}" if known else "–"


def _format_gains(ours: Iterable[float], theirs: Iterable[float], *, sign: int = 1) -> str:
    """By how much of theirs ours are smaller; larger with ``sign`` -1."""
    return _join(f"{100 * sign * (1 - a / b):.0f} %" for a, b in zip(ours, theirs, strict=True))


def _join(texts: Iterable[str]) -> str:
    return " and ".join(texts)
