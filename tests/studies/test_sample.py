"""What notebooks show live: the shipped models of the paper's size about images that no training has seen."""

from __future__ import annotations

from pathlib import Path

import pytest

from mmgsd.config import EvaluateConfig
from mmgsd.studies import sample

ROOT = Path(__file__).resolve().parents[2]


def test_the_shipped_mmgsd_answers_the_sample_better_than_spcl(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "QUESTIONS", EvaluateConfig(pairs=4, points=9))
    data, errors = sample.load_sample(ROOT, "cloth"), {}
    for method in sample.PAPER_SIZE:
        table = sample.ask_sample(sample.load_shipped("cloth", method), data)
        assert len(table) == 36 and table.n.isin([1, 4]).all()
        errors[method] = table.rmse_px[table.visible].mean()
    assert errors["mmgsd"] < errors["spcl"]


def test_another_groups_matches_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample, "QUESTIONS", EvaluateConfig(pairs=1, points=9))
    table = sample.ask_sample(sample.load_shipped("rope"), sample.load_sample(ROOT, "rope"), group="identity")
    assert set(table.n) == {1}


def test_a_method_without_shipped_weights_is_refused() -> None:
    with pytest.raises(ValueError, match="method must .*got 'pcl'"):
        sample.load_shipped("cloth", "pcl")
