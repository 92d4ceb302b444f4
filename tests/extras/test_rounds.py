"""The shipped models' rounds: each goes on from the last one's weights, what is done is not done again."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from mmgsd.config import ROUNDS, load_preset
from mmgsd.extras import rounds
from mmgsd.match import matcher
from mmgsd.match.matcher import load
from mmgsd.studies.models import configure_study

TINY = {"steps": 8, "batch": 2, "pairs": 2, "queries": 8, "input_px": 128, "also": ""}


@pytest.fixture
def root(cloth_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository whose rounds are tiny, on synthetic images."""

    def configure(*arguments: object) -> dict:
        return {name: dataclasses.replace(each, **TINY) for name, each in configure_study(*arguments).items()}

    def render(config: object, folder: Path, **_: object) -> Path:
        return folder if folder.is_dir() else Path(shutil.copytree(cloth_dataset, folder))

    monkeypatch.setattr(rounds, "configure_study", configure)
    monkeypatch.setattr(rounds, "render_dataset", render)
    monkeypatch.setattr(rounds, "PAIRS", 2)
    monkeypatch.setattr(matcher, "find_shipped", lambda: tmp_path / "data" / "weights")
    return tmp_path


def test_a_round_goes_on_from_the_one_before(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rounds.find_round(root, "cloth") == 0
    first = rounds.run_round(root, "cloth", 1)
    assert first == root / "data" / "weights" / "cloth-round1.safetensors"
    assert first.with_suffix(".md").read_text().startswith("# cloth-round1.safetensors")
    second = rounds.run_round(root, "cloth", 2)
    assert load(second).config.trunk_weights == "cloth-round1"
    assert rounds.find_round(root, "cloth") == 2
    stored = json.loads((root / "data" / "results" / "rounds.json").read_text())["cloth"]
    assert list(stored) == ["1", "2"]
    assert list(stored["2"]["rmse_px"]) == [str(step) for step in range(1, 9)]
    assert "before" not in stored["1"]
    assert all(0 < stored["2"][name]["clean"] < 485 for name in ("before", "after"))
    assert stored["2"]["run"]["model"] == load(second).config.name

    monkeypatch.setattr(rounds, "find_root", lambda: root)
    monkeypatch.setattr(rounds, "train_model", lambda *_, **__: pytest.fail("a finished round is trained again"))
    rounds.main("cloth", last=2)


@pytest.mark.parametrize("number", range(1, ROUNDS + 1))
def test_each_round_has_images_of_its_own(number: int) -> None:
    clean = load_preset(f"round{number}")
    cluttered = load_preset(clean.cluttered)
    assert {clean.render["rope"].seed, cluttered.render["rope"].seed} == {number}
    assert (clean.render["rope"].scene, cluttered.render["rope"].scene) == ("plain", "workspace")
    model = configure_study(clean, "rope", "rounds")[f"round{number}"]
    assert (model.also, model.seed) == (cluttered.name, number)
    assert clean.render["rope"].views == cluttered.render["rope"].views == (10 if number < 3 else 1)
    assert model.trunk_weights == (f"rope-round{number - 1}" if number > 1 else "")
