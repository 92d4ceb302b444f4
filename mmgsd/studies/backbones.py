"""Which trunk: EfficientNet-Lite0, trained, beside a frozen DINOv2, everything else of the shipped models' training."""

from __future__ import annotations

from functools import partial

from mmgsd.studies.matrix import run_matrix
from mmgsd.studies.registry import Study

STUDY = Study("backbones", 145, partial(run_matrix, study="backbones"))
