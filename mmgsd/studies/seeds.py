"""What is chance: the same trainings with other seeds, and which methods they tell from MMGSD."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from functools import partial
from typing import Any

from scipy import stats

from mmgsd.config import OBJECTS
from mmgsd.studies.claims import MARGIN, Claim, get, list_errors
from mmgsd.studies.matrix import ALL, run_matrix
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import LABELS, Column, Table

SEEDS = 3  # from which a spread over seeds is spoken of
LEVEL = 0.05  # of p, from which seeds do not tell two methods apart
SAME_SUPERVISION = {  # method: MMGSD with its supervision, dense by single images or not
    **dict.fromkeys(("spcl", "spcl_hidden", "pcl"), "mmgsd_plain"),
    **dict.fromkeys(("spcl_dense", "unimodal"), "mmgsd"),
}


def list_seeds(rows: Results, method: str, measure: str = "rmse_mean") -> list[float]:
    """The errors of those seeds of a method that have a ``measure``, from {"mmgsd-0": errors}."""
    return [row[measure] for key, row in rows.items() if key.rpartition("-")[0] == method and measure in row]


def describe_seeds(results: Results, others: Mapping[str, str] | None = None, *, seen: bool = False) -> Table:
    """The mean and the std of the RMSE over seeds, from {object: {"mmgsd-0": errors}}, a method a row.

    Tested against MMGSD's, or those of ``others`` (`compare_seeds`): the report has p by Holm's correction, a page the
    marks (`mark_tested`). With ``seen`` the error over seen matches alone stands beside it.
    """
    tested, lines = compare_seeds(results, others), {}
    for method, label in LABELS.items():
        rows = {name: {"rmse": say_seeds(results[name], method), "marked": say_tested(results, tested, name, method),
                       "seen": say_seeds(results[name], method, "rmse_seen"),
                       "p": say_p(tested, name, method)}
                for name in OBJECTS if list_seeds(results.get(name, {}), method)}  # fmt: skip
        lines |= {label: rows} if rows else {}
    columns = [Column("rmse", "mean ± std (seeds)"), Column("marked", page="mean ± std (seeds)"),
               *([Column("seen", "of seen matches", "of seen matches", optional=True)] if seen else []),
               Column("p", "p", optional=True)]  # fmt: skip
    return Table("RMSE px", {"": columns}, lines, OBJECTS)


Tested = Mapping[tuple[Any, str], tuple[float, float]]  # as `compare_seeds` has it


def say_tested(results: Mapping[Any, Results], tested: Tested, name: Any, method: str) -> str | None:
    """`say_seeds` of one part of the results, marked (`mark_tested`)."""
    text = say_seeds(results.get(name, {}), method)
    return text and text + mark_tested(tested, name, method)


def mark_tested(tested: Tested, name: Any, method: str) -> str:
    """What follows a number of seeds: an asterisk where p < `LEVEL`, a dagger where only without Holm's correction."""
    alone, corrected = tested.get((name, method), (1.0, 1.0))
    return " *" if corrected < LEVEL else " †" if alone < LEVEL else ""


def say_p(tested: Tested, name: Any, method: str) -> str | None:
    """p by Holm's correction to three decimals, "<0.001" below that; None where nothing is tested."""
    p = tested.get((name, method), (None, None))[1]
    return None if p is None else "<0.001" if p < 0.001 else f"{p:.3f}"


def compare_seeds(results: Mapping[Any, Results], others: Mapping[str, str] | None = None) -> Tested:
    """{(part, method): p of Welch's t-test against MMGSD's seeds, alone and by Holm's correction for all of them}.

    ``results`` are {part: {"mmgsd-0": errors}}, ``others`` {method: what it is tested against} instead of MMGSD.
    Holm, "A simple sequentially rejective multiple test procedure" (1979). Of methods with two seeds or more.
    """
    alone = {}
    for name, rows in results.items():
        for method in dict.fromkeys(key.rpartition("-")[0] for key in rows):
            other = "mmgsd" if others is None else others.get(method, method)
            ours, theirs = list_seeds(rows, method), list_seeds(rows, other)
            if method != other and min(len(ours), len(theirs)) > 1:
                alone[name, method] = float(stats.ttest_ind(ours, theirs, equal_var=False).pvalue)
    corrected, least = {}, 0.0
    for k, (key, p) in enumerate(sorted(alone.items(), key=lambda item: item[1])):
        least = corrected[key] = max(least, min(1.0, (len(alone) - k) * p))
    return {key: (p, corrected[key]) for key, p in alone.items()}


def average_seeds(results: Results, *methods: str) -> dict[str, dict[str, dict[str, float]]]:
    """{object: {method: {"rmse_mean": mean over seeds}}}; {} unless there are `SEEDS` of each, of both objects.

    Their seed 0 has to be the training that "rmse" shows: a copy's own results do not mix with seeds that are stored.
    """
    every = {name: get(results, "seeds", name) or {} for name in OBJECTS}
    for name, rows in every.items():
        for method in methods:
            first = get(rows, f"{method}-0", "rmse_mean")
            if len(list_seeds(rows, method)) < SEEDS or first != get(results, "rmse", name, method, "rmse_mean"):
                return {}
    return {name: {method: {"rmse_mean": statistics.mean(list_seeds(rows, method))} for method in methods}
            for name, rows in every.items()}  # fmt: skip


