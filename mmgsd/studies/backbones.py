"""Which trunk: EfficientNet-Lite0, trained, beside a frozen DINOv2, everything else of the shipped models' training.

    python -m mmgsd run models paper --study backbones --steps 1500 --only cloth
    python -m mmgsd run shipped backbones --steps 1500 --object cloth --photographs FOLDER  -> shipped.json
"""

from __future__ import annotations

import dataclasses
from functools import partial

from mmgsd.config import OBJECTS
from mmgsd.studies.matrix import run_matrix
from mmgsd.studies.models import list_rows
from mmgsd.studies.registry import Shown, Study
from mmgsd.studies.shipped import RESULTS, Rows, describe_pictures
from mmgsd.studies.table import Column, Table, say_value


def describe_backbones(rows: Rows) -> Table:
    """`describe_pictures` of the models of each trunk that were measured, and the time of a question (ms)."""
    labels = {f"{object}-{row.name}": row.label for object in OBJECTS for row in list_rows("backbones")}
    table = describe_pictures(rows, {name: label for name, label in labels.items() if name in rows})
    columns = [*table.blocks[""], Column("time", page="ms a question")]
    times = {f"{name.partition('-')[0]}, {label}": rows[name] for name, label in labels.items() if name in rows}
    lines = {label: {"": row[""] | {"time": say_value(times.get(label), "milliseconds", 1, ".0f")}}
             for label, row in table.rows.items()}  # fmt: skip
    return dataclasses.replace(table, blocks={"": columns}, rows=lines)


STUDY = Study(
    "backbones", 145, partial(run_matrix, study="backbones"), tables={"backbones": Shown(RESULTS, describe_backbones)}
)
