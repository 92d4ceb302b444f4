"""What shipped weights, and what one would pick instead, do on clean renders, on cluttered ones and on photographs.

    python -m mmgsd run shipped cloth cloth-paper orb --photographs FOLDER    -> data/results/shipped.json
    python -m mmgsd run shipped cloth@1,1 --photographs FOLDER     its modes read with another power and sharpness
    python -m mmgsd run shipped cloth@1,1,0 …      and what it is asked with not shrunk towards places
    python -m mmgsd run shipped backbones --photographs FOLDER     the models of that study, once they are trained
    python -m mmgsd run shipped cloth --cloth-renders FOLDER       and others' renders of a cloth

A row a name: of weights in data/weights; of a baseline, which is asked about each object with the true masks, and in
photographs with those that the shipped weights see, and whose modes are read as theirs; or of each model of a study of
`STUDIES` of the preset `paper`, or of another with so many steps each (--preset quick --steps 300), which is asked
about that preset's images. How modes are read (`mmgsd.match.em.ModeReadout`) is the weights' own, unless the name
says another after an @. The test images of the presets `paper` and `workspace`, or of that one, have to be rendered,
unless --photographs-alone leaves them out: what a row has of the same weights stays. Tables of answers are kept, so
that a killed call goes on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import pandas as pd

from mmgsd.checks import read_count
from mmgsd.command import Option
from mmgsd.config import OBJECTS, PRESETS, Preset, load_preset
from mmgsd.files import write_json
from mmgsd.match.baselines import BASELINES, OPTIONAL
from mmgsd.measure import shipped as measured
from mmgsd.measure.evaluation import read_results
from mmgsd.measure.shipped import measure_baseline, measure_read, measure_weights, name_read
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import PAPER, SHIPPED, configure_study, get_label
from mmgsd.studies.registry import Shown, Study
from mmgsd.studies.table import ERRORS, MISSING, Table, make_page_table, say_value

STUDIES = ("backbones",)
RESULTS = "shipped.json"
NAMES = ", ".join((*BASELINES, *OPTIONAL, *STUDIES))  # that may be measured besides weights
Rows = Mapping[str, Mapping[str, Any]]  # data/results/shipped.json, {name: what `mmgsd.measure.shipped` found}
SETS = {"paper": "clean", "workspace": "cluttered"}  # test images: what readers know them as
READ = "@POWER,SHARPNESS or @POWER,SHARPNESS,SHRINKAGE"
SIDES = {"cloth": "side", "rope": "length"}  # of what an error is a share
READING = ("power", "sharpness")
ROUND_HEADS = ("steps so far", "clean: RMSE px", "cluttered", "averaged with all later rounds: clean", "cluttered",
               "photographs: found", "spurious", "by name: found", "spurious")  # fmt: skip


def list_names(rows: Rows, object: str) -> list[str]:
    """The rows of an object: weights for everything, those of the paper's images, then baselines; all read alike."""
    order = [object, f"{object}-paper", *(f"{object}-{name}" for name in (*BASELINES, *OPTIONAL))]
    return [alike for name in order if (alike := find_alike(rows, name)) in rows]


def find_alike(rows: Rows, name: str) -> str:
    """The row of a name whose modes are read as the object's shipped weights are: its own, or one read so."""
    like = rows.get(name.partition("-")[0], {})
    readout = [like.get(key) for key in READING]
    if None in readout or [rows.get(name, {}).get(key) for key in READING] == readout:
        return name
    return f"{name}@{','.join(f'{value:g}' for value in readout)}"


def label_row(name: str) -> str:
    """What tables and figures call a row: weights by the name that loads them."""
    weights = name.partition("@")[0]
    kind = weights.partition("-")[2]
    return get_label(kind) if kind in (*BASELINES, *OPTIONAL) else f"`{weights}`"


