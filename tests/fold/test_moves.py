"""From a demonstration to picks and places in another picture: the shipped cloth on the sample's images."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mmgsd
from mmgsd.__main__ import main
from mmgsd.dataset import load_dataset
from mmgsd.fold import moves
from mmgsd.fold.consensus import Motion, to_complex, to_points
from mmgsd.fold.demonstration import Demonstration, Look, read_demonstration, write_demonstration
from mmgsd.fold.moves import AGREE, BEST, PolicyAnswer, answer_picture, choose_moves
from mmgsd.match.match import Match

SAMPLE = Path(__file__).parents[2] / "data" / "sample" / "cloth"
DEMO, NOW = 4, 5  # test images of the sample: a flat cloth, and a wrinkled one
CORNERS, INSIDE = [26, 46], [574, 594, 300, 324]
CAMERA = Motion(2 * np.exp(0.4j), 30 + 20j)


@pytest.fixture(scope="module")
def data():
    return load_dataset(SAMPLE, "test")


@pytest.fixture(scope="module")
def demonstration(data) -> Demonstration:
    """The first row's corners laid on the last row's."""
    xy = data.xy[DEMO].astype(float)
    look = Look(data.load_image(DEMO), np.stack([xy[CORNERS], xy[[576, 598]]], 1), xy[INSIDE])
    return Demonstration("cloth", (look,))


@pytest.fixture(scope="module")
def written(demonstration, tmp_path_factory) -> Path:
    return write_demonstration(demonstration, tmp_path_factory.mktemp("demo") / "edge.json")


def find_error(data, picks: np.ndarray) -> float:
    """px to the picked points, the least over the symmetry group."""
    group = data.group("c4").permutations
    return min(np.linalg.norm(picks - data.xy[NOW][order[CORNERS]], axis=1).max() for order in group)


def test_two_corners_of_one_edge_are_found_again(data, demonstration) -> None:
    answer = answer_picture(mmgsd.load("cloth"), demonstration, data.load_image(NOW))
    assert answer.share == 1 and find_error(data, answer.moves[:, 0]) < 15
    length = np.linalg.norm(answer.moves[:, 1] - answer.moves[:, 0], axis=1)
    assert length.min() > 0.7 * np.linalg.norm(answer.moves[1, 0] - answer.moves[0, 0])


def test_the_surest_modes_of_a_picture_are_those_of_each_pixel(data, demonstration) -> None:
    matcher, image, look = mmgsd.load("cloth"), data.load_image(NOW), demonstration.looks[0]
    answer = answer_picture(matcher, demonstration, image, chosen=BEST)
    surest = matcher.match(look.image, image, look.asked).best().xy[: len(look.moves)]
    np.testing.assert_allclose(answer.moves[:, 0], surest)
    with pytest.raises(ValueError, match="chosen must .*got 'first'"):
        answer_picture(matcher, demonstration, image, chosen="first")


def test_places_by_name_need_no_look_at_the_demonstrations_picture(data, demonstration, written, capsys) -> None:
    matcher, image, look = mmgsd.load("cloth"), data.load_image(NOW), demonstration.looks[0]
    blank = dataclasses.replace(look, image=np.zeros_like(look.image), places=(*CORNERS, *INSIDE))
    with pytest.raises(ValueError, match="places must be named"):
        answer_picture(matcher, demonstration, image, by_name=True)
    with pytest.raises(ValueError, match="do not know the object's places"):
        answer_picture(mmgsd.load("cloth-paper"), Demonstration("cloth", (blank,)), image, by_name=True)
    answer = answer_picture(matcher, Demonstration("cloth", (blank,)), image, by_name=True)
    assert answer.share == 1 and find_error(data, answer.moves[:, 0]) < 15
    with pytest.raises(SystemExit) as stopped:
        main(["fold", str(written), str(SAMPLE / data.labels.file[NOW]), "--weights", "cloth", "--by-name"])
    assert stopped.value.code == 2 and "places must be named" in capsys.readouterr().err


def test_the_command_prints_pixels_and_rays(data, written, capsys) -> None:
    image = str(SAMPLE / data.labels.file[NOW])
    asked = ["fold", str(written), image, "--weights", "cloth", "--json", "--intrinsics"]
    main([*asked, "900,900,242,242"])
    said = json.loads(capsys.readouterr().out)
    main([*asked, "900,0,242,0,900,242,0,0,1"])
    assert json.loads(capsys.readouterr().out) == said
    assert said["agreement"] == 1 and find_error(data, np.array([move["pick"] for move in said["moves"]])) < 15
    assert all(np.linalg.norm(move[ray]) == pytest.approx(1, abs=1e-4)
               for move in said["moves"] for ray in ("pick_ray", "place_ray"))  # fmt: skip
    main(["fold", str(written), image, "--weights", "cloth"])
    assert capsys.readouterr().out.startswith("pick ")


def fail(capsys, *arguments: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        main(["fold", *arguments])
    assert stopped.value.code == 2
    return capsys.readouterr().err


def test_what_cannot_be_answered_is_said(data, written, capsys, tmp_path) -> None:
    image = str(SAMPLE / data.labels.file[NOW])
    assert "look must be" in fail(capsys, str(written), image, "--weights", "cloth", "--look", "1")
    assert "'cloth', got weights of 'rope'" in fail(capsys, str(written), image, "--weights", "rope")
    assert "--intrinsics" in fail(capsys, str(written), image, "--weights", "cloth", "--intrinsics", "9,9,9")
    assert "nowhere.json" in fail(capsys, str(tmp_path / "nowhere.json"), image, "--weights", "cloth")


def test_corners_alone_are_picked_apart_and_no_pick_takes_anothers_place(data) -> None:
    matcher, xy = mmgsd.load("cloth"), data.xy[DEMO].astype(float)
    corners = xy[[0, 24, 624, 600]]  # all of them alike
    look = Look(data.load_image(DEMO), np.stack([corners[:2], corners[[3, 2]]], 1), corners[2:])
    demonstration, side = Demonstration("cloth", (look,)), np.linalg.norm(corners[1] - corners[0])
    large = np.asarray(Image.fromarray(data.load_image(NOW)).resize((2000, 2000)))
    small = np.full_like(data.load_image(NOW), 120)  # as from farther away
    small[80:380, 90:390] = np.asarray(Image.fromarray(data.load_image(NOW)).resize((300, 300)))
    for image, factor in ((data.load_image(DEMO), 1.0), (data.load_image(NOW), 1.0), (large, 2000 / 485),
                          (small, 300 / 485)):  # fmt: skip
        answer = answer_picture(matcher, demonstration, image)
        picks = answer.moves[:, 0]
        assert 0.6 * side < np.linalg.norm(picks[1] - picks[0]) / factor < 1.2 * side
        gap = np.linalg.norm(answer.motion.apply(look.moves[:, 0]) - picks, axis=1)
        assert gap.max() < 0.2 * side * factor  # the motion is that of the demonstration's own pixels
    with pytest.raises(ValueError, match="'best' they are at one place, .* choose another of"):
        edge = read_demonstration(SAMPLE.parents[1] / "demonstrations" / "edge.json")
        answer_picture(matcher, edge, data.load_image(NOW), chosen=BEST)  # the surest corner, each time


def test_a_pick_without_an_answer_is_said(data, demonstration, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = PolicyAnswer(np.zeros((0, 2, 2)), None, 0.0)
    monkeypatch.setattr(moves, "choose_moves", lambda *_, **__: nothing)
    with pytest.raises(ValueError, match="must agree with the demonstration, 0% of them do"):
        answer_picture(mmgsd.load("cloth"), demonstration, data.load_image(NOW), chosen=BEST)


def test_an_empty_table_and_a_pick_beside_the_cloth_are_no_answers(data, demonstration) -> None:
    matcher, look = mmgsd.load("cloth"), demonstration.looks[0]
    with pytest.raises(ValueError, match="the picture must show a cloth|must agree with the demonstration"):
        answer_picture(matcher, demonstration, np.full((485, 485, 3), 90, np.uint8))
    beside = Look(look.image, np.array([[[2.0, 2.0], [100, 100]]]), look.anchors)
    with pytest.raises(ValueError, match=r"on the object of the demonstration, these are not: \[\[2.0, 2.0\]\]"):
        answer_picture(matcher, Demonstration("cloth", (beside,)), data.load_image(NOW))


def make_match(modes: np.ndarray) -> Match:
    """An answer of equally probable modes (S, n, 2), the first the narrowest."""
    count, n = modes.shape[:2]
    image = np.zeros((8, 8, 3), np.uint8)
    covariances = np.eye(2) * (1.0 + np.arange(n))[:, None, None] * np.ones((count, 1, 1, 1))
    heatmap = np.full((count, 2, 2), 0.25)
    return Match(image, image, np.zeros((count, 2)), modes, np.full((count, n), 1 / n), covariances, np.zeros(count),
                 np.zeros(count), heatmap)  # fmt: skip


LOOK = Look(np.zeros((8, 8, 3), np.uint8), np.array([[[0.0, 0.0], [0.0, 9.0]], [[10.0, 0], [10.0, 9.0]]]),
            np.array([[10.0, 10.0], [0.0, 10.0]]))  # fmt: skip


def turn_all(turns: np.ndarray) -> np.ndarray:
    """Modes (S, 4, 2) of the square's corners under the camera, the first of each turned by so many quarters."""
    centred = to_complex(LOOK.asked - (5, 5))
    modes = np.stack([centred * 1j ** (turns + k) for k in range(4)], 1)
    return CAMERA.apply(to_points(modes))


