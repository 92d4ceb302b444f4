"""Weights that go on with a user's own photographs: `mmgsd.adapt`, or ``python -m mmgsd adapt``.

Marked photographs teach matches between pictures, all of them that a picture and its copy among other things, in other
colours and bent, match where the weights were sure before (`mmgsd.learn.photographs`); sample renders, in the same
batches, keep what was known. The marked ones are left out in parts by turns: what the others teach is measured on them,
which says after how many steps to stop, and what it does.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch

from mmgsd import files
from mmgsd.checks import check, read_count, read_flag
from mmgsd.config import CONTRASTIVE, MATCHES_OF_ONE
from mmgsd.dataset import Dataset, join_datasets, load_dataset
from mmgsd.learn.augmentation import load_training_images, make_batch
from mmgsd.learn.checkpoints import CHECKPOINT
from mmgsd.learn.distributed import World
from mmgsd.learn.objective import compute_head_loss, compute_loss, compute_place_loss
from mmgsd.learn.photographs import add_points, join_batches, prepare_photographs, take
from mmgsd.learn.training import Run, repeatable
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.measure import photographs as measured
from mmgsd.measure.calibration import calibrate_modes, describe_places
from mmgsd.measure.photographs import Photograph
from mmgsd.measure.questions import measure_rmse
from mmgsd.model.network import find_device, name_hardware
from mmgsd.model.tensors import load_metadata, read_tensors, write_tensors
from mmgsd.model.weights import PLACES
from mmgsd.numerics import own_numerics
from mmgsd.paths import find_sample_sets
from mmgsd.progress import ProgressBar

STEPS, FOLDS = 120, 3
STOPS = 4  # numbers of steps, evenly spaced, of which the best is taken
DRAWN, RENDERS = 4, 8  # photographs of a step, each as it is and among other things, and renders
RATE = 3e-4  # learning rate: less than a third of the training's
GROWTH = 0.1  # of the error on renders, above which a number of steps is not taken, whatever is found
SIGMA_PX = 4.0  # std of the targets: marks by hand are no better
SPAN = 16  # steps that the average of weights spans
CALIBRATED = 100  # pairs of test renders that the calibration is read from
QUESTIONS = {"pairs": 24, "points": 25}  # about the test renders
ASKED, RESULT = "asked.json", "after-{}.json"  # the latter: what was found of a part left out after so many steps

CARD = """# {name}

`{source}` gone on with photographs of one's own; `mmgsd.load("{name}")`.

| | |
|---|---|
| learnt from | {photographs} photographs, {marked} of them with {marks} marks, and {renders} renders |
| training | {taken} of {steps} steps, seed {seed}, {minutes:.1f} minutes on {hardware} |

| | before | after | change |
|---|---|---|---|
{rows}

