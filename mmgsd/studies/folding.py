"""Folding by demonstration: rollouts of every policy from the same first states (`mmgsd.studies.bench`), as a study.

    python -m mmgsd run folding quick              -> data/results/quick/folding.json, figures/quick/folding*
    python -m mmgsd run folding quick --only mmgsd those policies whose name holds that text
    python -m mmgsd run folding quick --trained    the four methods as the preset quick trains them
    python -m mmgsd run folding demonstrations     -> data/demonstrations, what policies are shown
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.checks import check_choice
from mmgsd.command import Option
from mmgsd.config import OBJECTS
from mmgsd.figures.folding import plot_rollouts, save_slides
from mmgsd.figures.style import PAGE_IN, finish_axes, save_figure, styled
from mmgsd.files import read_json, write_json
from mmgsd.fold.demonstration import write_demonstration
from mmgsd.fold.measures import estimate_share
from mmgsd.fold.state import read_state
from mmgsd.fold.tasks import GROUNDS, STARTS, TASKS
from mmgsd.paths import Paths, find_root
from mmgsd.studies.bench import REFERENCE, Bench, choose_shown, list_rollouts, summarise_policies
from mmgsd.studies.claims import Claim, get, list_shares
from mmgsd.studies.policies import POLICIES, SHIPPED, TRAINED_BY, Policy
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import MISSING, Table, make_page_table

ROLLOUTS = {"smoke": 2, "quick": 36, "paper": 100}  # of each policy and object
DEMONSTRATIONS = "demonstrations"  # instead of a preset: write these alone
DEMONSTRATION_QUALITY = 90  # of the images of demonstrations as files
HEADS = ("success", "as true matches", "error", "beside MMGSD's")
SLACK = 0.03  # of the side, by which an error may be above that of the true matches and be as good


def run(
    paths: Paths, *, policies: Iterable[Policy] = SHIPPED, workers: int = 0, scheduler: str = "", progress: bool = True
) -> Path:
    """Run a preset's rollouts of some policies, write what came of them, and draw one of each task; the results' path.

    Drawn are these policies, where `REFERENCE` is one of them. Rows of other policies that the results hold stay.
    ``workers`` and ``scheduler`` are as `run_jobs` has them. ValueError for a preset without rollouts.
    """
    check_choice("preset", paths.preset, tuple(ROLLOUTS))
    bench = Bench(paths.generated / "folding", {"workers": workers, "scheduler": scheduler, "progress": progress})
    out, ours = paths.results / "folding.json", POLICIES[REFERENCE]
    rows = read_json(out)["policies"] if out.is_file() else {name: {} for name in OBJECTS}
    policies, pictures, slides = list(policies), {}, []
    for object in OBJECTS:
        rollouts = list_rollouts(object, ROLLOUTS[paths.preset])
        starts = bench.make_starts(rollouts)
        faultless = [rollout for rollout in rollouts if not read_state(starts[rollout]).about["fault"]]
        outcomes = bench.roll(policies, faultless, starts)
        untouched = {rollout.name: bench.judge(rollout, starts[rollout], []) for rollout in faultless}
        rows[object] = summarise_policies(rows[object], {"nothing": untouched} | outcomes)
        examples = choose_shown(faultless, outcomes.get(REFERENCE, {}))
        pictures |= bench.list_pictures(policies, examples, starts, outcomes)
        slides += bench.list_slides(ours, examples) if ours in policies else []
    if slides:
        save_figure(plot_rollouts(pictures), paths.figures / "folding", kinds=("jpg",))
        save_slides(slides, paths.figures / "folding.webp")
    results = {"run": {"rollouts": ROLLOUTS[paths.preset]}, "policies": rows}
    if any("reachable" in row for by_policy in rows.values() for row in by_policy.values()):
        save_figure(plot_success(results), paths.figures / "folding_success", kinds=("png",))
    return write_json(out, results)


def write_demonstrations(root: Path, **how: Any) -> list[Path]:
    """Write what policies are shown of each task to ``data/demonstrations``, as a user's demonstrations are; the paths.

    ``how``, the workers, scheduler and progress, is as `run_jobs` has it.
    """
    bench, folder = Bench(Paths(root, "quick").generated / "folding", how), root / "data" / "demonstrations"
    bench.demonstrate(TASKS.values())
    return [write_demonstration(bench.make_demonstration(task), folder / f"{task.name}.json",
                                quality=DEMONSTRATION_QUALITY) for task in TASKS.values()]  # fmt: skip


def describe_folding(results: Results) -> Table:
    """A row a policy: success and error of the rollouts that count; how many of all end as true matches do.

    Which count is as in `summarise_policies`; all, with an error at most `SLACK` above that of the true matches, end as
    these. With 95 % intervals, of shares Wilson's; what was not measured is a dash.
    """
    heads = [f"{name}: {head}" if head == HEADS[0] else head for name in OBJECTS for head in HEADS]
    rows, lines = results["policies"], {}
    for name, policy in POLICIES.items():
        if any(name in rows[object] for object in OBJECTS):
            lines[policy.label] = [cell for object in OBJECTS for cell in _list_cells(rows[object], name)]
    return make_page_table(heads, lines)


def _list_cells(rows: Mapping[str, Any], name: str) -> list[str]:
    row = rows.get(name, {})
    if "reachable" not in row:
        return [MISSING] * len(HEADS)
    share, counted = (rows.get(key, row)["reachable"]["success"] for key in (name, "truth"))
    fewer = f" of {share['count']}" if share["count"] != counted["count"] else ""  # it had not all of the rollouts
    success = say_share(share) + fewer
    same = say_share(estimate_share(list(_list_like_truth(rows, name).values())))
    error = f"{100 * row['reachable']['error']['mean']:.1f} %"
    return [success, same, error, say_beyond(row["beyond"]["error"])]


def describe_starts(results: Results) -> Table:
    """A row a policy: how many rollouts end as true matches do, by ground and by start, of all."""
    places = {object: (*GROUNDS, *(start.replace(" ", "_") for start in STARTS[object])) for object in OBJECTS}
    lines = {}
    for name, policy in POLICIES.items():
        like = {object: _list_like_truth(results["policies"][object], name) for object in OBJECTS}
        if any(like.values()):
            lines[policy.label] = [_count([same for key, same in like[object].items() if place in key.split("-")[1:3]])
                                   for object in OBJECTS for place in places[object]]  # fmt: skip
    return make_page_table([f"{object}: {place.replace('_', ' ')}" for object in OBJECTS for place in places[object]],
                           lines)  # fmt: skip


def _list_like_truth(rows: Mapping[str, Any], name: str) -> dict[str, bool]:
    """Whether each rollout that all policies have ends as the true matches do; {} of a policy without any."""
    if name not in rows or "truth" not in rows:
        return {}
    truth, ours = rows["truth"]["rollouts"], rows[name]["rollouts"]
    shared = [key for key in truth if all(key in row["rollouts"] for row in rows.values())]
    return {key: ours[key][0] <= truth[key][0] + SLACK for key in shared}


def make_folding_sentence(results: Results) -> str:
    """How many rollouts count, and what caution brings."""
    sentences = [f"{object.capitalize()}: {_say_object(results['policies'][object])}." for object in OBJECTS]
    return " ".join(sentences)


def _say_object(rows: Mapping[str, Any]) -> str:
    truth = rows["truth"]
    counted = truth["reachable"]["success"]["count"] if "reachable" in truth else 0
    text = f"{counted} of {truth['all']['success']['count']} rollouts count"
    sure = get(rows, "mmgsd", "cautious") or {"count": 0}
    if 0 < sure["count"] < counted:  # else caution leaves all of them, or none
        text += f"; MMGSD succeeds in {100 * sure['mean']:.0f} % of the {sure['count']} whose modes agree most"
    return text


def say_share(share: Mapping[str, Any]) -> str:
    """A share with its 95 % interval; a dash of none."""
    if share["mean"] is None:
        return MISSING
    return f"{100 * share['mean']:.0f} % ({100 * share['low']:.0f} to {100 * share['high']:.0f})"


def say_beyond(more: Mapping[str, Any]) -> str:
    """A difference in points, with its interval."""
    numbers = (f"{100 * more[key]:+.1f}".replace("-", "−") for key in ("mean", "low", "high"))
    return "{} ({} to {})".format(*numbers)


def _count(values: Sequence[bool]) -> str:
    return f"{sum(values)} of {len(values)}" if values else MISSING


def tabulate_errors(results: Results) -> pd.DataFrame:
    """Mean error in % of the side, a row a policy, by the state that the object was found in."""
    rows = [(object, key.split("-")[1].replace("_", " "), POLICIES[name].label, 100 * error)
            for object, policies in results["policies"].items() for name, row in policies.items()
            for key, (error, _) in row["rollouts"].items()]  # fmt: skip
    table = pd.DataFrame(rows, columns=["object", "start", "policy", "error"])
    return table.pivot_table("error", "policy", ["object", "start"], sort=False)


def shorten(folder: Path, results: Results) -> dict[str, Any]:
    """{object: {policy: its measures where rollouts count, and ``beyond`` MMGSD's}} in place of all rollouts."""
    return {"folding": {object: {name: {**row["reachable"], "beyond": row["beyond"]} for name, row in policies.items()
                                 if "reachable" in row and "beyond" in row}
                        for object, policies in results["folding"]["policies"].items()}} if results else {}  # fmt: skip


def judge_several(results: Results) -> Claim:
    """A robot takes the surest where several places are grasped at once: each may be a match of another turn."""
    low = {name: get(results, "folding", name, "mmgsd_best", "beyond", "error", "low") for name in OBJECTS}
    parts = tuple(None if low[name] is None else low[name] <= 0 for name in OBJECTS)
    ways = {"modes that agree": "mmgsd", "surest joint answer": "mmgsd_joint", "each pixel's surest": "mmgsd_best"}
    texts = []
    for name in OBJECTS:
        successes = {way: get(results, "folding", name, policy, "success", "mean") for way, policy in ways.items()}
        texts.append(f"{name}: {list_shares(successes)}")
    return Claim(
        "several", "Our question: may each of several picks take its own surest match?",
        "Folding by each pixel's surest mode ends no farther off than by modes that agree, as far as the 95 % interval "
        "of the difference tells; a part each object.", f"successes, {'; '.join(texts)}", parts,
        "`.venv/bin/python -m mmgsd run folding paper`",
    )  # fmt: skip


@styled
def plot_success(results: Mapping[str, Any]) -> Figure:
    """A panel for each object: how often each policy succeeds in the rollouts that count, with 95 % intervals."""
    rows = results["policies"]
    names = [name for name in POLICIES if any("reachable" in rows[object].get(name, {}) for object in OBJECTS)]
    size = PAGE_IN, 0.7 + 0.2 * len(names)
    figure, axes = plt.subplots(1, len(OBJECTS), figsize=size, layout="constrained", sharey=True)
    for axis, object in zip(axes, OBJECTS, strict=True):
        counted = get(rows, object, "truth", "reachable", "success", "count") or 0
        for place, name in enumerate(names):
            share = get(rows, object, name, "reachable", "success")
            if share:
                mean, low, high = (100 * share[key] for key in ("mean", "low", "high"))
                axis.errorbar(mean, place, xerr=[[mean - low], [high - mean]], fmt="o", ms=4, capsize=2,
                              color=POLICIES[name].colour)  # fmt: skip
                if share["count"] != counted:
                    axis.annotate(f"of {share['count']}", (high, place), xytext=(5, 0), textcoords="offset points",
                                  va="center", fontsize=6)  # fmt: skip
        axis.set(title=f"{object.capitalize()}, {counted} rollouts", xlabel="Success (%)", xlim=(-4, 104))
    axes[0].set_yticks(range(len(names)), [POLICIES[name].label.replace("`", "") for name in names])
    axes[0].invert_yaxis()
    return finish_axes(figure)


STUDY = Study(
    "folding", 110, run, notebook="10_fold_by_demonstration", results=("folding",), derive=shorten,
    tables={
        "folding": Shown("paper/folding.json", describe_folding),
        "folding_counts": Shown("paper/folding.json", make_folding_sentence),
        "folding_starts": Shown("paper/folding.json", describe_starts),
    },
    claims=(judge_several,),
)  # fmt: skip


def main(
    preset: Annotated[str, Option(choices=(*ROLLOUTS, DEMONSTRATIONS))],
    *,
    only: Annotated[str, Option("policies whose name holds this text; their rows alone are written")] = "",
    trained: Annotated[bool, Option(f"instead the four methods' models that the preset {TRAINED_BY} trained")] = False,
    workers: Annotated[int, Option("child processes at once (default: one a core)")] = 0,
    scheduler: Annotated[str, Option("address of a Dask scheduler; none: this machine")] = "",
) -> None:
    """Run the bench of a preset, or write the demonstrations."""
    how = {"workers": workers, "scheduler": scheduler}
    if preset == DEMONSTRATIONS:
        if only:
            raise ValueError(f"--only {only!r} must be given with a preset, got {DEMONSTRATIONS}")
        print(*write_demonstrations(find_root(), **how), sep="\n")
        return
    candidates = [policy for policy in POLICIES.values() if policy.trained] if trained else SHIPPED
    policies = [POLICIES["truth"], *(p for p in candidates if only in p.name and p.name != "truth")]
    if not any(only in policy.name for policy in candidates):
        names = ", ".join(policy.name for policy in candidates)
        raise ValueError(f"--only {only!r}: no policy has a name with that; there are {names}")
    print(run(Paths(find_root(), preset), policies=policies, **how))
