"""The models of the main study after equally many steps, those of the studies' smaller budget."""

from __future__ import annotations

from functools import partial

from mmgsd.studies.matrix import run_matrix
from mmgsd.studies.registry import Shown, Study
from mmgsd.studies.table import describe_errors

STUDY = Study(
    "budget", 15, partial(run_matrix, study="budget"), results=("budget",),
    tables={"budget": Shown("paper/budget.json", describe_errors, "budget_table")},
)  # fmt: skip