def get_photographs(rows: Rows, name: str) -> Mapping[str, Any]:
    """What a row found in photographs; nothing where it counted other marks than the object's shipped weights did."""
    own, like = (rows.get(key, {}).get("photographs", {}) for key in (name, name.partition("@")[0].partition("-")[0]))
    return own if own.get("marks") == like.get("marks") else {}


def describe_limits(rows: Rows) -> Table:
    """What an answer of the shipped weights is worth, and costs, in a user's units."""
    photographs = [rows[object].get("photographs") or {} for object in SIDES]
    seen = [[*(say_value(row, "found@5%", 100, ".0f", " %") for row in (each.get("by_name"), each)),
             say_value(each, "unanswered", 100, ".0f", " %")] for each in photographs]  # fmt: skip
    slowest = rows[max(SIDES, key=lambda object: rows[object]["milliseconds"])]
    lines = {
        "it knows": "square cloths, and ropes whose ends look alike; anything else has to be learnt first",
        **{f"mean error, {word} renders": "; ".join(_tell_error(rows[object], preset) for object in SIDES)
           for preset, word in SETS.items()},
        **{f"asked by name, {word} ones": "; ".join(_tell_named(rows[object], preset) for object in SIDES)
           for preset, word in SETS.items()},
        "in photographs": "found within 5 % of the size, a development set: {} of a cloth's corners by name, {} by "
                          "another picture ({} of the questions not answered); of a rope's ends {} and {} ({})".format(
                              *seen[0], *seen[1]),
        "it takes": f"{slowest['milliseconds']:.0f} ms for two new images and a question{_tell_described(slowest)} "
                    f"({say_hardware(slowest)}); a GPU is not needed",
        "on a robot": "never tried",
    }  # fmt: skip
    return make_page_table([" "], {name: [text] for name, text in lines.items()})


def say_hardware(row: Mapping[str, Any]) -> str:
    """What a row was made on; of a CPU also whether it has bfloat16 (`mmgsd.model.network.name_hardware`)."""
    return row["hardware"].replace("CPU,", "CPU with bfloat16,")


def _tell_described(row: Mapping[str, Any]) -> str:
    time = row.get("milliseconds_described")
    return "" if time is None else f", {time:.0f} ms for a further question about them"


def _tell_error(row: Mapping[str, Any], preset: str) -> str:
    px, size = say_value(row.get(preset), "rmse_mean", 1, ".0f", " px"), row.get("side_px")
    if preset != "paper":  # its side was measured in clean images
        return f"{row['object']} {px}"
    share = say_value(row.get(preset) if size else None, "rmse_mean", 100 / (size or 1), ".0f", " %")
    return f"{row['object']} {px}, {share} of its {SIDES[row['object']]}"


def _tell_named(row: Mapping[str, Any], preset: str) -> str:
    by_name, by_picture = (say_value(row.get(preset, {}).get("asked"), key, 1, ".0f", " px")
                           for key in ("by_name", "by_picture"))  # fmt: skip
    return f"{row['object']} {by_name} where a picture gives {by_picture}"


def describe_pictures(rows: Rows, labels: Mapping[str, str] | None = None) -> Table:
    """Errors on clean and cluttered renders and what is found in photographs, a row a model, or one of ``labels``."""
    if labels is None:
        labels = {name: label_row(name) for object in OBJECTS for name in list_names(rows, object)}
    columns = "photographs: found", "spurious", "not answered", "best of the rest"
    columns = columns if any(get_photographs(rows, name) for name in labels) else ()
    heads, lines = [*(f"{word}: RMSE px" for word in SETS.values()), *columns], {}
    for name, label in labels.items():
        photographs = get_photographs(rows, name)
        cells = [say_value(rows[name].get(preset), "rmse_mean", 1, ".1f") for preset in SETS]
        cells += _tell_photographs(photographs)
        title = f"{name.partition('@')[0].partition('-')[0]}, {label}"
        lines[title] = cells[: len(heads)]
        if by_name := photographs.get("by_name"):
            lines[f"{title}, by name"] = [MISSING] * len(SETS) + _tell_photographs(by_name)
    return make_page_table(heads, lines)


