"""Rollouts of policies from the same first states, step by step, as files; what came of each, and of all.

All go in step: first states, every policy's answers, what physics makes of them, the next look. What is there already
is kept, so that a killed run goes on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.config import DEFAULT_GROUP
from mmgsd.figures.folding import mark_moves, mark_success
from mmgsd.files import is_kept, read_json, write_json
from mmgsd.fold.consensus import Motion
from mmgsd.fold.demonstration import Demonstration, Look
from mmgsd.fold.jobs import act_job, demonstration_job, look_job, run_jobs, start_job, true_moves
from mmgsd.fold.measures import SIDES_M, SUCCESS, compare_rollouts, estimate_mean, estimate_share, measure_outcome
from mmgsd.fold.moves import PolicyAnswer, choose_moves
from mmgsd.fold.state import State, read_state
from mmgsd.fold.tasks import GROUNDS, TASKS, Task, find_task
from mmgsd.match.camera import compute_rays
from mmgsd.progress import ProgressBar
from mmgsd.studies.policies import POLICIES, Policy, ask, digest_policy, draw_moves
from mmgsd.symmetry import load_group

MORE = ("wrinkled", 0.4)  # a start of which few rollouts count, and how many more begin from it, of the count
REFERENCE = "mmgsd"  # the policy that the others are compared with, rollout by rollout
AGREES = 0.7  # share of the questions that agree from which a cautious robot acts
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
            new_files = run_jobs(jobs, self.folder / "acts", **self.how)
            files |= {arm: new_files[name] for arm, name in names.items()}
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
            look_files = run_jobs({names[arm]: look_job(first[arm], again) for arm in unsure}, self.folder / "acts",
                                  **self.how)  # fmt: skip
            for arm in unsure:
                file = look_files[names[arm]]
                answer = self._answer(*arm, number, file, answers[arm][:-1], again=again)
                if answer.share > answers[arm][-1].share:
                    files[arm], answers[arm][-1] = file, answer

    def list_pictures(
        self, policies: list[Policy], rollouts: Mapping[str, Rollout], starts: dict[Rollout, Path],
        outcomes: Mapping[str, Mapping[str, Mapping[str, Any]]],
    ) -> dict[str, dict[str, np.ndarray]]:  # fmt: skip
        """{task's label: {what is seen: picture}} of a rollout of each task: demonstration, start, policies' ends.

        ``outcomes`` are as `roll` gives them: the ends are framed by whether they are a success.
        """
        rows = {}
        for task in (task for task in TASKS.values() if task.name in rollouts):
            demo_states, rollout = self.demonstrated[task.name], rollouts[task.name]
            row = {"demonstrated": demo_states[0].image, "its end": demo_states[-1].image,
                   "found": read_state(starts[rollout]).image}  # fmt: skip
            for policy in (policy for policy in policies if policy.looks == 1):  # looking again mostly changes nothing
                success = outcomes[policy.name][rollout.name]["success"]
                row[policy.label] = mark_success(read_state(self.ends[policy, rollout]).image, success)
            rows[task.label] = row
        return rows

    def list_slides(self, policy: Policy, rollouts: Mapping[str, Rollout]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of a rollout of each task, look by look and at its end: the demonstration's picture and the policy's."""
        slides = []
        for task in (task for task in TASKS.values() if task.name in rollouts):
            demo_states, arm = self.demonstrated[task.name], (policy, rollouts[task.name])
            for look, (file, answer) in zip(self.make_demonstration(task).looks, self.acted[arm], strict=True):
                slides.append((mark_moves(look.image, look.moves), mark_moves(read_state(file).image, answer.moves)))
            slides.append((demo_states[-1].image, read_state(self.ends[arm]).image))
        return slides

    def _answer(
        self, policy: Policy, rollout: Rollout, number: int, file: Path, before: list[PolicyAnswer], *, again: int = 0
    ) -> PolicyAnswer:
        """The moves (px) of one look, kept as a file; asked anew where the state or the policy is another."""
        state, task = read_state(file), find_task(rollout.task)
        look = f"-look{again}" if again else ""
        place = self.folder / "answers" / f"{policy.name}-{rollout.name}-{number}{look}.json"
        mark = {"state": state.about["mark"], "policy": digest_policy(policy, task.object)}
        stored = read_kept(place, mark)
        if stored is None:
            answer = self._ask(policy, rollout, number, state, before[0].motion if before else None)
            parts = answer.motion and (answer.motion.factor, answer.motion.shift)
            motion = parts and [[value.real, value.imag] for value in parts]
            stored = {"mark": mark, "moves": answer.moves.tolist(), "motion": motion, "share": answer.share}
            write_json(place, stored)
        motion = stored["motion"] and Motion(*(complex(*pair) for pair in stored["motion"]))
        return PolicyAnswer(np.array(stored["moves"], float).reshape(-1, 2, 2), motion, stored["share"])

    def _ask(self, policy: Policy, rollout: Rollout, number: int, state: State, motion: Motion | None) -> PolicyAnswer:
        task = find_task(rollout.task)
        demo_states = self.demonstrated[task.name]
        look = self.make_demonstration(task).looks[number]
        if policy.name == "truth":
            return PolicyAnswer(np.array(true_moves(task.looks[number], demo_states[0].points, state)), None, 1.0)
        if policy.name == "random":
            return PolicyAnswer(draw_moves(look, state.mask, np.random.default_rng([rollout.seed, number])), None, 1.0)
        match = ask(policy, task.object, look, state.image, state.mask)
        answer = choose_moves(look, match, policy.chosen, lambda xy: find_on_table(xy, demo_states[number]),
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
    for candidates in tasks.values():
        candidates.sort(key=lambda rollout: ended[rollout.name]["error"] if rollout.name in ended else 0.0)
    return {task: candidates[len(candidates) // 2] for task, candidates in tasks.items()}


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
    summary = {
        name: {key: estimate_mean([min(row[key], 1.0) for row in group]) for key in ("error", "overlap")}
        | {"success": estimate_share([row["success"] for row in group])}
        for name, group in groups.items()
        if group
    }
    sure = [row["success"] for name, row in rows.items() if row["share"] >= AGREES and name in reachable]
    each = {name: [round(min(row["error"], 1.0), 4), bool(row["success"])] for name, row in rows.items()}
    faults = sum(bool(row["fault"]) for row in rows.values())
    return {**summary, "cautious": estimate_share(sure), "faults": faults, "rollouts": each}


def summarise_policies(
    stored: Mapping[str, Any], outcomes: Mapping[str, dict[str, dict[str, Any]]]
) -> dict[str, dict[str, Any]]:
    """Rows of the policies whose rollouts had these ``outcomes``, and of others that are ``stored``, in their order.

    Rollouts count that the true matches succeed in, and that are no success where "nothing" is done.
    """
    reachable = find_reachable(outcomes)
    rows = {**stored, **{name: summarise_rollouts(ended, reachable) for name, ended in outcomes.items()}}
    if REFERENCE in rows:
        for row in rows.values():
            row["beyond"] = compare_rollouts(rows[REFERENCE]["rollouts"], row["rollouts"], reachable)
    return {name: rows[name] for name in POLICIES if name in rows}


def find_reachable(outcomes: Mapping[str, dict[str, dict[str, Any]]]) -> set[str]:
    """Names of the rollouts that count: the true matches succeed in them, and doing "nothing" does not."""
    done = {name for name, row in outcomes["nothing"].items() if row["success"]}
    return {name for name, row in outcomes.get("truth", {}).items() if row["success"]} - done


def measure_success(
    bench: Bench, policies: Iterable[Policy], rollouts: Iterable[Rollout]
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """{policy: share of successes with its interval} over those of some rollouts that count."""
    starts = bench.make_starts(list(rollouts))
    faultless = [rollout for rollout in starts if not read_state(starts[rollout]).about["fault"]]
    outcomes = bench.roll([POLICIES["truth"], *policies], faultless, starts)
    untouched = {rollout.name: bench.judge(rollout, starts[rollout], []) for rollout in faultless}
    reachable = find_reachable({"nothing": untouched} | outcomes)
    return {name: estimate_share([row["success"] for key, row in ended.items() if key in reachable])
            for name, ended in outcomes.items()}  # fmt: skip


def read_kept(path: Path, mark: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a file keeps of the question with this ``mark``, or None; a damaged file is set aside."""
    return read_json(path) if is_kept(path, lambda file: read_json(file).get("mark") == mark) else None
