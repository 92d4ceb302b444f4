"""Going on with photographs: what is learnt from, when it stops, what is kept and refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file

import mmgsd
from mmgsd.__main__ import main
from mmgsd.config import TrainConfig
from mmgsd.learn import adapt as adapting
from mmgsd.learn import training
from mmgsd.learn.adapt import Found, choose_stop, read_adaptation, summarise_change
from mmgsd.learn.training import train_model
from mmgsd.measure.photographs import mark_dataset
from mmgsd.model.weights import PLACES

CONFIG = TrainConfig(steps=1, batch=2, pairs=8, queries=8, input_px=64, descriptor_dim=4, heads=True, roles=2)
QUICK = {"steps": 4, "folds": 0, "device": "cpu", "progress": False}


@pytest.fixture(scope="module")
def weights(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_model(CONFIG, cloth_dataset, tmp_path_factory.mktemp("model"), device="cpu", progress=False)


@pytest.fixture
def photographs(cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four marked images, and one without a mark."""
    monkeypatch.setattr(adapting, "QUESTIONS", {"pairs": 2, "points": 2})
    monkeypatch.setattr("mmgsd.learn.photographs.ASKED", 4)
    monkeypatch.setattr("mmgsd.learn.photographs.OFF_OBJECT", 0.0)  # weights of one step see the object nowhere
    unmarked = {"file": str(cloth_dataset / "images" / "00000.webp"), "kind": "cloth"}
    return write_marks(tmp_path, [*mark_dataset(cloth_dataset, str(cloth_dataset)), unmarked])


def write_marks(folder: Path, entries: list[dict[str, Any]]) -> Path:
    (folder / "marks.json").write_text(json.dumps(entries))
    return folder / "marks.json"


def go_on(photographs: Path, weights: Path, renders: Path, out: Path, **options: Any) -> Path:
    return mmgsd.adapt(photographs, weights, out, renders=renders, **QUICK | options)


def test_weights_go_on_and_say_how(photographs: Path, weights: Path, cloth_dataset: Path, tmp_path: Path) -> None:
    out = go_on(photographs, weights, cloth_dataset, tmp_path / "mine.safetensors", folds=2)
    told, card = read_adaptation(out), out.with_suffix(".md").read_text()
    assert (told["photographs"], told["marked"], told["marks"], told["renders"]) == (5, 4, 16, 6)
    assert {*told["found"]} == {"picture", "name"} and told["found"]["name"]["after"]["queries"] == 4
    assert told["found"]["picture"]["before"]["queries"] == 4 * 2 * 4  # targets, sources and corners
    assert card.startswith("# mine.safetensors\n") and "by name: found within 5 % of the size | " in card
    assert sorted(path.name for path in tmp_path.iterdir()) == ["marks.json", "mine.md", "mine.safetensors"]
    before = out.stat().st_mtime_ns
    again = go_on(photographs, weights, cloth_dataset, out, folds=2)
    assert again == out and out.stat().st_mtime_ns == before
    with pytest.raises(ValueError, match="made of other photographs, weights or settings"):
        go_on(photographs, weights, cloth_dataset, out, folds=0)


def test_the_network_and_the_places_learn_and_the_trunk_stays(
    photographs: Path, weights: Path, cloth_dataset: Path, tmp_path: Path
) -> None:
    out = go_on(photographs, weights, cloth_dataset, tmp_path / "mine.safetensors")
    start, end = load_file(weights), load_file(out)
    changed = {name.split(".")[0] for name, value in start.items() if not torch.equal(value, end[name])}
    assert {"head", "heads", "merge", PLACES} <= changed and "trunk" not in changed
    assert not [n for n in start if "running" in n and not torch.equal(start[n], end[n])]
    assert torch.equal(end[PLACES][0], end[PLACES][24])  # corners of a cloth look alike
    assert read_adaptation(out)["found"] == {} and "not measured" in out.with_suffix(".md").read_text()
    with pytest.raises(ValueError, match="must be such as mmgsd.adapt writes"):
        read_adaptation(weights)


