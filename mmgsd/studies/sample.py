"""The shipped models of the paper's size asked about the sample images, in seconds: what notebooks show live."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from mmgsd.checks import check_choice
from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.matcher import Matcher, load
from mmgsd.measure.questions import ask, model_answer
from mmgsd.studies.models import SHIPPED

PAPER_SIZE = ("mmgsd", "spcl")  # methods whose shipped weights learnt from the paper's images alone
QUESTIONS = EvaluateConfig(pairs=20, points=65)  # 1,300 queries


def load_sample(root: Path, object: str) -> Dataset:
    """The sample images of the cloth or the rope whose simulations no model was trained on."""
    return load_dataset(root / "data" / "sample" / object, "test")


def load_shipped(object: str, method: str = "mmgsd") -> Matcher:
    """The shipped model of a method, trained on the paper's images alone; ValueError for a method without one."""
    check_choice("method", method, PAPER_SIZE)
    return load(f"{object}{SHIPPED[method]}")


def ask_sample(matcher: Matcher, data: Dataset, *, group: str = "") -> pd.DataFrame:
    """A model's answers about `load_sample`'s images, a row a query as in `mmgsd.measure.evaluation.load_queries`.

    The true matches are those of ``group`` ("" is what the model was taught).
    """
    answer = model_answer(matcher, data, QUESTIONS)
    return ask(answer, data, QUESTIONS, group or matcher.config.group, False, "")