{limits}
"""
MEASURED = """\
Photographs: means and 95 % intervals, of each marked photograph by weights that had not learnt from it: they were left
out in {folds} parts by turns, and the number of steps was chosen by the other parts: where these choose none, nothing
changes. The weights here learnt from all of them, by as many steps as all parts together choose."""
NOT_MEASURED = "What it does in photographs is not measured: no marked ones were left out, of which it takes two."
UNCHANGED = "None of the numbers of steps found more in photographs left out: the weights are as they were."
LABELS = {"picture": "asked by another picture", "name": "by name"}


@own_numerics(gradients=True)
def adapt(
    folder: Path | str, weights: Path | str = "cloth", out: Path | str = "adapted.safetensors", *,
    renders: Path | str | None = None, steps: int = STEPS, folds: int = FOLDS, seed: int = 0, overwrite: bool = False,
    device: str = "", progress: bool = True,
) -> Path:  # fmt: skip
    """Go on from ``weights`` with the photographs of a folder; returns the path ``out`` of the new weights.

    ``folder`` holds photographs and an index.json as `mmgsd.measure.photographs` describes it, or is such a file;
    photographs without a mark, and images that it does not name, are learnt from as well. Those marked are left out in
    ``folds`` parts by turns, to measure and to stop by; with 0 all ``steps`` are taken, unmeasured. ``renders`` is a
    data set of the object, by default the sample's. A card of what was done lies beside the weights
    (`read_adaptation` has its numbers); the ``weights`` stay. What is finished is returned as it is; a killed call goes
    on from its last checkpoint and ends with the same weights (on a CPU).

    FileNotFoundError where there is no folder, no weights or no renders; ValueError for what cannot be learnt from (one
    photograph, marks outside it or off the object), for weights that were taught one match of several, and where
    ``out`` is of other photographs or settings; LockedError while another process works on it.
    """
    steps, folds, seed = read_count("steps", steps, least=STOPS), read_count("folds", folds), read_count("seed", seed)
    check("folds", folds, "0 or at least 2", folds != 1)
    overwrite, progress, out = read_flag("overwrite", overwrite), read_flag("progress", progress), Path(out)
    source = find_weights(weights)
    start = Matcher.load(source, device=find_device(device))
    all_matches = start.config.method not in MATCHES_OF_ONE
    check("weights", start.config.method, "of a method that is taught all matches", all_matches)
    kind = start.object or start.config.object
    photographs = measured.read_all_photographs(folder, kind)
    if len(photographs) < 2:  # nothing that is learnt from a single one need hold in another
        raise ValueError(f"folder must hold at least two photographs of kind {kind!r}, got {len(photographs)}")
    provenance = _describe_provenance(source, photographs, renders, steps=steps, folds=folds, seed=seed)
    if not overwrite and _is_finished(out, provenance, source):
        return out
    work = out.with_name(f"{out.stem}.adapting")
    with files.locked(work, "adapting"), repeatable(start.device):
        job = _Job(start, photographs, _load_renders(kind, renders), work, provenance, progress)
        if (work / ASKED).is_file() and files.read_json(work / ASKED) != provenance:
            files.remove_folder(work, _is_ours)
        files.write_json(work / ASKED, provenance)
        with files.saying_what_stays(lambda: f"what was learnt is kept in {work}: the same call goes on"):
            results = job.measure()
            job.finish(out, source, results)
        files.remove_folder(work, _is_ours)
    return out


def read_adaptation(weights: Path | str) -> dict[str, Any]:
    """What `adapt` did to weights, as in their card; ValueError of weights that it did not make."""
    note = load_metadata(weights)
    if "adapted" not in note:
        raise ValueError(f"weights must be such as mmgsd.adapt writes, got {weights}, which say nothing of photographs")
    return json.loads(note["adapted"])


def _describe_provenance(
    source: Path, photographs: Sequence[Photograph], renders: Any, **settings: int
) -> dict[str, Any]:
    """What decides the result: the same asked again is not done again."""
    pixels = hashlib.sha256()
    for photograph in photographs:
        pixels.update(photograph.path.read_bytes())
    marks = {"marks_digest": measured.digest_marks(list(photographs)), "files_digest": pixels.hexdigest()[:16]}
    weights = {"source": source.name, "sha256": hashlib.sha256(source.read_bytes()).hexdigest()}
    return {**weights, **marks, **settings, **({"renders": str(renders)} if renders else {})}


def _is_finished(out: Path, provenance: dict[str, Any], source: Path) -> bool:
    """Whether ``out`` holds what is asked for; ValueError where it holds anything else."""
    card = out.with_suffix(".md")
    check("out", str(out), "a path that ends with .safetensors, and not the weights to go on from",
          out.suffix == ".safetensors" and out.resolve() != source.resolve())  # fmt: skip
    if card.is_file() and not card.read_text("utf-8", "replace").startswith(f"# {out.name}\n"):
        raise files.ForeignFileError(f"{card} is no card of {out.name}: move it away, or choose another name")
    if not out.is_file():
        return False
    if json.loads(load_metadata(out).get("adapted", "{}")).get("asked") != provenance:
        raise ValueError(f"{out} was made of other photographs, weights or settings: choose another out, or "
                         "overwrite=True")  # fmt: skip
    return True


def _is_ours(path: Path) -> bool:
    return path.suffix == ".json" or path.name.startswith(CHECKPOINT) or bool(files.ASIDE.fullmatch(path.name))


def _load_renders(kind: str, folder: Path | str | None) -> dict[str, Dataset]:
    """The renders to learn from, "train", and to ask about, "test"; FileNotFoundError where there are none."""
    places = find_sample_sets(kind) if folder is None else [Path(folder)]
    if not places:
        raise FileNotFoundError(f"renders must be a data set of {kind!r}: without some of them what the weights know "
                                "would be lost, and the sample has none")  # fmt: skip
    return {split: join_datasets(*(load_dataset(place, split) for place in places)) for split in ("train", "test")}


class Found(NamedTuple):
    """What weights find after a number of steps that did not learn from the photographs asked about."""

    rows: pd.DataFrame  # of `ask_left_out`
    rmse_px: float  # on renders


class _Job:
    """One call of `adapt`: its materials, and the folder ``work`` where it keeps what is done of it."""

    def __init__(
        self, start: Matcher, photographs: list[Photograph], renders: dict[str, Dataset], work: Path,
        provenance: dict[str, Any], progress: bool,
    ) -> None:  # fmt: skip
        self.start, self.photographs, self.renders = start, photographs, renders
        self.work, self.provenance, self.progress = work, provenance, progress
        train, config = renders["train"], start.config
        self.own, self.permutations = prepare_photographs(photographs, start, train.group(config.group))
        self.render_images = add_points(load_training_images(train, config.input_px), self.permutations.shape[1])
        if start.places is None or len(start.places) != train.n_points:
            start.places = describe_places(start, train)
        self.marked = [k for k, photograph in enumerate(photographs) if len(photograph.xy)]
        parts, steps = min(provenance["folds"], len(self.marked)), provenance["steps"]
        self.parts = parts if parts > 1 else 0
        self.stops = [round(steps * k / STOPS) for k in range(STOPS + 1)]
        self.config = dataclasses.replace(
            config, steps=steps, seed=provenance["seed"], learning_rate=RATE, optimiser="adamw", schedule="cosine",
            groups=1, sigma_px=SIGMA_PX, sigma_start_px=SIGMA_PX, augment=True, strong=False,  # own textures stay
        )  # fmt: skip

    def measure(self) -> list[dict[int, Found]]:
        """Of each part that is left out, what is found in it after each number of steps; [] where none is."""
        if not self.parts:
            return []
        order = np.random.default_rng(self.provenance["seed"]).permutation(self.marked)
        parts = np.array_split(order, self.parts)
        return [self._measure_part(number, sorted(part)) for number, part in enumerate(parts)]

    def _measure_part(self, number: int, left_out: list[int]) -> dict[int, Found]:
        chosen = [k for k in range(len(self.photographs)) if k not in left_out]
        folder = self.work / f"part{number}"
        sources, targets = ([self.photographs[k] for k in ks if k in self.marked] for ks in (chosen, left_out))
        results = {stop: folder / RESULT.format(stop) for stop in self.stops}
        if not results[self.stops[-1]].is_file():
            run = _Adaptation(self, chosen, folder)
            run.resume()
            for stop, file in results.items():
                self.advance(run, stop, f"adapt, without part {number + 1} of {self.parts}")
                if not file.is_file():
                    matcher = run.make_matcher()
                    rows = ask_left_out(matcher, sources, targets).to_dict("records")
                    rmse_px = measure_rmse(matcher, self.renders["test"], **QUESTIONS)
                    files.write_json(file, {"rows": rows, "rmse_px": rmse_px}, indent=None)
        records = {stop: files.read_json(file) for stop, file in results.items()}
        return {stop: Found(pd.DataFrame(values["rows"]), values["rmse_px"]) for stop, values in records.items()}

    def advance(self, run: _Adaptation, stop: int, name: str) -> None:
        """Take the steps that are left to ``stop``."""
        options = {"initial": run.step, "total": self.stops[-1], "disable": not self.progress, "leave": False}
        bar = ProgressBar(range(run.step, stop), desc=name, **options)
        for _ in bar:
            bar.set_postfix(loss=f"{run.advance():.3f}", refresh=False)

    def finish(self, out: Path, source: Path, results: list[dict[int, Found]]) -> None:
        """Learn from all photographs, calibrate, and write card and weights, the weights last."""
        taken = choose_stop(results) if results else self.stops[-1]
        run = _Adaptation(self, list(range(len(self.photographs))), self.work / "all")
        run.resume()
        self.advance(run, taken, "adapt")
        run.save()  # what fails below costs no step
        matcher, data = run.make_matcher() if taken else copy.copy(self.start), self.renders["test"]
        rmse = {name: round(measure_rmse(m, data, **QUESTIONS), 2) for name, m in (("before", self.start),
                                                                                   ("after", matcher))}  # fmt: skip
        tensors, note = read_tensors(source)
        if taken:
            calibration = calibrate_modes(matcher, data, pairs=CALIBRATED)
            note |= {} if calibration is None else {"calibration": calibration.to_json()}
            new = {**matcher.network.state_dict(), PLACES: matcher.places}
            tensors = {name: value.detach().cpu().to(tensors.get(name, value).dtype) for name, value in new.items()}
        summary = {
            "asked": self.provenance, "photographs": len(self.photographs), "marked": len(self.marked),
            "marks": sum(len(photograph.xy) for photograph in self.photographs),
            "renders": len(self.renders["train"]), "steps": taken, "rmse_px": rmse, "folds": len(results),
            "found": summarise_change(results), "seconds": round(run.seconds, 1),
            "hardware": name_hardware(self.start.device),
        }  # fmt: skip
        files.write_text(out.with_suffix(".md"), make_card(out.name, summary))
        write_tensors(out, tensors, note | {"adapted": json.dumps(summary)})


class _Adaptation(Run):
    """Steps on some of the photographs of a job, and on its renders."""

    frozen_statistics = True  # a few photographs have none of their own
    validate_every = 0

    def __init__(self, job: _Job, chosen: list[int], folder: Path) -> None:
        self.job, self.chosen, self.folder, self.config = job, chosen, folder, job.config
        self.device, self.size = job.start.device, job.start.size
        self.world = World(self.device, (0,))
        self.permutations = torch.tensor(job.permutations, device=self.device)
        self.own = take(job.own, chosen)
        marked = np.isin(chosen, job.marked)  # the two kinds are drawn as often as each other
        share = np.where(marked, 1 / max(1, marked.sum()), 1 / max(1, (~marked).sum()))
        self.share = share / share.sum()
        network = copy.deepcopy(job.start.network)
        if network.trunk is not None:  # half of a step's time, and what few photographs would spoil
            network.trunk.requires_grad_(False)
        self.start(network, job.start.places.clone(), span=SPAN)
        self.average.update_parameters(self.network)  # what was known is a part of it

    def learn(self, group: int) -> float:
        """Add the gradients of one step's batch; returns its loss."""
        seed, count, job = (self.config.seed, self.step, group), len(self.chosen), self.job
        rng = np.random.default_rng(seed)
        drawn = rng.choice(count, DRAWN, count < DRAWN, p=self.share)
        renders = job.render_images
        drawn_renders = rng.choice(len(renders.images), RENDERS, len(renders.images) < RENDERS)
        cluttered = dataclasses.replace(self.config, clutter=job.start.config.heads)  # by masks, which it then tells
        plain = dataclasses.replace(self.config, clutter=False)
        parts = ((self.own, drawn, plain), (self.own, drawn, cluttered), (renders, drawn_renders, self.config))
        batch = join_batches([make_batch(*part, rng, self.device) for part in parts])
        outputs = self.network.describe(batch.image.contiguous(memory_format=torch.channels_last))
        loss = compute_loss(self.config, outputs.descriptors, batch, self.permutations, self.size, self.step)
        if self.config.method not in CONTRASTIVE:
            loss = loss + compute_place_loss(self.config, outputs.descriptors, batch, self.tie_places(),
                                             self.permutations, self.size, self.step)  # fmt: skip
        if self.config.heads:
            seeds = torch.Generator(self.device).manual_seed(-1 - self.config.seed * 1_000_003 - self.step)
            loss = loss + compute_head_loss(self.network.heads, outputs, batch, self.permutations, self.size, seeds)
        loss.backward()
        return loss.item()

    def tie_places(self) -> torch.Tensor:
        """(P, D) what the object's material points are described as; those that look alike have one mean."""
        return self.prototypes[self.permutations[:, : len(self.prototypes)]].mean(0)

    def make_matcher(self) -> Matcher:
        """The matcher that was gone on from, with the averaged weights."""
        matcher = copy.copy(self.job.start)
        matcher.network = self.average.module.eval()
        matcher.places = self.tie_places().detach()
        return matcher

    def _describe_config(self) -> str:
        return json.dumps([self.job.provenance, dataclasses.asdict(self.config), self.chosen], sort_keys=True)