def list_means(results: Results) -> dict[str, dict[str, dict[str, float]]]:
    """{object: {method: {"rmse_mean": error}}} of "rmse", each the mean over all seeds there are of that training."""
    means: dict[str, dict[str, dict[str, float]]] = {}
    for name, rows in results.get("rmse", {}).items():
        seeds = get(results, "seeds", name) or {}
        means[name] = {}
        for method, row in rows.items():
            same = get(seeds, f"{method}-0", "rmse_mean") == row["rmse_mean"]
            errors = list_seeds(seeds, method) if same else [row["rmse_mean"]]
            means[name][method] = {"rmse_mean": statistics.mean(errors)}
    return means


def tell_apart(results: Results, method: str) -> Tested:
    """`compare_seeds` of a method and MMGSD of the same supervision, corrected for all rows that seeds compare.

    {} where `average_seeds` has no means of the two.
    """
    if not average_seeds(results, method, SAME_SUPERVISION[method]):
        return {}
    tested = compare_seeds({name: results["seeds"][name] for name in OBJECTS}, SAME_SUPERVISION)
    return {(name, method): tested[name, method] for name in OBJECTS}


def make_first_seed_sentence(results: Results) -> str:
    """What the seed 0 of MMGSD, which other studies rest on, has beside its other seeds."""
    each = {name: list_seeds(results[name], "mmgsd") for name in OBJECTS}
    texts = [f"{values[0]:.1f} px on {name} (others {', '.join(f'{v:.1f}' for v in values[1:])})"
             for name, values in each.items()]  # fmt: skip
    return f"The tables of budget, σ and symmetry rest on MMGSD's seed 0: {', '.join(texts)}."


def say_seeds(rows: Results, method: str, measure: str = "rmse_mean") -> str | None:
    """Mean, std of the sample, and how many: "54.6 ± 0.8 (3)"; no std of one, None of none."""
    values = list_seeds(rows, method, measure)
    if len(values) < 2:
        return f"{values[0]:.1f} (1)" if values else None
    return f"{statistics.mean(values):.1f} ± {statistics.stdev(values):.1f} ({len(values)})"


def judge_stable(results: Results) -> Claim:
    """The contrastive training's instability, as the spread over seeds, the main table's where they are there."""
    methods = ("mmgsd", "spcl_dense", "spcl")
    whole = bool(average_seeds(results, *methods))
    file, budget, steps = ("seeds", "", "") if whole else ("seeds_1000", " at the studies' budget", " --steps 1000")
    errors = {m: {name: list_seeds(get(results, file, name) or {}, m) for name in OBJECTS} for m in methods}
    spreads = {m: {name: statistics.stdev(values) if len(values) >= SEEDS else None for name, values in row.items()}
               for m, row in errors.items()}  # fmt: skip
    parts = []
    for name in OBJECTS:
        ours, theirs = spreads["mmgsd"][name], spreads["spcl_dense"][name]
        least = MARGIN * statistics.mean(errors["spcl_dense"][name] or [0.0])
        parts.append(None if ours is None or theirs is None else theirs > max(ours, least))
    reference = {name: get(results, "rmse", name, "spcl_reference", "rmse_mean") for name in OBJECTS}
    return Claim(
        "stable", "SPCL's training is unstable; MMGSD's is more stable.",
        f"Over {SEEDS} seeds or more, SPCL's error has the larger standard deviation, one above "
        f"{100 * MARGIN:.0f} % of its mean, both with dense supervision; a part each object.",
        f"std{budget}, MMGSD: {list_errors(spreads['mmgsd'])}, "
        f"SPCL with dense supervision: {list_errors(spreads['spcl_dense'])}, without: {list_errors(spreads['spcl'])}; "
        f"in its reference setting, one seed, SPCL's error is {list_errors(reference)}", tuple(parts),
        f"{ALL[:-1]} --seeds {SEEDS}{steps}`", models=methods if whole else (), runs=file,
    )  # fmt: skip


def say_count(seeds: int) -> str:
    """ "three seeds"."""
    return {1: "one seed", 2: "two seeds", 3: "three seeds"}.get(seeds, f"{seeds} seeds")


STUDY = Study(
    "seeds", 30, partial(run_matrix, seeds=SEEDS), results=("seeds_1000", "seeds"),
    tables={
        "seeds": Shown("paper/seeds.json", partial(describe_seeds, others=SAME_SUPERVISION, seen=True), "seeds_table"),
        "seeds_1000": Shown("paper/seeds_1000.json", describe_seeds),
        "first_seed": Shown("paper/seeds_1000.json", make_first_seed_sentence),
        "seeds_quick": Shown("quick/seeds.json", describe_seeds),
    },
    claims=(judge_stable,),
)  # fmt: skip
