"""The explorer answers clicks and drags, tells the browser which pair it means, and every error is heard of."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from PIL import Image

import mmgsd
from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.extras.explorer import DISPLAY_PX, MOST_PINS, Explorer, prepare_baseline, show_scene
from mmgsd.extras.explorer_scenes import Scene, choose_scenes, load_matchers, make_scenes
from mmgsd.match.baselines import BaselineMatcher
from mmgsd.match.describe import describe_answer
from mmgsd.match.matcher import Matcher
from mmgsd.model.network import build_network

CONFIG = TrainConfig(input_px=64, descriptor_dim=4)


@pytest.fixture
def explorer(cloth_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> Explorer:
    torch.manual_seed(0)
    matcher = Matcher(build_network("lite0", 4, pretrained=False), CONFIG, modes=4, size=(485, 485), device="cpu")
    scenes = make_scenes(load_dataset(cloth_dataset, "test"), pairs=3)
    explorer = Explorer({"mmgsd": matcher, "sift": BaselineMatcher("sift", modes=4)}, scenes)
    explorer.heard = []
    monkeypatch.setattr(explorer.pictures, "send", explorer.heard.append)
    return explorer


def tell(explorer: Explorer, do: str, *, buffers: tuple[bytes, ...] = (), **content: Any) -> str | None:
    """What the browser sends; the error that it hears of, if any."""
    content = {"do": do, "pair": explorer.pictures.pair["id"], "token": f"t{len(explorer.heard)}", **content}
    before = len(explorer.heard)
    explorer.pictures._handle_custom_msg(content, list(buffers))
    assert [told["token"] for told in explorer.heard[before:]] == [content["token"]]  # heard of once, whatever happened
    return explorer.heard[-1].get("error")


def encode(image: np.ndarray, kind: str = "PNG", **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, kind, **options)
    return buffer.getvalue()


def watch(explorer: Explorer, name: str) -> list[dict]:
    """Every value of a trait that goes to the browser from now on."""
    sent: list[dict] = []
    explorer.pictures.observe(lambda change: sent.append(change["new"]), name)
    return sent


def test_a_click_is_answered_for_its_pixel(explorer: Explorer) -> None:
    assert tell(explorer, "ask", xy=[240, 200]) is None
    answer = explorer.pictures.answer
    assert answer["pair"] == explorer.pictures.pair["id"]
    assert json.loads(answer["json"])[0]["xy"] == [240, 200]
    assert len(answer["points"]) == 1 and len(answer["points"][0]["ellipses"]) == 4
    assert len(answer["heat"]) == np.prod(answer["heat_size"]) and max(answer["heat"]) == 255
    assert answer["json"] == json.dumps(describe_answer(explorer.answer))  # as the command prints it
    scene = explorer.scene
    expected = explorer.matchers["mmgsd"].match(scene.image0, scene.image1, [(240, 200)])
    np.testing.assert_allclose(explorer.answer.modes, expected.modes, atol=1e-3)


def test_pins_of_every_left_image_are_its_marks(explorer: Explorer) -> None:
    one = explorer.scene.name0
    assert tell(explorer, "ask", xy=[240, 200], pin=True) is None
    assert tell(explorer, "ask", xy=[30, 20]) is None  # is no mark
    explorer.open_own(0, np.zeros((50, 60, 3), np.uint8), "towel.jpg")
    for x in (5, 6, 7, 8):
        assert tell(explorer, "ask", xy=[x, 9.06], pin=True) is None
    assert json.loads(explorer.pictures.marks) == [
        {"file": one, "kind": "cloth", "visible_corners_unordered": [[240, 200]]},
        {"file": "towel.jpg", "kind": "cloth", "corners": [[x, 9.1] for x in (5, 6, 7, 8)]},
    ]
    assert tell(explorer, "clear") is None
    assert [entry["file"] for entry in json.loads(explorer.pictures.marks)] == [one]


def test_every_answer_is_sent_though_it_be_the_same(explorer: Explorer) -> None:
    sent = watch(explorer, "answer")
    for _ in range(2):
        tell(explorer, "ask", xy=[240, 200])
    assert len(sent) == 2 and sent[0]["json"] == sent[1]["json"]


@pytest.mark.parametrize("to", ["next", "previous", "random"])
def test_every_step_sends_names_and_pictures_together(explorer: Explorer, to: str) -> None:
    sent = watch(explorer, "pair")
    for _ in range(4):  # with no click between: what is drawn over a pair does not decide whether it is sent
        assert tell(explorer, "step", to=to) is None
    assert len({pair["id"] for pair in sent}) == 4
    for pair in sent:
        scene = explorer.scenes[pair["number"] - 1]()
        assert pair["names"] == [scene.name0, scene.name1]
        shown = cv2.imdecode(np.frombuffer(pair["image0"], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.abs(shown - scene.image0.astype(float)).mean() < 4  # JPEG
    numbers = [pair["number"] for pair in sent]
    assert all(one != other for one, other in zip(numbers, numbers[1:], strict=False))


def test_a_click_on_a_pair_that_is_gone_is_not_answered(explorer: Explorer) -> None:
    seen = explorer.pictures.pair["id"]
    tell(explorer, "step", to="next")
    sent = watch(explorer, "answer")
    assert tell(explorer, "ask", xy=[240, 200], pair=seen) is None
    assert sent == [] and explorer.answer is None
    tell(explorer, "ask", xy=[240, 200])
    assert [answer["pair"] for answer in sent] == [explorer.pictures.pair["id"]]


@pytest.mark.parametrize(("error", "heard"), [
    (ValueError("modes must be\nat least 1"), "modes must be at least 1"),
    (FileNotFoundError("a.webp is gone"), "a.webp is gone"),
    (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
])  # fmt: skip
def test_an_error_is_said_in_a_sentence_and_the_next_click_answered(
    explorer: Explorer, monkeypatch: pytest.MonkeyPatch, error: Exception, heard: str
) -> None:
    def fail(*args: Any) -> None:
        raise error

    with monkeypatch.context() as broken:
        broken.setattr(explorer, "_answer", fail)
        assert tell(explorer, "ask", xy=[240, 200]) == heard
    assert tell(explorer, "ask", xy=[240, 200]) is None
    assert explorer.answer is not None


@pytest.mark.parametrize(
    "content", [{"do": "dance"}, {"do": "ask", "xy": [1e9, 0]}, {"do": "ask"}, {"do": "step", "to": 3}]
)
def test_messages_that_make_no_sense_are_said_to_be_wrong(explorer: Explorer, content: dict) -> None:
    assert tell(explorer, **content)
    assert tell(explorer, "ask", xy=[240, 200]) is None


def test_a_pair_that_cannot_be_read_leaves_the_last_one(explorer: Explorer) -> None:
    def fail() -> Scene:
        raise ValueError("images/7.webp is truncated")

    explorer.scenes[1], before = fail, explorer.pictures.pair
    assert tell(explorer, "step", to="next") == "images/7.webp is truncated"
    assert explorer.pictures.pair == before and explorer.index == 0
    assert tell(explorer, "ask", xy=[240, 200]) is None


def test_ellipses_are_the_modes_as_they_are(explorer: Explorer) -> None:
    answer = explorer.ask(240, 200)
    for k, mode in enumerate(explorer.pictures.answer["points"][0]["ellipses"]):
        np.testing.assert_allclose([mode["x"], mode["y"]], answer.modes[0, k])
        cos, sin = np.cos(mode["angle"]), np.sin(mode["angle"])
        turn = np.array([[cos, -sin], [sin, cos]])
        found = turn @ np.diag(np.square([mode["major"], mode["minor"]])) @ turn.T
        np.testing.assert_allclose(found, answer.covariances[0, k], atol=0.1)


def test_true_matches_are_shown_near_a_material_point(explorer: Explorer) -> None:
    point = 30
    explorer.ask(*explorer.scene.xy0[point])
    np.testing.assert_allclose(explorer.pictures.answer["points"][0]["matches"], explorer.scene.orbits[point])
    explorer.ask(1, 1)  # on the background
    assert explorer.pictures.answer["points"][0]["matches"] == []


def test_pinned_points_stay_until_they_are_cleared_or_the_pair_changes(explorer: Explorer) -> None:
    tell(explorer, "ask", xy=[240, 200], pin=True)
    tell(explorer, "ask", xy=[200, 210], pin=True)
    tell(explorer, "ask", xy=[220, 230])
    tell(explorer, "ask", xy=[230, 230])  # a click replaces the last click only
    xy = [query["xy"] for query in json.loads(explorer.pictures.answer["json"])]
    assert xy == [[240, 200], [200, 210], [230, 230]] and len(explorer.pictures.answer["points"]) == 3
    tell(explorer, "clear")
    assert explorer.pictures.answer["json"] == "[]" and explorer.points == []
    tell(explorer, "ask", xy=[240, 200], pin=True)
    tell(explorer, "step", to="next")
    assert explorer.points == [] and explorer.pictures.answer["pair"] != explorer.pictures.pair["id"]


def test_there_are_as_many_pins_as_colours(explorer: Explorer) -> None:
    for k in range(MOST_PINS):
        assert tell(explorer, "ask", xy=[240, 200 + k], pin=True) is None
    assert "clear them first" in tell(explorer, "ask", xy=[1, 1], pin=True)
    assert len(explorer.points) == MOST_PINS


def test_another_method_answers_for_the_same_points(explorer: Explorer) -> None:
    tell(explorer, "ask", xy=[240, 200], pin=True)
    trained = explorer.answer.modes
    assert tell(explorer, "method", name="sift") is None
    assert explorer.pictures.method == "sift"
    assert explorer.answer.xy.tolist() == [[240, 200]] and not np.allclose(explorer.answer.modes, trained)


def test_points_are_answered_together_where_the_weights_can(explorer: Explorer) -> None:
    tell(explorer, "ask", xy=[240, 200], pin=True)
    assert tell(explorer, "together", on=True).startswith("together must be off for MMGSD")  # it knows no mask
    assert explorer.pictures.together is False and explorer.pictures.answer["joint"] == []
    explorer.matchers["mmgsd"] = mmgsd.load("cloth")
    explorer._prepared.clear()
    assert tell(explorer, "together", on=True) is None
    assert tell(explorer, "ask", xy=[200, 240], pin=True) is None
    sent = explorer.pictures.answer
    assert len(sent["joint"]) == 4 and sum(sent["joint"]) == pytest.approx(1, abs=1e-3)
    assert [[mode["answer"] for mode in query["modes"]] for query in json.loads(sent["json"])] == [[1, 2, 3, 4]] * 2
    assert tell(explorer, "method", name="sift").startswith("together must be off for SIFT")
    assert explorer.pictures.method == "mmgsd" and tell(explorer, "together", on=False) is None
    assert "answer" not in json.loads(explorer.pictures.answer["json"])[0]["modes"][0]


def test_places_are_asked_for_on_the_object_laid_flat(explorer: Explorer) -> None:
    assert "do not know the object's places" in tell(explorer, "flat")
    assert explorer.pictures.pair["count"] == 3 and not explorer.scene.flat
    knowing, right, orbits = explorer.matchers["mmgsd"], explorer.scene.image1, explorer.scene.orbits
    knowing.places = torch.rand(625, 4, generator=torch.Generator().manual_seed(0))
    assert tell(explorer, "flat") is None
    pair = explorer.pictures.pair
    assert pair["names"][0] == "cloth, laid flat" and pair["number"] == pair["count"] == 4 and pair["truth"]
    corner = explorer.scene.xy0[0].tolist()
    assert tell(explorer, "ask", xy=corner, pin=True) is None
    assert explorer.pictures.answer["points"][0]["matches"] == orbits[0].tolist()
    expected = knowing.find(right, "corners")
    np.testing.assert_allclose(explorer.answer.modes, expected.modes, atol=1e-3)
    assert explorer.pictures.marks == "[]"  # it is no photograph
    assert tell(explorer, "together", on=True) is None and explorer.answer.joint_weights is not None
    assert tell(explorer, "together", on=False) is None
    assert tell(explorer, "method", name="sift").startswith("laid flat must be off for SIFT")
    image = explorer.scene.image1[:, ::-1]
    assert tell(explorer, "file", side=1, name="b.png", part=0, parts=1, buffers=(encode(image),)) is None
    assert explorer.scene.flat and not explorer.pictures.pair["truth"] and tell(explorer, "ask", xy=corner) is None
    assert tell(explorer, "file", side=0, name="a.png", part=0, parts=1, buffers=(encode(image),)) is None
    assert not explorer.scene.flat and tell(explorer, "method", name="sift") is None


@pytest.mark.parametrize("asked", [False, True])
def test_where_no_widget_can_be_shown_there_is_a_picture(explorer: Explorer, asked: bool) -> None:
    if asked:
        explorer.ask(240, 200)
    data, _ = explorer.show()._repr_mimebundle_()
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data["image/jpeg"]))))
    assert "application/vnd.jupyter.widget-view+json" in data
    assert picture.shape[1] > 400 and picture.std() > 20
    assert plt.get_fignums() == []


def test_a_method_that_fails_is_not_taken(explorer: Explorer) -> None:
    explorer.ask(240, 200)
    explorer._prepared["sift"] = lambda xy, **_: 1 / 0
    assert "ZeroDivisionError" in tell(explorer, "method", name="sift")
    assert explorer.pictures.method == "mmgsd" and explorer.answer is not None
    assert "must be one of 'mmgsd', 'sift'" in tell(explorer, "method", name="dino")


def test_files_chosen_on_the_page_become_the_pair(explorer: Explorer, rng: np.random.Generator) -> None:
    images = rng.integers(0, 255, (2, 60, 80, 3), dtype=np.uint8)
    data = encode(images[0])
    for part, piece in enumerate((data[:100], data[100:])):
        assert tell(explorer, "file", side=0, name="a<b>.png", part=part, parts=2, buffers=(piece,)) is None
    assert explorer.pictures.pair["names"][0] == "a<b>.png" and explorer.pictures.pair["truth"] is False
    assert tell(explorer, "file", side=1, name="b.png", part=0, parts=1, buffers=(encode(images[1]),)) is None
    pair = explorer.pictures.pair
    assert pair["names"] == ["a<b>.png", "b.png"] and pair["number"] == pair["count"] == 4
    np.testing.assert_array_equal([explorer.scene.image0, explorer.scene.image1], images)
    assert tell(explorer, "ask", xy=[5, 5]) is None
    assert tell(explorer, "method", name="sift") is None  # without a mask


def test_a_file_that_is_no_image_is_said_and_nothing_changes(explorer: Explorer) -> None:
    before = explorer.pictures.pair
    heard = tell(explorer, "file", side=1, name="IMG_1.HEIC", part=0, parts=1, buffers=(b"\0\0\0\x18ftypheic",))
    assert heard.startswith("IMG_1.HEIC is a HEIC image") and "PNG, JPEG" in heard
    assert explorer.pictures.pair == before


def test_a_large_photograph_is_sent_small_and_asked_about_in_its_own_pixels(explorer: Explorer) -> None:
    large = np.tile(np.arange(0, 256, dtype=np.uint8)[:, None, None], (12, 4000, 3))
    scene = Scene(large, large)
    shown = show_scene(scene)
    assert shown["sizes"] == [[4000, 3072]] * 2 and len(shown["image0"]) < 1e6
    small = cv2.imdecode(np.frombuffer(shown["image1"], np.uint8), cv2.IMREAD_COLOR)
    assert max(small.shape) == DISPLAY_PX
    own = Explorer({"mmgsd": explorer.matchers["mmgsd"], "sift": explorer.matchers["sift"]}, [scene])
    for method in own.matchers:
        own.choose("method", method)
        answer = own.ask(3990, 3000)
        assert answer.image1.shape == large.shape and answer.modes.max() > DISPLAY_PX
    assert own.milliseconds < 20_000


def test_hand_made_descriptors_answer_the_same_for_an_enlarged_image(explorer: Explorer) -> None:
    scene, sift = explorer.scene, explorer.matchers["sift"]
    twice = [cv2.resize(image, None, fx=4, fy=4, interpolation=0) for image in (scene.image0, scene.image1)]
    large = Scene(
        *twice, mask1=cv2.resize(scene.mask1.astype(np.uint8), None, fx=4, fy=4, interpolation=0).astype(bool)
    )
    middle = [cv2.resize(image, (640, 640), interpolation=cv2.INTER_AREA) for image in twice]
    mask = cv2.resize(scene.mask1.astype(np.uint8), (640, 640), interpolation=0).astype(bool)
    xy, ratio = np.array([[240.0, 200.0]]), 640 / 485
    found = prepare_baseline(sift, large)((xy + 0.5) * 4 - 0.5)
    expected = sift.match(*middle, (xy + 0.5) * ratio - 0.5, mask1=mask)
    scale = 4 / ratio
    np.testing.assert_allclose((found.modes + 0.5) / scale - 0.5, expected.modes, atol=3)
    np.testing.assert_allclose(found.entropy, expected.entropy, atol=0.1)


def test_nothing_to_explore_is_refused() -> None:
    with pytest.raises(ValueError, match="must not be empty"):
        Explorer({}, [Scene(*np.zeros((2, 4, 4, 3), np.uint8))])


@pytest.mark.parametrize("name", ["cloth", "rope"])
def test_every_shipped_model_of_the_object_is_offered(name: str) -> None:
    matchers = load_matchers(name)
    shipped = list(matchers)[:3]
    assert shipped == ["MMGSD, shipped", "MMGSD", "SPCL"] and "SIFT" in matchers
    assert {matchers[label].config.object for label in shipped} == {name}


@pytest.mark.parametrize(("arguments", "message"), [
    (("clth",), "name must be one of 'cloth', 'rope' .*, got 'clth'"),
    (("cloth", "tiny"), "preset must be one of 'sample', .* got 'tiny'"),
    (("cloth", "sample", ["a.jpg"]), "own_images must be .* two image files, got .'a.jpg'"),
])  # fmt: skip
def test_wrong_parameters_are_named(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        choose_scenes(*arguments)


def test_own_files_are_a_pair(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode(np.zeros((20, 30, 3), np.uint8)))
    (scene,) = choose_scenes("rope", own_images=[tmp_path / "a.png"] * 2)
    assert (scene.name0, scene.name1) == ("a.png", "a.png") and scene.image0.shape == (20, 30, 3)
