"""Rows of the shipped weights: clean and cluttered images, photographs; a row's photographs outlast a call without."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_heads_measured import write_weights

import mmgsd
from mmgsd.config import EvaluateConfig, load_preset
from mmgsd.dataset import load_dataset
from mmgsd.match.matcher import Matcher
from mmgsd.measure import shipped
from mmgsd.measure.shipped import Masked, measure_baseline, measure_by_name, measure_read, measure_weights
from mmgsd.paths import Paths
from mmgsd.studies import shipped as study
from mmgsd.studies.models import configure_study
from mmgsd.studies.shipped import main, measure_study

SAMPLE = Path(__file__).parents[2] / "data" / "sample"


@pytest.fixture
def root(tmp_path: Path, cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with two tiny sets of cloths, a sample and untrained weights under the name ``mine``."""
    small = dataclasses.replace(load_preset("paper"), evaluate=EvaluateConfig(pairs=2, points=5))
    for module in (shipped, study):
        monkeypatch.setattr(module, "load_preset", lambda _: small)
    monkeypatch.setattr(study, "OBJECTS", ("cloth",))
    monkeypatch.setattr(shipped, "TIMED", 1)
    monkeypatch.setattr(shipped, "HEAD_PAIRS", 4)
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    weights = write_weights(tmp_path)
    monkeypatch.setattr(shipped, "find_weights", lambda _: weights)
    for preset in shipped.SETS:
        shutil.copytree(cloth_dataset, Paths(tmp_path, preset).dataset("cloth"))
    shutil.copytree(SAMPLE / "cloth", tmp_path / "data" / "sample" / "cloth")
    return tmp_path


def test_weights_are_measured_on_both_sets(root: Path) -> None:
    row = measure_weights("mine", root, progress=False)
    assert row["object"] == "cloth" and row["calibrated"] is False
    assert min(row["milliseconds"], row["milliseconds_described"]) > 0
    assert 250 < row["side_px"] < 450  # of a flat cloth of the sample
    for preset in shipped.SETS:
        assert 0 < row[preset]["rmse_mean"] < 700 and 0 <= row[preset]["heads"]["mask_iou"] <= 1
        assert row[preset]["within_radius"] is None and 0 <= row[preset]["ece"] <= 1


@pytest.mark.parametrize("name", ["cloth", "rope"])
def test_the_same_questions_are_asked_by_a_picture_and_by_name(name: str) -> None:
    data = load_dataset(SAMPLE / name, "test")
    found = measure_by_name(mmgsd.load(name), data, pairs=3, points=5)
    assert found.keys() == {"by_picture", "by_name"} and all(0 < px < 60 for px in found.values())


def test_baselines_are_measured_on_both_sets(root: Path) -> None:
    row = measure_baseline("orb", "cloth", root, progress=False)
    assert all(0 < row[preset]["rmse_mean"] < 700 for preset in shipped.SETS)


def test_photographs_of_a_row_outlast_a_call_without_them(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shipped, "measure_photographs", lambda *_, **__: {"best": 3.0})
    main("mine", photographs=Path("somewhere"))
    main("mine")
    rows = json.loads((root / "data" / "results" / "shipped.json").read_text())
    assert rows["mine"]["photographs"] == {"best": 3.0}
    rows["mine"]["sha256"] = "of other weights"
    (root / "data" / "results" / "shipped.json").write_text(json.dumps(rows))
    main("mine")
    rows = json.loads((root / "data" / "results" / "shipped.json").read_text())
    assert "photographs" not in rows["mine"]


def test_a_baseline_is_told_where_the_object_is_seen() -> None:
    class Segmenter:
        def segment(self, image: np.ndarray) -> np.ndarray:
            return (image[..., 0] > 0).astype(np.float32)

    class Baseline:
        def match(self, image0: np.ndarray, image1: np.ndarray, xy: object, *, n: int, mask1: np.ndarray | None):
            return n, None if mask1 is None else int(mask1.sum())

    dark, light = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3), np.uint8)
    light[:2] = 255
    asked = [(dark, light, [[0, 0]]), (dark, dark, [[0, 0]])]
    assert list(Masked(Baseline(), Segmenter(), modes=4).match_many(asked)) == [(4, 8), (4, None)]


