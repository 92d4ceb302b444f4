"""The explorer answers clicks and drags, and its buttons change what is shown."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mmgsd.baselines import BaselineMatcher
from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.explorer import Explorer, Scene, make_own_scene, make_scenes
from mmgsd.matching import Matcher
from mmgsd.network import build_network

CONFIG = TrainConfig(input_px=64, descriptor_dim=4)


@pytest.fixture
def explorer(cloth_dataset: Path) -> Explorer:
    torch.manual_seed(0)
    matcher = Matcher(build_network("lite0", 4, pretrained=False), CONFIG, modes=4, size=(485, 485), device="cpu")
    scenes = make_scenes(load_dataset(cloth_dataset, "test"), pairs=3)
    return Explorer({"mmgsd": matcher, "sift": BaselineMatcher("sift", modes=4)}, scenes)


def click(explorer: Explorer, *xy: float) -> None:
    """What the browser sends for a press or a drag at a pixel."""
    explorer.pictures._handle_custom_msg({"xy": list(xy)}, [])


def read_target(explorer: Explorer) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(explorer.pictures.image1, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_a_click_changes_the_right_picture(explorer: Explorer) -> None:
    before = read_target(explorer)
    click(explorer, 240, 200)
    assert not np.array_equal(read_target(explorer), before)
    np.testing.assert_array_equal(explorer.answer.xy, [[240, 200]])
    assert explorer.pictures.marks["xy"] == [240, 200]
    assert "pixel (240, 200)" in explorer.line.value and " ms" in explorer.line.value
    assert len(explorer.pictures.marks["modes"]) == 4


def test_the_browser_hears_of_every_answer(explorer: Explorer, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = []
    monkeypatch.setattr(explorer.pictures, "send", sent.append)
    click(explorer, 240, 200)
    click(explorer, 240, 200)  # the same answer changes no trait
    monkeypatch.setattr(explorer, "ask", lambda x, y: 1 / 0)
    click(explorer, 240, 200)  # nor does none; its error is the notebook's to show
    assert sent == [{"answered": [240, 200]}] * 3


def test_modes_are_described_as_they_are(explorer: Explorer) -> None:
    answer = explorer.ask(240, 200)
    for k, mode in enumerate(explorer.pictures.marks["modes"]):
        np.testing.assert_allclose([mode["x"], mode["y"]], answer.modes[0, k])
        cos, sin = np.cos(mode["angle"]), np.sin(mode["angle"])
        turn = np.array([[cos, -sin], [sin, cos]])
        found = turn @ np.diag(np.square(mode["radii"])) @ turn.T
        np.testing.assert_allclose(found, answer.covariances[0, k], atol=0.1)


def test_the_answer_is_the_matchers(explorer: Explorer) -> None:
    answer = explorer.ask(240, 200)
    scene = explorer.scene
    expected = explorer.matchers["mmgsd"].match(scene.image0, scene.image1, [(240, 200)])
    np.testing.assert_allclose(answer.modes, expected.modes, atol=1e-3)


def test_true_matches_are_shown_near_a_material_point(explorer: Explorer) -> None:
    point = 30
    explorer.ask(*explorer.scene.xy0[point])
    np.testing.assert_allclose(explorer.pictures.marks["matches"], explorer.scene.orbits[point])
    explorer.ask(1, 1)  # on the background
    assert explorer.pictures.marks["matches"] == []


def test_buttons_hide_and_the_method_changes_the_answer(explorer: Explorer) -> None:
    explorer.ask(240, 200)
    trained = explorer.answer.modes
    explorer.method.value = "sift"
    assert not np.allclose(explorer.answer.modes, trained)
    for part in explorer.parts.values():
        part.value = False
    assert explorer.pictures.marks == {"xy": [240, 200], "modes": [], "matches": []}
    assert np.abs(read_target(explorer).astype(int) - explorer.scene.image1).mean() < 4  # JPEG


def test_pairs_go_round(explorer: Explorer) -> None:
    explorer.ask(240, 200)
    titles = [explorer.title.value]
    for _ in range(3):
        explorer.steps["next"].click()
        titles.append(explorer.title.value)
    assert titles[0] == titles[3] and len(set(titles)) == 3
    assert explorer.xy is None and explorer.pictures.marks["xy"] is None  # another pair has not been asked yet
    explorer.steps["previous"].click()
    assert explorer.title.value == titles[2]
    explorer.steps["random"].click()
    assert explorer.title.value in titles


def test_own_images_have_no_truth(explorer: Explorer, rng: np.random.Generator) -> None:
    scene = make_own_scene(rng.random((40, 60)), rng.integers(0, 255, (50, 30, 4), dtype=np.uint8))
    assert scene.image0.shape == (40, 60, 3) and scene.image1.shape == (50, 30, 3)
    assert len(scene.find_truth(np.array([5.0, 5.0]))) == 0
    own = Explorer({"mmgsd": explorer.matchers["mmgsd"]}, [scene])
    assert own.ask(5, 5).modes.shape == (1, 4, 2)


def test_nothing_to_explore_is_refused(explorer: Explorer) -> None:
    with pytest.raises(ValueError, match="must not be empty"):
        Explorer({}, [Scene(*np.zeros((2, 4, 4, 3), np.uint8))])