def choose(modes: np.ndarray, chosen: str = AGREE) -> PolicyAnswer:
    return choose_moves(LOOK, make_match(modes), chosen, lambda xy: xy - (5, 5), np.asarray, free_scale=True)


MIXED = np.array([0, 1, 3, 2])  # each question's own first mode is turned otherwise


def test_modes_that_agree_are_picked_and_places_go_with_them() -> None:
    answer = choose(turn_all(MIXED))
    assert answer.share == 1
    np.testing.assert_allclose(answer.moves, answer.motion.apply(LOOK.moves - (5, 5)), atol=1e-6)
    quarters = np.angle(answer.motion.factor / CAMERA.factor) / (np.pi / 2)
    assert quarters == pytest.approx(round(quarters), abs=1e-6)


def test_each_pixels_surest_mode_may_belong_to_another_turn() -> None:
    np.testing.assert_allclose(choose(turn_all(MIXED), BEST).moves[:, 0], turn_all(MIXED)[:2, 0])
    alike = choose(turn_all(np.zeros(4)), BEST)
    np.testing.assert_allclose(alike.moves, CAMERA.apply(LOOK.moves - (5, 5)), atol=1e-6)


def test_a_hidden_pick_is_where_the_motion_takes_it() -> None:
    modes = turn_all(np.zeros(4))
    modes[0] = np.nan
    answer = choose(modes)
    np.testing.assert_allclose(answer.moves[0, 0], answer.motion.apply(LOOK.moves[0, 0] - (5, 5)), atol=1e-6)
    assert answer.share == 0.75


