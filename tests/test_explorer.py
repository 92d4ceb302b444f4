"""The explorer answers clicks and drags, and its buttons change what is shown."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from matplotlib.backend_bases import MouseEvent

from mmgsd.baselines import BaselineMatcher
from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.explorer import Explorer, Scene, make_own_scene, make_scenes
from mmgsd.matching import Matcher
from mmgsd.network import build_network

CONFIG = TrainConfig(input_px=64, descriptor_dim=4)


@pytest.fixture(autouse=True)
def close_figures() -> Iterator[None]:
    """An explorer's figure stays open as long as its notebook."""
    yield
    plt.close("all")


@pytest.fixture
def explorer(cloth_dataset: Path) -> Explorer:
    torch.manual_seed(0)
    matcher = Matcher(build_network("lite0", 4, pretrained=False), CONFIG, modes=4, size=(485, 485), device="cpu")
    scenes = make_scenes(load_dataset(cloth_dataset, "test"), pairs=3)
    return Explorer({"mmgsd": matcher, "sift": BaselineMatcher("sift", modes=4)}, scenes)


def send(explorer: Explorer, name: str, xy: tuple[float, float], side: int = 0, button: int | None = 1) -> None:
    """A mouse event at a pixel of one of the pictures."""
    canvas = explorer.figure.canvas
    canvas.draw()
    x, y = explorer.axes[side].transData.transform(xy)
    canvas.callbacks.process(name, MouseEvent(name, canvas, x, y, button))


def read_target(explorer: Explorer) -> np.ndarray:
    return np.array(explorer.axes[1].images[0].get_array())


def test_a_click_changes_the_right_picture(explorer: Explorer) -> None:
    before = read_target(explorer)
    send(explorer, "button_press_event", (240, 200))
    assert not np.array_equal(read_target(explorer), before)
    np.testing.assert_allclose(explorer.answer.xy, [[240, 200]], atol=0.01)
    assert "pixel (240, 200)" in explorer.line.value and " ms" in explorer.line.value
    assert len(explorer.axes[1].patches) == 4  # an ellipse a mode


def test_the_answer_is_the_matchers(explorer: Explorer) -> None:
    answer = explorer.ask(240, 200)
    scene = explorer.scene
    expected = explorer.matchers["mmgsd"].match(scene.image0, scene.image1, [(240, 200)])
    np.testing.assert_allclose(answer.modes, expected.modes, atol=1e-3)


def test_a_drag_answers_all_the_way_and_a_move_without_a_button_does_not(explorer: Explorer) -> None:
    send(explorer, "motion_notify_event", (240, 200), button=None)
    assert explorer.answer is None
    send(explorer, "motion_notify_event", (250, 210))
    np.testing.assert_allclose(explorer.answer.xy, [[250, 210]], atol=0.01)
    assert len(explorer.axes[0].collections) == 1  # the mark moves, it does not multiply


def test_the_right_picture_cannot_be_asked(explorer: Explorer) -> None:
    send(explorer, "button_press_event", (240, 200), side=1)
    assert explorer.answer is None


def test_true_matches_are_shown_near_a_material_point(explorer: Explorer) -> None:
    explorer.parts["modes"].value = False
    point = 30
    explorer.ask(*explorer.scene.xy0[point])
    (shown,) = explorer.axes[1].collections
    np.testing.assert_allclose(np.sort(shown.get_offsets(), 0), np.sort(explorer.scene.orbits[point], 0), atol=1e-4)
    explorer.ask(1, 1)  # on the background
    assert not explorer.axes[1].collections


def test_buttons_hide_and_the_method_changes_the_answer(explorer: Explorer) -> None:
    explorer.ask(240, 200)
    trained = explorer.answer.modes
    explorer.method.value = "sift"
    assert not np.allclose(explorer.answer.modes, trained)
    explorer.parts["heatmap"].value = explorer.parts["modes"].value = False
    assert not explorer.axes[1].patches
    np.testing.assert_array_equal(read_target(explorer), explorer.scene.image1)


def test_pairs_go_round(explorer: Explorer) -> None:
    explorer.ask(240, 200)
    titles = [explorer.axes[0].get_title()]
    for _ in range(3):
        explorer.steps["next"].click()
        titles.append(explorer.axes[0].get_title())
    assert titles[0] == titles[3] and len(set(titles)) == 3
    assert explorer.xy is None  # another pair has not been asked yet
    explorer.steps["previous"].click()
    assert explorer.axes[0].get_title() == titles[2]
    explorer.steps["random"].click()
    assert explorer.axes[0].get_title() in titles


def test_own_images_have_no_truth(explorer: Explorer, rng: np.random.Generator) -> None:
    scene = make_own_scene(rng.random((40, 60)), rng.integers(0, 255, (50, 30, 4), dtype=np.uint8))
    assert scene.image0.shape == (40, 60, 3) and scene.image1.shape == (50, 30, 3)
    assert len(scene.find_truth(np.array([5.0, 5.0]))) == 0
    own = Explorer({"mmgsd": explorer.matchers["mmgsd"]}, [scene])
    assert own.ask(5, 5).modes.shape == (1, 4, 2)


def test_nothing_to_explore_is_refused(explorer: Explorer) -> None:
    with pytest.raises(ValueError, match="must not be empty"):
        Explorer({}, [Scene(*np.zeros((2, 4, 4, 3), np.uint8))])