def test_a_stopped_run_ends_with_the_same_weights(
    photographs: Path, weights: Path, cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = go_on(photographs, weights, cloth_dataset, tmp_path / "whole.safetensors")
    monkeypatch.setattr(training, "CHECKPOINT_SECONDS", 0.0)
    make_batch, calls = adapting.make_batch, []

    def stop(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 8:  # three batches a step
            raise KeyboardInterrupt
        return make_batch(*arguments)

    monkeypatch.setattr(adapting, "make_batch", stop)
    out = tmp_path / "mine.safetensors"
    with pytest.raises(KeyboardInterrupt, match="is kept in .*mine.adapting: the same call goes on"):
        go_on(photographs, weights, cloth_dataset, out)
    assert not out.exists()
    go_on(photographs, weights, cloth_dataset, out)
    assert len(calls) == 8 + 3 * 2  # two of four steps were kept
    torch.testing.assert_close(load_file(out), load_file(whole), rtol=0, atol=0)


def test_what_was_done_of_other_photographs_is_not_gone_on_with(
    photographs: Path, weights: Path, cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = tmp_path / "mine.adapting"
    (work / "part0").mkdir(parents=True)
    (work / "asked.json").write_text("{}")
    (work / "part0" / "after-4.json").write_text("[]")
    monkeypatch.setattr(adapting, "make_batch", Mock(side_effect=KeyboardInterrupt))  # before the first step
    with pytest.raises(KeyboardInterrupt):
        go_on(photographs, weights, cloth_dataset, tmp_path / "mine.safetensors", folds=2)
    assert (work / "asked.json").read_text() != "{}" and not (work / "part0" / "after-4.json").exists()


def test_what_cannot_be_learnt_from_is_said(
    photographs: Path, weights: Path, cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, entries = tmp_path / "mine.safetensors", json.loads(photographs.read_text())
    outside = [*entries, {**entries[0], "corners": [[500, 3]]}]
    for chosen, message in (
        (entries[:1], "at least two photographs of kind 'cloth', got 1"),
        ([{**entry, "kind": "rope"} for entry in entries], "at least two photographs of kind 'cloth', got 0"),
        (outside, r"00006.webp: of its marks, xy must be finite and inside"),
        ([{"file": entry["file"]} for entry in entries], "mark some, got 5 without a mark"),
        ([{"file": e["file"], "marks": [[9, 9]] * 5} for e in entries], "at most 4 marks, as many places as look"),
    ):
        with pytest.raises(ValueError, match=message):
            go_on(write_marks(tmp_path, chosen), weights, cloth_dataset, out)
    monkeypatch.setattr("mmgsd.learn.photographs.OFF_OBJECT", 1.0)
    with pytest.raises(ValueError, match="00006.webp must"):
        go_on(write_marks(tmp_path, entries), weights, cloth_dataset, out)
    with pytest.raises(ValueError, match="folds must .*got 1"):
        go_on(photographs, weights, cloth_dataset, out, folds=1)
    with pytest.raises(ValueError, match="out must"):
        go_on(photographs, weights, cloth_dataset, tmp_path / "mine.pt")
    assert not list(tmp_path.glob("mine*"))


def test_weights_of_one_match_are_refused(photographs: Path, cloth_dataset: Path, tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, method="unimodal", heads=False)
    one = train_model(config, cloth_dataset, tmp_path / "model", device="cpu", progress=False)
    with pytest.raises(ValueError, match="weights must .*got 'unimodal'"):
        go_on(photographs, one, cloth_dataset, tmp_path / "mine.safetensors")


def test_without_renders_nothing_is_learnt(photographs: Path, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapting, "find_sample_sets", lambda kind: [])
    with pytest.raises(FileNotFoundError, match="renders must"):
        go_on(photographs, weights, None, photographs.with_name("mine.safetensors"))


def test_the_command_prints_the_card(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def adapt(folder: Path, weights: str, out: Path, *, renders: Path | None, overwrite: bool) -> Path:
        out.with_suffix(".md").write_text(f"{folder} {weights} {renders} {overwrite}\n")
        return out

    monkeypatch.setattr(mmgsd, "adapt", adapt, raising=False)
    main(["adapt", "towels", "--out", str(tmp_path / "mine.safetensors"), "--overwrite"])
    assert capsys.readouterr().out == "towels cloth None True\n"


def list_found(found: list[float], spurious: float = 0.0, rmse_px: float = 20.0) -> Found:
    """A query by a picture of each photograph."""
    rows = {"from": "own", "file": [f"{k}.jpg" for k in range(len(found))], "found@5%": found, "found@10%": found}
    return Found(pd.DataFrame({**rows, "spurious": spurious, "best": 1.0, "by": "picture"}), rmse_px)


def test_the_best_number_of_steps_is_chosen_and_the_least_of_equal_ones() -> None:
    assert choose_stop([{0: list_found([0.5]), 8: list_found([0.75]), 16: list_found([0.75])}]) == 8
    assert choose_stop([{0: list_found([0.5]), 8: list_found([0.75], spurious=0.5)}]) == 0


def test_what_is_known_of_renders_is_not_given_up() -> None:
    worse = {8: list_found([0.7], rmse_px=21.9), 16: list_found([1.0], rmse_px=22.1)}
    assert choose_stop([{0: list_found([0.5]), **worse}]) == 8


def test_the_change_is_measured_after_as_many_steps_as_the_other_parts_choose() -> None:
    first = {0: list_found([0.0, 0.5]), 8: list_found([1.0, 1.0]), 16: list_found([0.5, 0.5])}
    second = {0: list_found([0.25]), 8: list_found([0.25]), 16: list_found([0.75])}
    found = summarise_change([first, second])["picture"]
    assert found["before"]["found@5%"] == 0.25
    assert found["after"]["found@5%"] == pytest.approx((0.5 + 0.5 + 0.25) / 3, abs=1e-4)
    low, high = found["change"]["found@5%"]
    assert low <= np.mean([0.5, 0.0, 0.0]) <= high