def _tell_photographs(measures: Mapping[str, Any]) -> list[str]:
    shares = [_say_interval(measures, key) for key in ("found@5%", "spurious")]
    return [*shares, say_value(measures, "unanswered", 100, ".0f", " %"), say_value(measures, "best", 1, ".1f", " %")]


def _say_interval(photographs: Mapping[str, Any], key: str) -> str:
    """A share with its 95 % interval, where that is known."""
    low_high = (photographs.get("intervals") or {}).get(key)
    interval = " ({:.0f} to {:.0f})".format(*(100 * value for value in low_high)) if low_high else ""
    return say_value(photographs, key, 100, ".0f", " %") + interval


def make_reading_sentence(rows: Rows) -> str:
    """How all of `describe_pictures` are read, and whether intervals of what two weights find overlap."""
    readouts = [f"power {rows[object]['power']:g}, sharpness {rows[object]['sharpness']:g} ({object})"
                for object in OBJECTS]  # fmt: skip
    comparisons = [f"those of `{object}` and `{object}-paper` {_compare_intervals(rows, object)}" for object in OBJECTS]
    shares = [f"{rows[object]['shrinkage']:g} ({object})" for object in OBJECTS if rows[object].get("shrinkage")]
    shrunk = f"; the shipped weights shrink sources by {' and '.join(shares)}" if shares else ""
    plain = [text for object in OBJECTS if (text := _tell_unshrunk(rows, object))]
    beside = f" (without that {', '.join(plain)})" if plain else ""
    return (f"In this table all are read with {' or '.join(readouts)}{shrunk}{beside}. 95 % intervals by photographs: "
            f"{', '.join(comparisons)}.")  # fmt: skip


def _tell_unshrunk(rows: Rows, object: str) -> str:
    """What shipped weights find, read as the others are that know no shrinkage; "" where that was not measured."""
    readout = ",".join(f"{rows[object][key]:g}" for key in READING)
    photographs = get_photographs(rows, f"{object}@{readout},0")
    share, spurious = (say_value(photographs, key, 100, ".0f", " %") for key in ("found@5%", "spurious"))
    return f"`{object}` finds {share} with {spurious} spurious" if photographs else ""


def _compare_intervals(rows: Rows, object: str) -> str:
    both = [get_photographs(rows, name) for name in (object, find_alike(rows, f"{object}-paper"))]
    intervals = [(photographs.get("intervals") or {}).get("found@5%") for photographs in both]
    if None in intervals:
        return "are not compared"
    (low, high), (other_low, other_high) = intervals
    return "overlap" if low <= other_high and other_low <= high else "do not overlap"


def describe_cloth_renders(rows: Rows) -> Table:
    """The errors on others' renders of a cloth, a row the weights, and what the paper says of its own."""
    names = [find_alike(rows, f"cloth{kind}") for kind in SHIPPED.values()]
    ours = {label_row(name): {"": row} for name in names if (row := rows.get(name, {}).get("cloth_renders"))}
    theirs = {"*the paper's MMGSD, on images like its training's*": {"": {"rmse_mean": PAPER["cloth"]}}}
    return Table(" ", {"": [dataclasses.replace(column, optional=True) for column in ERRORS]}, ours, quoted=theirs)


def describe_readings(rows: Rows) -> Table:
    """`describe_pictures` of weights whose modes are read in more than one way, power and sharpness in the label."""
    labels = {}
    for name in (name for name in sorted(rows) if "power" in rows[name]):
        weights, _, numbers = name.partition("@")
        again = any(other.startswith(f"{weights}@") for other in rows)
        row = rows[name]
        if (numbers or again) and {"photographs", *SETS} & row.keys():
            labels[name] = f"`{weights}`, power {row['power']:g}, sharpness {row['sharpness']:g}"
            if row.get("shrinkage") or numbers.count(",") == 2:
                labels[name] += f", shrinkage {row['shrinkage']:g}"
    return describe_pictures(rows, labels)