def ask_left_out(matcher: Matcher, sources: list[Photograph], targets: list[Photograph]) -> pd.DataFrame:
    """A row a query about the targets, "by" a "picture" of the sources or by "name"."""
    answers = measured.ask_photographs(matcher, sources, targets=targets, progress=False)
    tables = [measured.score_answer(answer, photograph).assign(by="picture") for photograph, answer in answers]
    tables += [table.assign(by="name") for table in measured.ask_by_name(matcher, targets)]
    return pd.concat(tables, ignore_index=True)


def choose_stop(results: Sequence[dict[int, Found]]) -> int:
    """The number of steps after which most is found at 5 % less what is spurious; the least of several.

    ``results`` {steps: what is found} of each part that was left out: all photographs weigh the same. Numbers after
    which the error on renders has grown by more than `GROWTH` are left out.
    """
    errors = {stop: np.mean([part[stop].rmse_px for part in results]) for stop in results[0]}
    scores = {}
    for stop in (stop for stop, error in errors.items() if error <= (1 + GROWTH) * errors[0]):
        rows = pd.concat([part[stop].rows for part in results])
        means = rows.groupby(["by", "file"])[["found@5%", "spurious"]].mean()
        scores[stop] = float((means["found@5%"] - means["spurious"]).groupby("by").mean().mean())
    return max(scores, key=lambda stop: (scores[stop], -stop))


