"""The shipped models' rounds: each goes on from the last one's weights, what is done is not done again."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from mmgsd.config import ROUNDS, UNSEEN_SEED, RenderConfig, load_preset
from mmgsd.extras import rounds
from mmgsd.match import matcher
from mmgsd.match.matcher import find_shipped, load
from mmgsd.measure import calibration
from mmgsd.model.tensors import read_tensors
from mmgsd.studies.models import configure_study

STEPS = 2
TINY = {"steps": STEPS, "batch": 2, "pairs": 2, "queries": 8, "input_px": 128, "also": ""}


@pytest.fixture(scope="module")
def two_rounds(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A repository whose rounds are tiny, on synthetic images, after two of the cloth."""

    def configure(*arguments: object) -> dict:
        return {name: dataclasses.replace(each, **TINY) for name, each in configure_study(*arguments).items()}

    def render(config: RenderConfig, folder: Path, **_: object) -> Path:
        if not folder.is_dir():
            shutil.copytree(cloth_dataset, folder)
            info = json.loads((folder / "dataset.json").read_text()) | {"config": {"seed": config.seed}}
            (folder / "dataset.json").write_text(json.dumps(info))
        return folder

    folder = tmp_path_factory.mktemp("rounds")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rounds, "configure_study", configure)
        patch.setattr(rounds, "render_dataset", render)
        patch.setattr(rounds, "PAIRS", 2)
        patch.setattr(rounds, "VALIDATIONS", STEPS)
        patch.setattr(matcher, "find_shipped", lambda: folder / "data" / "weights")
        for number in (1, 2):
            rounds.run_round(folder, "cloth", number)
        yield folder