def test_a_study_that_is_not_trained_says_how_to_train_it(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError, match="run python -m mmgsd run models paper --study backbones"):
        main("backbones")
    monkeypatch.setattr(study, "load_preset", load_preset)
    with pytest.raises(FileNotFoundError, match="models quick --study backbones --steps 7"):
        main("backbones", preset="quick", steps=7)


def test_a_study_of_another_preset_is_asked_about_its_own_images(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick, asked = load_preset("quick"), []
    for model in configure_study(quick, "cloth", "backbones", steps=7).values():
        folder = Paths(root, "quick").model(model)
        folder.mkdir(parents=True)
        shutil.copy(root / "w.safetensors", folder / "weights.safetensors")
    monkeypatch.setattr(study, "measure_weights", lambda name, root, **how: asked.append(how["presets"]) or {})
    rows = measure_study("backbones", root, quick, objects=["cloth"], steps=7)
    assert list(rows) == ["cloth-light", "cloth-dinov2s"]
    assert set(asked) == {("quick", "workspace_quick")}
    assert rows["cloth-light"] == {"preset": "quick", "steps": 7}


def test_a_name_may_say_how_modes_are_read(root: Path) -> None:
    main("mine", "mine@1,1", "mine@2,4")
    rows = json.loads((root / "data" / "results" / "shipped.json").read_text())
    assert [(row["power"], row["sharpness"]) for row in rows.values()] == [(1, 1), (1, 1), (2, 4)]
    own, same, other = (row["paper"]["rmse_mean"] for row in rows.values())
    assert own == same != other


@pytest.mark.parametrize("name", ["mine@", "mine@2", "mine@2,x", "mine@1,2,3", "mine@1,2,0,0", "mine@1,2,nan"])
def test_another_reading_is_two_numbers_or_three(root: Path, name: str) -> None:
    with pytest.raises(ValueError, match="a reading must be POWER,SHARPNESS"):
        measure_read(name, root, progress=False)


def test_photographs_alone_keep_what_renders_gave(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = root / "data" / "results" / "shipped.json"
    main("mine@2,4")
    before = json.loads(results.read_text())["mine@2,4"]
    monkeypatch.setattr(shipped, "read_photographs", lambda *_: [])
    monkeypatch.setattr(shipped, "measure_answers", lambda *_, **__: {"best": 3.0})
    monkeypatch.setattr(shipped, "evaluate_model", None)  # not asked
    main("mine@2,4", photographs=Path("somewhere"), photographs_alone=True)
    assert json.loads(results.read_text())["mine@2,4"] == before | {"photographs": {"best": 3.0}}


def test_photographs_alone_need_no_renders_of_anything(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = root / "data" / "results" / "shipped.json"
    main("mine", "orb")
    before = json.loads(results.read_text())
    for preset in shipped.SETS:
        shutil.rmtree(Paths(root, preset).dataset("cloth"))
    monkeypatch.setattr(shipped, "read_photographs", lambda *_: [])
    monkeypatch.setattr(shipped, "measure_answers", lambda *_, **__: {"best": 3.0})
    monkeypatch.setattr(shipped, "measure_photographs", lambda *_, **__: {"best": 4.0})
    main("mine", "orb", photographs=Path("somewhere"), photographs_alone=True)
    after = json.loads(results.read_text())
    assert after == {"mine": before["mine"] | {"photographs": {"best": 4.0}},
                     "cloth-orb": before["cloth-orb"] | {"photographs": {"best": 3.0}}}  # fmt: skip


def test_a_baseline_is_read_as_the_shipped_weights_are(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Sharp(Matcher):
        @classmethod
        def load(cls, path: Path) -> Matcher:
            matcher = Matcher.load(path)
            matcher.readout = dataclasses.replace(matcher.readout, mean_exponent=6.0)
            return matcher

    rows = [measure_baseline("orb", "cloth", root, progress=False)]
    monkeypatch.setattr(shipped, "Matcher", Sharp)
    rows.append(measure_baseline("orb", "cloth", root, progress=False))
    assert [row["sharpness"] for row in rows] == [1, 6]
    assert [shipped.name_read("cloth-orb", row) for row in rows] == ["cloth-orb", "cloth-orb@1,6"]
    assert rows[0]["paper"]["rmse_mean"] != rows[1]["paper"]["rmse_mean"]


def test_modes_are_not_read_flatter_from_a_name_either(root: Path) -> None:
    with pytest.raises(ValueError, match="exponent must .*got 0.5"):
        measure_read("mine@0.5,1", root, progress=False)