def summarise_change(results: Sequence[dict[int, Found]]) -> dict[str, Any]:
    """{by: {"before", "after": means and intervals, "change": its intervals}}; {} where nothing was left out.

    "After" is after as many steps as the other parts choose: the number is not chosen by what it is measured on.
    """
    if not results:
        return {}
    stops = [choose_stop([other for other in results if other is not part]) for part in results]
    before = pd.concat([part[0].rows for part in results], ignore_index=True)
    after = pd.concat([part[stop].rows for part, stop in zip(results, stops, strict=True)], ignore_index=True)
    change = after.assign(**{name: after[name] - before[name] for name in measured.MEASURES})
    summary, keys, tables = {}, (*measured.MEASURES, "queries", "intervals"), {"before": before, "after": after}
    for by in before["by"].unique():
        rows = {name: measured.summarise_photographs(table[table["by"] == by]) for name, table in tables.items()}
        selected = {name: {key: row[key] for key in keys} for name, row in rows.items()}
        summary[str(by)] = {**selected, "change": measured.estimate_intervals(change[change["by"] == by])}
    return summary


def make_card(name: str, summary: dict[str, Any]) -> str:
    """Markdown that says what `adapt` did."""
    lines = []
    for by, rows in summary["found"].items():
        for key, label in (("found@5%", "found within 5 % of the size"), ("spurious", "spurious")):
            cells = [_format_share(rows[when][key], rows[when]["intervals"][key]) for when in ("before", "after")]
            change = _format_share(rows["after"][key] - rows["before"][key], rows["change"][key], "+.0f")
            lines.append(f"| photographs, {LABELS[by]}: {label} | {' | '.join(cells)} | {change} |")
    before, after = summary["rmse_px"]["before"], summary["rmse_px"]["after"]
    lines.append(f"| renders of the sample: RMSE | {before:.1f} px | {after:.1f} px | {after / before - 1:+.0%} |")
    limits = MEASURED.format(folds=summary["folds"]) if summary["found"] else NOT_MEASURED
    limits = limits if summary["steps"] else f"{UNCHANGED}\n{limits}"
    fields = {"name": name, "rows": "\n".join(lines), "limits": limits, "minutes": summary["seconds"] / 60}
    fields |= {"taken": summary["steps"], "steps": summary["asked"]["steps"]}
    return CARD.format(**summary["asked"] | summary | fields)


def _format_share(value: float, interval: Sequence[float] | None, form: str = ".0f") -> str:
    low, high = (100 * end for end in interval or (np.nan, np.nan))
    return f"{100 * value:{form}} % ({low:{form}} to {high:{form}})"