FORMS = {"ece": ".3f", "ece_confidence": ".3f", "by_picture": ".1f", "by_name": ".1f"}


def describe_knowledge(rows: Rows) -> Table:
    """What shipped weights know beside the matches, and how far they keep what they promise."""
    measures = {"mask IoU": "mask_iou", "seen": "auroc_visible", "on the object": "auroc_on_object",
                "absent": "auroc_absent", "ECE of ellipses": "ece", "of confidences": "ece_confidence",
                "within the 90 % radius": "within_radius", "asked by a picture: RMSE px": "by_picture",
                "by name": "by_name"}  # fmt: skip
    lines = {}
    for name in (name for object in OBJECTS for name in (object, f"{object}-paper")):
        for preset, word in SETS.items() if "calibrated" in rows.get(name, {}) else ():
            values = rows[name].get(preset, {})
            values = {**values, **values.get("heads", {}), **values.get("asked", {})}
            lines[f"`{name}`, {word}"] = [say_value(values, key, 1, FORMS.get(key, ".2f"))
                                          for key in measures.values()]  # fmt: skip
    return make_page_table(list(measures), lines)


def describe_rounds(rounds: Rows) -> Table:
    """The training of the shipped weights, a row a round: errors on images that none has seen, and in photographs."""
    lines = {}
    for object, rows in rounds.items():
        steps = 0
        for number, row in sorted(rows.items(), key=lambda item: int(item[0])):
            steps += row["run"]["steps"]
            unseen, photographs = row.get("unseen", {}), row.get("photographs", {})
            lines[f"{object}, {number}"] = [
                f"{steps}",
                *(say_value(unseen.get(which), word, 1, ".1f") for which in ("alone", "averaged")
                  for word in SETS.values()),
                *(say_value(shares, key, 100, ".0f", " %") for shares in (photographs, photographs.get("by_name"))
                  for key in ("found@5%", "spurious")),
            ]  # fmt: skip
    return make_page_table(ROUND_HEADS, lines)


def describe_sources(rows: Rows) -> Table:
    """The photographs of each public repository, a row each: what the shipped weights find in them."""
    lines = {}
    shares = ("unanswered", "found@5%", "found@10%", "spurious")
    for object in OBJECTS:
        for name, source in rows[object]["photographs"]["sources"].items():
            count, best = say_value(source, "queries", 1, "d"), say_value(source, "best", 1, ".1f", " %")
            lines[f"{object}, `{name}`"] = [count, *(say_value(source, key, 100, ".0f", " %") for key in shares), best]
    return make_page_table(["questions", "unanswered", "found", "at 10 %", "spurious", "best"], lines)


def make_counts_sentence(rows: Rows) -> str:
    """How many photographs were asked about, and how long a question takes."""
    counts = " and ".join(f"{rows[object]['photographs']['photographs']} of {object}s" for object in OBJECTS)
    slowest = max(OBJECTS, key=lambda object: rows[object]["milliseconds"])
    took, hardware = rows[slowest]["milliseconds"], say_hardware(rows[slowest])
    return f"Photographs: {counts}. One question about two new images takes {took:.0f} ms ({hardware})."


def read_reliability(rows: Rows, kind: str) -> dict[str, pd.DataFrame]:
    """{object: reliability on clean renders}, of the ``kind`` "Gaussian" or "calibrated"."""
    return {name: pd.DataFrame(rows[name]["paper"]["reliability"][kind]) for name in OBJECTS if name in rows}


