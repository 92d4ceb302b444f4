"""The verdict on a run of the whole experiment: each of its numbers beside the stored one, and the files it changed.

What was stored is taken down when a run begins, for its stages write the same files, and stays until it is finished,
however often it is killed: ``data/generated/PRESET/notebooks/stored.json``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mmgsd.config import CONTRASTIVE
from mmgsd.files import DamagedFileError, is_kept, write_json, write_text
from mmgsd.paths import Paths
from mmgsd.report.stages import find_run
from mmgsd.studies.claims import get
from mmgsd.studies.models import UNTRAINED
from mmgsd.studies.registry import Measure, list_studies, read_table, told_where

DEVIATIONS = 3  # of the seeds: as far as another training of the same model may be
MINUTES = ("runs.json", "stages.json")  # hold minutes, which are others each time
EQUAL, AGREES, DIFFERS, MISSING, NEW, NOT_RUN = "equal", "agrees", "differs", "missing", "new", "not run here"
MAX_LISTED = 5  # differing numbers that the summary names
NO_MEANING = "Nothing is learnt in smoke, so its numbers mean nothing: they show only that every stage runs.\n"


@dataclass(frozen=True)
class Verdict:
    """``numbers``, a row each with its tolerance; ``files`` that are others than before; ``summary``, lines of text."""

    numbers: pd.DataFrame
    files: pd.DataFrame
    summary: str


def keep_stored(paths: Paths) -> None:
    """Take down what is stored, unless a run that was not finished has done so.

    After a finished run only files are taken anew that are not as it left them: they came from elsewhere.
    """
    state = load_stored(paths)
    if state["running"]:
        return
    digests = {name: digest for name, digest in digest_files(paths).items() if digest != state["after"].get(name)}
    tables = [name for name in digests if Path(name).suffix == ".json"]
    results = state["results"] | {Path(name).stem: read_table(paths.root / name) for name in tables}
    taken = {"running": True, "before": state["before"] | digests, "after": {}, "results": results}
    write_json(_find_stored(paths), taken)


def judge_run(paths: Paths) -> Verdict:
    """Compare a finished run with what was stored when it began, and keep the summary as verdict.txt."""
    state, now = load_stored(paths), digest_files(paths)
    measured = {path.stem: read_table(path) for path in sorted(paths.results.glob("*.json"))}
    with told_where(paths.results):
        numbers = compare_numbers(state["results"], measured, paths)
    files = compare_files(state["before"], now)
    hardware = [sorted({run["hardware"] for run in results.get("runs", {}).values()})
                for results in (state["results"], measured)]  # fmt: skip
    summary = summarise(numbers, files, hardware=hardware, meaningless=paths.preset == "smoke", stored=state["before"])
    write_text(find_run(paths) / "verdict.txt", summary)
    write_json(_find_stored(paths), {**state, "running": False, "after": now})
    return Verdict(numbers, files, summary)


def load_stored(paths: Paths) -> dict[str, Any]:
    """What was taken down: whether its run is ``running``, files' digests ``before`` and ``after``, and ``results``."""
    path, nothing = _find_stored(paths), {"running": False, "before": {}, "after": {}, "results": {}}

    def read(file: Path) -> dict[str, Any]:
        """What a file says; DamagedFileError where it lacks a part."""
        state = read_table(file)
        if not nothing.keys() <= state.keys():
            raise DamagedFileError(f"{file} lacks some of {', '.join(nothing)}")
        return state

    return read(path) if is_kept(path, read) else nothing