@pytest.fixture
def root(two_rounds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, which `mmgsd rounds` takes for its own."""
    folder = shutil.copytree(two_rounds, tmp_path / "root")
    monkeypatch.setattr(rounds, "find_root", lambda: folder)
    monkeypatch.setattr(matcher, "find_shipped", lambda: folder / "data" / "weights")
    return folder


def test_a_round_goes_on_from_the_one_before(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (root / "data" / "weights" / f"cloth-round{number}.safetensors" for number in (1, 2))
    assert first.with_suffix(".md").read_text().startswith("# cloth-round1.safetensors")
    assert load(second).config.trunk_weights == "cloth-round1"
    assert [rounds.find_round(root, name) for name in ("cloth", "rope")] == [2, 0]
    stored = json.loads((root / "data" / "results" / "rounds.json").read_text())["cloth"]
    assert list(stored) == ["1", "2"]
    assert list(stored["2"]["rmse_px"]) == [str(step) for step in range(1, STEPS + 1)]
    assert "before" not in stored["1"]
    assert all(0 < stored["2"][name]["clean"] < 485 for name in ("before", "after"))
    assert stored["2"]["run"]["model"] == load(second).config.name

    monkeypatch.setattr(rounds, "train_model", lambda *_, **__: pytest.fail("a finished round is trained again"))
    rounds.main("cloth", last=2)


@pytest.mark.parametrize("number", range(1, ROUNDS["rope"] + 1))
def test_each_round_has_images_of_its_own(number: int) -> None:
    clean = load_preset(f"round{number}")
    cluttered = load_preset(clean.cluttered)
    assert {clean.render["rope"].seed, cluttered.render["rope"].seed} == {number + (number >= UNSEEN_SEED)}
    assert (clean.render["rope"].scene, cluttered.render["rope"].scene) == ("plain", "workspace")
    model = configure_study(clean, "rope", "rounds")[f"round{number}"]
    assert (f"round{number}" in configure_study(clean, "cloth", "rounds")) == (number <= ROUNDS["cloth"])
    assert (model.also, model.seed) == (cluttered.name, number)
    assert clean.render["rope"].views == cluttered.render["rope"].views == (10 if number < 3 else 1)
    assert model.trunk_weights == (f"rope-round{number - 1}" if number > 1 else "")


def test_the_average_of_the_last_rounds_is_shipped_where_it_errs_least(root: Path, monkeypatch, capsys) -> None:
    with pytest.raises(ValueError, match="'rope' has none"):
        rounds.main("rope", ship=True)
    files = [root / "data" / "weights" / f"cloth-round{number}.safetensors" for number in (1, 2)]
    errors = {"1": 9.0, "2": 7.0, "cloth-round1": 11.0}
    monkeypatch.setattr(rounds, "_measure_parts", lambda file, _: {"clean": errors[file.stem], "cluttered": 1.0})
    monkeypatch.setattr(calibration, "LEAST_PAIRS", 4)
    monkeypatch.setattr(calibration, "choose_readout", lambda matcher, *_, **__: matcher.readout)
    monkeypatch.setattr(calibration, "measure_mean_error", lambda *_: 20.0)  # of any temperature and shrinkage
    rounds.main("cloth", ship=True)
    shipped = root / "data" / "weights" / "cloth.safetensors"
    assert capsys.readouterr().out.split()[-1] == str(shipped)
    stored = json.loads((root / "data" / "results" / "rounds.json").read_text())["cloth"]
    assert stored["1"]["unseen"] == {
        "alone": {"clean": 11.0, "cluttered": 1.0},
        "averaged": {"clean": 7.0, "cluttered": 1.0},
    }
    assert stored["2"]["unseen"]["alone"] == stored["2"]["unseen"]["averaged"] and "rmse_px" in stored["2"]
    (tensors, note), (first, _), (second, _) = map(read_tensors, (shipped, *files))
    assert json.loads(note["averaged"]) == ["cloth-round2", "cloth-round1"] and "unseen" in note
    one, other, mean = (each["head.source.weight"].float() for each in (first, second, tensors))
    torch.testing.assert_close(mean, (one + other) / 2, atol=1e-4, rtol=0)
    card = shipped.with_suffix(".md").read_text()
    assert "presets `round1` to `round2` and their cluttered ones" in card and f"| {2 * STEPS} steps of" in card
    assert "the average of `cloth-round2`, `cloth-round1`" in card and "not measured yet" in card

    with pytest.raises(ValueError, match=r"run shipped cloth"):
        rounds.main("cloth", card=True)
    found = {"rmse_mean": 20.06, "median": 9.0, "queries": 1234}
    row = {"sha256": hashlib.sha256(shipped.read_bytes()).hexdigest(), "paper": found}
    (root / "data" / "results" / "shipped.json").write_text(json.dumps({"cloth": row}))
    stored["3"] = stored["2"]  # trained since, and not shipped
    (root / "data" / "results" / "rounds.json").write_text(json.dumps({"cloth": stored}))
    rounds.main("cloth", card=True)
    again = shipped.with_suffix(".md").read_text()
    assert hashlib.sha256(shipped.read_bytes()).hexdigest() == row["sha256"]
    assert "| RMSE, paper | 20.1 px mean" in again and "not measured" not in again
    assert again.splitlines()[:8] == card.splitlines()[:8]


def test_photographs_are_measured_of_the_last_round(root: Path, monkeypatch, capsys) -> None:
    shipped = load(find_shipped() / "cloth.safetensors")
    monkeypatch.setattr(rounds, "load", lambda name: shipped if name == "cloth" else load(name))
    monkeypatch.setattr(rounds, "read_photographs", lambda folder, kind: [folder, kind])
    monkeypatch.setattr(rounds, "measure_answers", lambda matcher, asked: {"sharp": matcher.readout.mean_exponent})
    rounds.main("cloth", photographs=Path("mine"))
    stored = json.loads((root / "data" / "results" / "rounds.json").read_text())["cloth"]["2"]
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert stored["photographs"] == {"sharp": shipped.readout.mean_exponent} == printed