def measure_study(
    study: str, root: Path, preset: Preset, *, objects: Sequence[str] = (), steps: int = 0,
    photographs: Path | None = None,
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """{object-row: as `measure_weights`, with preset and ``steps``} of a study's models, all or of some objects.

    FileNotFoundError where one is not trained yet.
    """
    paths = Paths(root, preset.name)
    keyed = {name: configure_study(preset, name, study, steps=steps) for name in objects or OBJECTS}
    models = {f"{name}-{key}": model for name, rows in keyed.items() for key, model in rows.items()}
    files = {key: paths.model(model) / WEIGHTS for key, model in models.items()}
    missing = [str(file) for file in files.values() if not file.is_file()]
    if missing:
        options = f"{preset.name} --study {study}" + (f" --steps {steps}" if steps else "")
        raise FileNotFoundError(f"{missing[0]} does not exist: run python -m mmgsd run models {options}")
    how = {"photographs": photographs, "presets": (preset.name, preset.cluttered)}
    return {key: measure_weights(key, root, weights=file, **how) | {"preset": preset.name, "steps": models[key].steps}
            for key, file in files.items()}  # fmt: skip


def measure_rows(
    name: str, root: Path, *, photographs: Path | None = None, photographs_alone: bool = False,
    cloth_renders: Path | None = None, preset: str = "paper", steps: int = 0, object: str = "",
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """The rows of a name that is asked for, as the module says."""
    if name in STUDIES:
        objects = (object,) if object else ()
        return measure_study(name, root, load_preset(preset), objects=objects, steps=steps, photographs=photographs)
    how = {"photographs": photographs, "presets": () if photographs_alone else measured.SETS}
    if name in (*BASELINES, *OPTIONAL):
        rows = {f"{object}-{name}": measure_baseline(name, object, root, **how) for object in OBJECTS}
        return {name_read(key, row): row for key, row in rows.items()}
    measure = measure_read if "@" in name else measure_weights
    return {name: measure(name, root, cloth_renders=cloth_renders, **how)}


def run(paths: Paths, *, names: Sequence[str] = ("cloth", "rope", "cloth-paper", "rope-paper"), **how: Any) -> Path:
    """Measure some names and put their rows into shipped.json; ``how`` is as `measure_rows` has it."""
    out = paths.root / "data" / "results" / RESULTS
    for name in names:
        rows = measure_rows(name, paths.root, **how)
        stored = read_results(out)
        for key, row in rows.items():  # photographs are not at everybody's hand: a call without them keeps the row's
            before = stored.get(key, {})
            stored[key] = (before if before.get("sha256") == row.get("sha256") else {}) | row
        print(f"{write_json(out, stored)}: {', '.join(rows)}")
    return out


def main(
    *names: Annotated[str, Option(f"weights in data/weights, alone or with {READ}, {NAMES}", metavar="NAME")],
    photographs: Annotated[Path, Option("marked photographs, with index.json", metavar="FOLDER")] | None = None,
    photographs_alone: Annotated[bool, Option("leave the presets' test images out: they take longest")] = False,
    cloth_renders: Annotated[Path, Option("others' renders, with knots_info.json", metavar="FOLDER")] | None = None,
    preset: Annotated[str, Option("of the study (default: paper)", choices=PRESETS)] = "paper",
    steps: Annotated[int, Option("of each model of a study (default: the study's own)")] = 0,
    object: Annotated[str, Option("of a study's models those of one object", choices=OBJECTS)] = "",
) -> None:
    """Measure some weights and baselines and put their rows into the results."""
    how = {"photographs": photographs, "photographs_alone": photographs_alone, "cloth_renders": cloth_renders}
    how |= {"preset": preset, "steps": read_count("--steps", steps), "object": object}
    run(Paths(find_root(), preset), names=names, **how)


STUDY = Study(
    "shipped", 160, run, shows=lambda paths, **_: [paths.results.parent / RESULTS],
    tables={
        "limits": Shown(RESULTS, describe_limits),
        "pictures": Shown(RESULTS, describe_pictures),
        "readings": Shown(RESULTS, describe_readings),
        "knowledge": Shown(RESULTS, describe_knowledge),
        "rounds": Shown("rounds.json", describe_rounds),
        "by_source": Shown(RESULTS, describe_sources),
        "counts": Shown(RESULTS, make_counts_sentence),
        "alike": Shown(RESULTS, make_reading_sentence),
        "cloth_renders": Shown(RESULTS, describe_cloth_renders),
    },
)  # fmt: skip