def digest_files(paths: Paths) -> dict[str, str]:
    """{path from the root: SHA-256} of a preset's results and figures."""
    figure_data = (paths.root / "figures" / "data").glob(f"{paths.preset}_*")
    outputs = [*paths.results.glob("*"), *paths.figures.glob("*"), *figure_data]
    files = sorted(path for path in outputs if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(paths.root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def list_measures() -> dict[str, Measure]:
    """{name: tolerance} of all that studies have compared; a name has one tolerance."""
    return {name: measure for study in list_studies() for name, measure in study.compared.items()}


def compare_numbers(stored: Mapping[str, Any], measured: Mapping[str, Any], paths: Paths) -> pd.DataFrame:
    """A row for each number of either {name of the results file: content}, and whether it agrees.

    A trained model's tolerance is 3 standard deviations of its seeds in the stored "seeds", or the object's largest
    where its own are not there, and no less than the floor of its `Measure`, which is that of untrained ones.
    """
    old, new = (dict(_list_numbers(results)) for results in (stored, measured))
    spreads, measures, rows = measure_spreads(stored.get("seeds", {})), list_measures(), {}
    for key in dict.fromkeys([*new, *old]):
        _, name, row, measure = key
        before, now = old.get(key), new.get(key)
        tolerance = np.nan if before is None else compute_tolerance(measures[measure], name, row, before, spreads)
        judged = _has_answers(measured, key, paths) or now is None
        agreement = judge_number(before, now, tolerance) if judged else NOT_RUN
        rows[key] = {"stored": before, "this run": now, "tolerance": tolerance, "agrees": agreement}
    index = pd.MultiIndex.from_tuples(rows, names=["table", "object", "row", "measure"]) if rows else None
    table = pd.DataFrame(list(rows.values()), index, ["stored", "this run", "tolerance", "agrees"])
    return table.astype({"stored": float, "this run": float, "tolerance": float})


def judge_number(stored: float | None, measured: float | None, tolerance: float) -> str:
    """The word for a number of this run beside the stored one; None where there is none."""
    if stored is None or measured is None:
        return NEW if stored is None else MISSING
    if np.array_equal(stored, measured, equal_nan=True):
        return EQUAL
    return AGREES if abs(measured - stored) <= tolerance else DIFFERS


def measure_spreads(seeds: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> dict[tuple[str, str, str], float]:
    """{(object, method, measure): std over the seeds}, from {object: {"mmgsd-0": errors}}; none of a single seed."""
    compared = {measure.like for measure in list_measures().values()}
    rows = [(name, key.rpartition("-")[0], measure, value) for name, keyed in seeds.items()
            for key, row in keyed.items() for measure, value in row.items() if measure in compared]  # fmt: skip
    table = pd.DataFrame(rows, columns=["object", "method", "measure", "value"]).astype({"value": float})
    return table.groupby(["object", "method", "measure"])["value"].std().dropna().to_dict()


def compute_tolerance(
    rule: Measure, name: str, row: str, stored: float, spreads: Mapping[tuple[str, str, str], float]
) -> float:
    """How far a number of the object ``name`` may be from the stored one, in its own unit."""
    floor = max(rule.floor, rule.contrastive if row in CONTRASTIVE else 0.0, rule.share * abs(stored))
    if row in {model.name for model in UNTRAINED}:
        return floor
    largest = max((std for (of, _, like), std in spreads.items() if (of, like) == (name, rule.like)), default=0.0)
    return max(floor, DEVIATIONS * spreads.get((name, row, rule.like), largest))


def compare_files(before: Mapping[str, str], now: Mapping[str, str]) -> pd.DataFrame:
    """The files, by {path: digest}, that a run changed: "written anew", "new" or "gone"."""
    names = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
    changes = ["new" if name not in before else "written anew" if name in now else "gone" for name in names]
    return pd.DataFrame({"file": changes}, pd.Index(names, name="path"), dtype=object)


def summarise(
    numbers: pd.DataFrame, files: pd.DataFrame, *, hardware: list[list[str]], meaningless: bool,
    stored: Mapping[str, str],
) -> str:  # fmt: skip
    """The verdict in a few lines."""
    count = numbers["agrees"].value_counts()
    compared = sum(int(count.get(word, 0)) for word in (EQUAL, AGREES, DIFFERS))
    agree = compared - int(count.get(DIFFERS, 0))
    lines = [f"Verdict: {agree} of {compared} numbers agree with the stored ones; {count.get(EQUAL, 0)} are equal."]
    differing = numbers[numbers["agrees"] == DIFFERS]
    lines += [_describe(key, row) for key, row in differing.head(MAX_LISTED).iterrows()]
    lines += [f"  … and {len(differing) - MAX_LISTED} more, in the table"] if len(differing) > MAX_LISTED else []
    reasons = {MISSING: "stored and missing in this run", NEW: "new", NOT_RUN: "of models that this run does not make"}
    others = [f"{count[word]} {text}" for word, text in reasons.items() if word in count]
    lines += [f"Not compared: {', '.join(others)}."] if others else []
    lines.append(_describe_hardware(*hardware))
    lines.append(_describe_files(files, len(stored)))
    return (NO_MEANING if meaningless else "") + "\n".join(line for line in lines if line) + "\n"


def _describe(key: tuple[str, ...], row: pd.Series) -> str:
    return f"  differs: {' '.join(key)} is {row['this run']:.4g}, stored {row['stored']:.4g} ± {row['tolerance']:.2g}"


def _describe_hardware(before: list[str], now: list[str]) -> str:
    if not before or not now:
        return ""
    return (f"Trained on {' and '.join(now)}; the stored ones on {' and '.join(before)}. The same seed on the same "
            "hardware gives equal numbers; others stay within the spread of seeds.")  # fmt: skip


def _describe_files(files: pd.DataFrame, stored: int) -> str:
    changed, new, gone = (files.index[files["file"] == word] for word in ("written anew", "new", "gone"))
    timed = [name for name in changed if Path(name).name in MINUTES]
    note = f" ({len(timed)} of them for the minutes in it)" if timed else ""
    lost = f", {len(gone)} gone" if len(gone) else ""
    listed = "".join(f"\n  {name}" for name in [*changed, *gone])
    return f"Files: {len(changed)} of {stored} stored ones written anew{note}, {len(new)} new{lost}.{listed}"


def _find_stored(paths: Paths) -> Path:
    return find_run(paths) / "stored.json"


def _list_numbers(results: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], float]]:
    """((table, object, row, measure), value) of the measures that studies have compared."""
    for study in list_studies():
        if study.compared:
            yield from _walk(results.get(study.results[0], {}), (study.results[0],), study.compared)


def _walk(
    values: Mapping[str, Any], keys: tuple[str, ...], measures: Collection[str]
) -> Iterator[tuple[tuple[str, ...], float]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _walk(value, (*keys, name), measures)
        elif name in measures and value is not None:
            yield (", ".join(keys[:-2]), *keys[-2:], name), float(value)


def _has_answers(results: Mapping[str, Any], key: tuple[str, ...], paths: Paths) -> bool:
    """Whether the answers that a number is of are here; where not, a table of results keeps the stored row."""
    table, name, row, _ = key
    run = get(results, table, name, row, "run") or get(results, "runs", f"{name}-{row}")
    return paths.queries(run["model"] if run else f"{name}-{row}").is_file()
