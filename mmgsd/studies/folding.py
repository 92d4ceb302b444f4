"""The bench: rollouts of every policy from the same first states, as files, and what came of them.

    python -m mmgsd run folding quick              -> data/results/quick/folding.json, figures/quick/folding*
    python -m mmgsd run folding quick --only mmgsd those policies whose name holds that text
    python -m mmgsd run folding quick --trained    the four methods as the preset quick trains them
    python -m mmgsd run folding demonstrations     -> data/demonstrations, what policies are shown

All go in step: first states, every policy's answers, what physics makes of them, the next look. A killed run goes on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mmgsd.checks import check_choice
from mmgsd.command import Option
from mmgsd.config import DEFAULT_GROUP, OBJECTS
from mmgsd.figures.folding import mark_moves, mark_success, plot_rollouts, save_slides
from mmgsd.figures.style import PAGE_IN, finish_axes, save_figure, styled
from mmgsd.files import is_kept, read_json, write_json
from mmgsd.fold.consensus import Motion
from mmgsd.fold.demonstration import Demonstration, Look, write_demonstration
from mmgsd.fold.jobs import act_job, demonstration_job, look_job, run_jobs, start_job, true_moves
from mmgsd.fold.measures import SIDES_M, SUCCESS, compare_rollouts, estimate_mean, estimate_share, measure_outcome
from mmgsd.fold.moves import PolicyAnswer, choose_moves
from mmgsd.fold.state import State, read_state
from mmgsd.fold.tasks import GROUNDS, STARTS, TASKS, Task, find_task
from mmgsd.match.camera import compute_rays
from mmgsd.paths import Paths, find_root
from mmgsd.progress import ProgressBar
from mmgsd.studies.claims import Claim, get, list_shares
from mmgsd.studies.policies import POLICIES, SHIPPED, TRAINED_BY, Policy, ask, digest_policy, draw_moves
from mmgsd.studies.registry import Results, Shown, Study
from mmgsd.studies.table import MISSING, Table, make_page_table
from mmgsd.symmetry import load_group

ROLLOUTS = {"smoke": 2, "quick": 36, "paper": 100}  # of each policy and object
MORE = ("wrinkled", 0.4)  # a start of which few rollouts count, and how many more begin from it, of the count
DEMONSTRATIONS = "demonstrations"  # instead of a preset: write these alone
REFERENCE = "mmgsd"  # the policy that the others are compared with, rollout by rollout
DEMONSTRATION_QUALITY = 90  # of the images of demonstrations as files
AGREES = 0.7  # share of the questions that agree from which a cautious robot acts
HEADS = ("success", "as true matches", "error", "beside MMGSD's")
SLACK = 0.03  # of the side, by which an error may be above that of the true matches and be as good
ANCHORS = {"cloth": [25 * r + c for r in (1, 12, 23) for c in (1, 12, 23) if (r, c) != (12, 12)],
           "rope": [8, 120, 200, 424, 504, 616]}  # fmt: skip  # material points that a demonstration marks besides


@dataclass(frozen=True)
class Rollout:
    """One first state: which task, from which start, on which ground, with which seed."""

    task: str
    start: str
    ground: str
    seed: int
    turn_deg: float | None = None  # the most that the object is seen turned by, both ways; None: by any angle

    @property
    def name(self) -> str:
        """What its files are called by."""
        within = "" if self.turn_deg is None else f"-within-{self.turn_deg:g}"
        return f"{self.task}-{self.start.replace(' ', '_')}-{self.ground}-{self.seed}{within}"


Arm = tuple[Policy, Rollout]


def list_rollouts(object: str, count: int) -> list[Rollout]:
    """``count`` rollouts of an object, its tasks, their starts and the grounds in turn; then those of `MORE`."""
    kinds = [(task.name, start) for task in TASKS.values() if task.object == object for start in task.starts]
    more = [kind for kind in kinds if kind[1] == MORE[0]]
    turns = [(kinds, k) for k in range(count)] + [(more, k) for k in range(int(MORE[1] * count) if more else 0)]
    return [Rollout(*chosen[k % len(chosen)], GROUNDS[k // len(chosen) % len(GROUNDS)], seed)
            for seed, (chosen, k) in enumerate(turns)]  # fmt: skip


def list_limited(object: str, count: int, turn_deg: float) -> list[Rollout]:
    """``count`` rollouts of an object, its tasks and starts in turn, on plain ground and within a limit (°)."""
    kinds = [(task.name, start) for task in TASKS.values() if task.object == object for start in task.starts]
    return [Rollout(*kinds[seed % len(kinds)], "plain", seed, turn_deg) for seed in range(count)]


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
        kept = [rollout for rollout in rollouts if not read_state(starts[rollout]).about["fault"]]
        found = bench.roll(policies, kept, starts)
        untouched = {rollout.name: bench.judge(rollout, starts[rollout], []) for rollout in kept}
        rows[object] = summarise_policies(rows[object], {"nothing": untouched} | found)
        shown = choose_shown(kept, found.get(REFERENCE, {}))
        pictures |= bench.list_pictures(policies, shown, starts, found)
        slides += bench.list_slides(ours, shown) if ours in policies else []
    if slides:
        save_figure(plot_rollouts(pictures), paths.figures / "folding", kinds=("jpg",))
        save_slides(slides, paths.figures / "folding.webp")
    results = {"run": {"rollouts": ROLLOUTS[paths.preset]}, "policies": rows}
    if any("reachable" in row for found in rows.values() for row in found.values()):
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


class Bench:
    """The files of a preset's rollouts in a ``folder``; ``how`` is what `run_jobs` is told of workers."""

    def __init__(self, folder: Path, how: Mapping[str, Any]) -> None:
        self.folder, self.how = Path(folder), dict(how)
        self.demonstrated: dict[str, list[State]] = {}
        self.ends: dict[Arm, Path] = {}
        self.acted: dict[Arm, list[tuple[Path, PolicyAnswer]]] = {}  # each look, and what was done

    def make_starts(self, rollouts: list[Rollout]) -> dict[Rollout, Path]:
        """First states, and before them the states that the rollouts' demonstrations go through."""
        self.demonstrate({rollout.task: find_task(rollout.task) for rollout in rollouts}.values())
        jobs = {r.name: start_job(find_task(r.task), r.start, r.ground, r.seed, turn_deg=r.turn_deg) for r in rollouts}
        files = run_jobs(jobs, self.folder / "starts", **self.how)
        return {rollout: files[rollout.name] for rollout in rollouts}

    def demonstrate(self, tasks: Iterable[Task]) -> None:
        """The states before, between and after tasks' looks, each look by its own places."""
        folder = self.folder / "demonstrations"
        for task in (task for task in tasks if task.name not in self.demonstrated):
            files = run_jobs({f"{task.name}_0": demonstration_job(task, 0)}, folder, **self.how)
            states = [read_state(files[f"{task.name}_0"])]
            for number, look in enumerate(task.looks, 1):
                moves, name = true_moves(look, states[0].points, states[-1]), f"{task.name}_{number}"
                files |= run_jobs({name: act_job(files[f"{task.name}_{number - 1}"], moves)}, folder, **self.how)
                states.append(read_state(files[name]))
            self.demonstrated[task.name] = states

    def make_demonstration(self, task: Task) -> Demonstration:
        """What a policy is shown of a task: images, picks and places, and anchors where they are seen."""
        looks = []
        for moves, state in zip(task.looks, self.demonstrated[task.name], strict=False):
            pixels = np.array(true_moves(moves, self.demonstrated[task.name][0].points, state), float)
            anchors = [k for k in ANCHORS[task.object] if state.visible[k] and k not in [move.pick for move in moves]]
            places = (*(move.pick for move in moves), *anchors)
            looks.append(Look(state.image, pixels.reshape(-1, 2, 2), state.xy[anchors].astype(float), places))
        return Demonstration(task.object, tuple(looks))

    def roll(
        self, policies: list[Policy], rollouts: list[Rollout], starts: dict[Rollout, Path]
    ) -> dict[str, dict[str, dict[str, Any]]]:
        """{policy: {rollout: how it ended}} of every policy from every first state."""
        files = {(policy, rollout): starts[rollout] for policy in policies for rollout in rollouts}
        answers: dict[Arm, list[PolicyAnswer]] = {arm: [] for arm in files}
        for number in range(max(len(find_task(rollout.task).looks) for rollout in rollouts)):
            going = [arm for arm in files if len(find_task(arm[1].task).looks) > number]
            for arm in ProgressBar(going, desc="answer", disable=not self.how["progress"], leave=False):
                answers[arm].append(self._answer(*arm, number, files[arm], answers[arm]))
            self._look_again(going, number, files, answers)
            for arm in going:
                self.acted.setdefault(arm, []).append((files[arm], answers[arm][-1]))
            names = {arm: f"{arm[0].name}-{arm[1].name}-{number}" for arm in going}
            jobs = {names[arm]: act_job(files[arm], answers[arm][-1].moves.tolist()) for arm in going}
            made = run_jobs(jobs, self.folder / "acts", **self.how)
            files |= {arm: made[name] for arm, name in names.items()}
        self.ends |= files
        return {policy.name: {rollout.name: self.judge(rollout, files[policy, rollout], answers[policy, rollout])
                              for rollout in rollouts} for policy in policies}  # fmt: skip

    def _look_again(
        self, going: list[Arm], number: int, files: dict[Arm, Path], answers: dict[Arm, list[PolicyAnswer]]
    ) -> None:
        """Put the look and the answer in place that most questions agree in, where a policy looks again if few do."""
        first = {arm: files[arm] for arm in going}
        for again in range(1, max(policy.looks for policy, _ in going)):
            unsure = [arm for arm in going if arm[0].looks > again and answers[arm][-1].share < AGREES]
            names = {arm: f"{arm[0].name}-{arm[1].name}-{number}-look{again}" for arm in unsure}
            made = run_jobs({names[arm]: look_job(first[arm], again) for arm in unsure}, self.folder / "acts",
                            **self.how)  # fmt: skip
            for arm in unsure:
                file = made[names[arm]]
                answer = self._answer(*arm, number, file, answers[arm][:-1], again=again)
                if answer.share > answers[arm][-1].share:
                    files[arm], answers[arm][-1] = file, answer

    def list_pictures(
        self, policies: list[Policy], rollouts: Mapping[str, Rollout], starts: dict[Rollout, Path],
        found: Mapping[str, Mapping[str, Mapping[str, Any]]],
    ) -> dict[str, dict[str, np.ndarray]]:  # fmt: skip
        """{task's label: {what is seen: picture}} of a rollout of each task: demonstration, start, policies' ends.

        ``found`` is as `roll` gives it: the ends are framed by whether they are a success.
        """
        rows = {}
        for task in (task for task in TASKS.values() if task.name in rollouts):
            shown, rollout = self.demonstrated[task.name], rollouts[task.name]
            row = {"demonstrated": shown[0].image, "its end": shown[-1].image,
                   "found": read_state(starts[rollout]).image}  # fmt: skip
            for policy in (policy for policy in policies if policy.looks == 1):  # looking again mostly changes nothing
                success = found[policy.name][rollout.name]["success"]
                row[policy.label] = mark_success(read_state(self.ends[policy, rollout]).image, success)
            rows[task.label] = row
        return rows

    def list_slides(self, policy: Policy, rollouts: Mapping[str, Rollout]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of a rollout of each task, look by look and at its end: the demonstration's picture and the policy's."""
        slides = []
        for task in (task for task in TASKS.values() if task.name in rollouts):
            shown, arm = self.demonstrated[task.name], (policy, rollouts[task.name])
            for look, (file, answer) in zip(self.make_demonstration(task).looks, self.acted[arm], strict=True):
                slides.append((mark_moves(look.image, look.moves), mark_moves(read_state(file).image, answer.moves)))
            slides.append((shown[-1].image, read_state(self.ends[arm]).image))
        return slides

    def _answer(
        self, policy: Policy, rollout: Rollout, number: int, file: Path, before: list[PolicyAnswer], *, again: int = 0
    ) -> PolicyAnswer:
        """The moves (px) of one look, kept as a file; asked anew where the state or the policy is another."""
        state, task = read_state(file), find_task(rollout.task)
        look = f"-look{again}" if again else ""
        place = self.folder / "answers" / f"{policy.name}-{rollout.name}-{number}{look}.json"
        mark = {"state": state.about["mark"], "policy": digest_policy(policy, task.object)}
        kept = read_kept(place, mark)
        if kept is None:
            answer = self._ask(policy, rollout, number, state, before[0].motion if before else None)
            parts = answer.motion and (answer.motion.factor, answer.motion.shift)
            motion = parts and [[value.real, value.imag] for value in parts]
            kept = {"mark": mark, "moves": answer.moves.tolist(), "motion": motion, "share": answer.share}
            write_json(place, kept)
        motion = kept["motion"] and Motion(*(complex(*pair) for pair in kept["motion"]))
        return PolicyAnswer(np.array(kept["moves"], float).reshape(-1, 2, 2), motion, kept["share"])

    def _ask(self, policy: Policy, rollout: Rollout, number: int, state: State, motion: Motion | None) -> PolicyAnswer:
        task = find_task(rollout.task)
        shown = self.demonstrated[task.name]
        look = self.make_demonstration(task).looks[number]
        if policy.name == "truth":
            return PolicyAnswer(np.array(true_moves(task.looks[number], shown[0].points, state)), None, 1.0)
        if policy.name == "random":
            return PolicyAnswer(draw_moves(look, state.mask, np.random.default_rng([rollout.seed, number])), None, 1.0)
        match = ask(policy, task.object, look, state.image, state.mask)
        answer = choose_moves(look, match, policy.chosen, lambda xy: find_on_table(xy, shown[number]),
                              lambda xy: find_on_table(xy, state), motion=motion)  # fmt: skip
        moves = answer.moves.reshape(-1, 2)
        pixels = state.project(np.column_stack([moves, np.zeros(len(moves))])) if len(moves) else moves
        return PolicyAnswer(pixels.reshape(-1, 2, 2), answer.motion, answer.share)

    def judge(self, rollout: Rollout, file: Path, answers: list[PolicyAnswer]) -> dict[str, Any]:
        """How a rollout ended, in the state of a file, and the least share of questions that agreed in an answer."""
        state, task = read_state(file), find_task(rollout.task)
        group = load_group(task.object, DEFAULT_GROUP[task.object]).permutations
        end, side = self.demonstrated[task.name][-1].points, SIDES_M[task.object]
        outcome = measure_outcome(state.points.astype(float), end.astype(float), group, task.object)
        failed = bool(state.about["fault"])
        return {"task": task.name, "error": outcome.error_m / side, "overlap": outcome.overlap,
                "success": not failed and outcome.error_m < SUCCESS * side, "fault": state.about["fault"],
                "share": min([1.0, *(answer.share for answer in answers)])}  # fmt: skip


def choose_shown(rollouts: list[Rollout], ended: Mapping[str, Mapping[str, Any]]) -> dict[str, Rollout]:
    """{task: the rollout that is drawn}, by rule: of each task the one with the median error where it ``ended``."""
    tasks: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        tasks.setdefault(rollout.task, []).append(rollout)
    for found in tasks.values():
        found.sort(key=lambda rollout: ended[rollout.name]["error"] if rollout.name in ended else 0.0)
    return {task: found[len(found) // 2] for task, found in tasks.items()}


def find_on_table(xy: np.ndarray, state: State) -> np.ndarray:
    """Where (…, 2) m on the table pixels (…, 2) of a state's image lie; NaN stays NaN."""
    rays = compute_rays(xy, state.intrinsics) @ state.camera_pose[:3, :3].T
    eye = state.camera_pose[:3, 3]
    return eye[:2] - rays[..., :2] * (eye[2] / rays[..., 2:])


def summarise_rollouts(rows: dict[str, dict[str, Any]], reachable: set[str]) -> dict[str, Any]:
    """Errors (share of the side), overlap and success of all rollouts, of those ``reachable``, by task; caution.

    "cautious": success of those where at least `AGREES` of the questions agree, and how many these are.
    """
    groups = {"all": list(rows.values()), "reachable": [row for name, row in rows.items() if name in reachable]}
    groups |= {task: [row for row in rows.values() if row["task"] == task] for task in TASKS}
    said = {
        name: {key: estimate_mean([min(row[key], 1.0) for row in found]) for key in ("error", "overlap")}
        | {"success": estimate_share([row["success"] for row in found])}
        for name, found in groups.items()
        if found
    }
    sure = [row["success"] for name, row in rows.items() if row["share"] >= AGREES and name in reachable]
    each = {name: [round(min(row["error"], 1.0), 4), bool(row["success"])] for name, row in rows.items()}
    faults = sum(bool(row["fault"]) for row in rows.values())
    return {**said, "cautious": estimate_share(sure), "faults": faults, "rollouts": each}


def summarise_policies(
    stored: Mapping[str, Any], found: Mapping[str, dict[str, dict[str, Any]]]
) -> dict[str, dict[str, Any]]:
    """Rows of the policies whose rollouts were ``found`` to end so, and of others that are ``stored``, in their order.

    Rollouts count that the true matches succeed in, and that are no success where "nothing" is done.
    """
    reachable = find_reachable(found)
    rows = {**stored, **{name: summarise_rollouts(ended, reachable) for name, ended in found.items()}}
    if REFERENCE in rows:
        for row in rows.values():
            row["beyond"] = compare_rollouts(rows[REFERENCE]["rollouts"], row["rollouts"], reachable)
    return {name: rows[name] for name in POLICIES if name in rows}


def find_reachable(found: Mapping[str, dict[str, dict[str, Any]]]) -> set[str]:
    """Names of the rollouts that count: the true matches succeed in them, and doing "nothing" does not."""
    done = {name for name, row in found["nothing"].items() if row["success"]}
    return {name for name, row in found.get("truth", {}).items() if row["success"]} - done


def measure_success(
    bench: Bench, policies: Iterable[Policy], rollouts: Iterable[Rollout]
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """{policy: share of successes with its interval} over those of some rollouts that count."""
    starts = bench.make_starts(list(rollouts))
    kept = [rollout for rollout in starts if not read_state(starts[rollout]).about["fault"]]
    found = bench.roll([POLICIES["truth"], *policies], kept, starts)
    untouched = {rollout.name: bench.judge(rollout, starts[rollout], []) for rollout in kept}
    reachable = find_reachable({"nothing": untouched} | found)
    return {name: estimate_share([row["success"] for key, row in ended.items() if key in reachable])
            for name, ended in found.items()}  # fmt: skip


def read_kept(path: Path, mark: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a file keeps of the question with this ``mark``, or None; a damaged file is set aside."""
    return read_json(path) if is_kept(path, lambda file: read_json(file).get("mark") == mark) else None


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
    found, counted = (rows.get(key, row)["reachable"]["success"] for key in (name, "truth"))
    fewer = f" of {found['count']}" if found["count"] != counted["count"] else ""  # it had not all of the rollouts
    success = say_share(found) + fewer
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
    said = [f"{object.capitalize()}: {_say_object(results['policies'][object])}." for object in OBJECTS]
    return " ".join(said)


def _say_object(rows: Mapping[str, Any]) -> str:
    truth = rows["truth"]
    counted = truth["reachable"]["success"]["count"] if "reachable" in truth else 0
    said = f"{counted} of {truth['all']['success']['count']} rollouts count"
    sure = get(rows, "mmgsd", "cautious") or {"count": 0}
    if 0 < sure["count"] < counted:  # else caution leaves all of them, or none
        said += f"; MMGSD succeeds in {100 * sure['mean']:.0f} % of the {sure['count']} whose modes agree most"
    return said


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


def shorten(folder: Path, found: Results) -> dict[str, Any]:
    """{object: {policy: its measures where rollouts count, and ``beyond`` MMGSD's}} in place of all rollouts."""
    return {"folding": {object: {name: {**row["reachable"], "beyond": row["beyond"]} for name, row in policies.items()
                                 if "reachable" in row and "beyond" in row}
                        for object, policies in found["folding"]["policies"].items()}} if found else {}  # fmt: skip


def judge_several(results: Results) -> Claim:
    """A robot takes the surest where several places are grasped at once: each may be a match of another turn."""
    low = {name: get(results, "folding", name, "mmgsd_best", "beyond", "error", "low") for name in OBJECTS}
    parts = tuple(None if low[name] is None else low[name] <= 0 for name in OBJECTS)
    ways = {"modes that agree": "mmgsd", "surest joint answer": "mmgsd_joint", "each pixel's surest": "mmgsd_best"}
    shown = []
    for name in OBJECTS:
        successes = {way: get(results, "folding", name, policy, "success", "mean") for way, policy in ways.items()}
        shown.append(f"{name}: {list_shares(successes)}")
    return Claim(
        "several", "Our question: may each of several picks take its own surest match?",
        "Folding by each pixel's surest mode ends no farther off than by modes that agree, as far as the 95 % interval "
        "of the difference tells; a part each object.", f"successes, {'; '.join(shown)}", parts,
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
            said = get(rows, object, name, "reachable", "success")
            if said:
                mean, low, high = (100 * said[key] for key in ("mean", "low", "high"))
                axis.errorbar(mean, place, xerr=[[mean - low], [high - mean]], fmt="o", ms=4, capsize=2,
                              color=POLICIES[name].colour)  # fmt: skip
                if said["count"] != counted:
                    axis.annotate(f"of {said['count']}", (high, place), xytext=(5, 0), textcoords="offset points",
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
    asked = [policy for policy in POLICIES.values() if policy.trained] if trained else SHIPPED
    policies = [POLICIES["truth"], *(p for p in asked if only in p.name and p.name != "truth")]
    if not any(only in policy.name for policy in asked):
        names = ", ".join(policy.name for policy in asked)
        raise ValueError(f"--only {only!r}: no policy has a name with that; there are {names}")
    print(run(Paths(find_root(), preset), policies=policies, **how))