def test_no_answer_moves_nothing() -> None:
    empty = make_match(np.full((4, 4, 2), np.nan))
    for chosen in (AGREE, BEST):
        answer = choose_moves(LOOK, empty, chosen, np.asarray, np.asarray)
        assert answer.moves.shape == (0, 2, 2) and answer.motion is None and answer.share == 0


def test_of_an_object_bent_otherwise_each_pick_takes_its_nearest_mode() -> None:
    asked = np.array([[-8.0, 0], [8, 0], [-4, 0], [-2, 0], [2, 0], [4, 0]])
    bent = np.array([[-2.0, 7], [2, 7], [-4, 3.5], [-2.5, 1], [2.5, 1], [4, 3.5]])
    look = Look(LOOK.image, np.stack([asked[:2], [[-1.0, 0], [1, 0]]], 1), asked[2:])
    turned = bent[[1, 0, 5, 4, 3, 2]]
    answer = choose_moves(look, make_match(np.stack([bent, turned], 1)), AGREE, np.asarray, np.asarray)
    assert 0 < answer.share < 0.7
    assert sorted(answer.moves[:, 0].tolist()) == [[-2, 7], [2, 7]]
    np.testing.assert_allclose(answer.moves[:, 1], answer.motion.apply(look.moves[:, 1]))


def test_the_command_draws_the_moves_and_replaces_no_image(data, written, capsys, tmp_path) -> None:
    image = SAMPLE / data.labels.file[NOW]
    out = tmp_path / "moves.png"
    main(["fold", str(written), str(image), "--weights", "cloth", "--out", str(out)])
    assert out.read_bytes().startswith(b"\x89PNG") and capsys.readouterr().out.startswith("pick ")
    copy = tmp_path / "now.png"
    copy.write_bytes(out.read_bytes())
    said = fail(capsys, str(written), str(copy), "--weights", "cloth", "--out", str(copy))
    assert "--out must not be " in said and copy.read_bytes() == out.read_bytes()
