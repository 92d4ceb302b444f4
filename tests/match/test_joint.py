"""Joint answers: shuffled modes of a smooth map are sorted again, whatever the object, and bad input is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

import mmgsd
from mmgsd.config import DEFAULT_GROUP, TrainConfig
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match import joint
from mmgsd.match.joint import join, predict, spread_places
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher
from mmgsd.model.network import build_network

ROOT = Path(__file__).parents[2]
SIDE = 200  # px of the square object
MASK = np.zeros((260, 260), bool)
MASK[30 : 30 + SIDE, 30 : 30 + SIDE] = True
MIDDLE = np.array([129.5, 129.5])


def turn_square(xy: np.ndarray, *, bend: float = 0.0) -> np.ndarray:
    """(S, 4, 2): where the four rotations of a square take points, bent by a wave of ``bend`` px."""
    around = xy - MIDDLE
    turned = [around @ np.linalg.matrix_power([[0, -1], [1, 0]], k) for k in range(4)]
    moved = np.stack(turned, 1) + MIDDLE
    return moved + bend * np.sin(moved[..., ::-1] / 40)


def shuffle(modes: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Modes in another order for each place, and that order (S, n)."""
    order = np.array([rng.permutation(modes.shape[1]) for _ in modes])
    return np.take_along_axis(modes, order[..., None], 1), order


def sort(xy: np.ndarray, modes: np.ndarray, mask: np.ndarray, places: int) -> np.ndarray:
    spread = np.full(modes.shape[:2], 5.0)
    return join(xy, mask, modes, np.full(modes.shape[:2], 1 / modes.shape[1]), spread, places=places)


def count_right(order: np.ndarray, shuffled: np.ndarray) -> float:
    """Share of places whose maps are those of the most, each map another member."""
    member = np.take_along_axis(shuffled, order, 1)
    most = np.array([np.bincount(column, minlength=order.shape[1]).argmax() for column in member.T])
    return float((member == most).all(1).mean()) if len(set(most)) == order.shape[1] else 0.0


@pytest.mark.parametrize("bend", [0.0, 15.0])
@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_shuffled_modes_of_a_square_are_sorted(rng: np.random.Generator, bend: float, noise: float) -> None:
    xy = np.concatenate([rng.uniform(31, 228, (5, 2)), spread_places(MASK)])
    true = turn_square(xy, bend=bend) + noise * rng.normal(size=(len(xy), 4, 2))
    modes, shuffled = shuffle(true, rng)
    assert count_right(sort(xy, modes, MASK, len(xy) - 5), shuffled) > 0.9


def test_more_questions_than_are_sorted_at_once_are_under_the_same_members(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(joint, "QUESTIONS", 7)
    xy = np.concatenate([rng.uniform(31, 228, (30, 2)), spread_places(MASK)])
    modes, shuffled = shuffle(turn_square(xy), rng)
    order = sort(xy, modes, MASK, len(xy) - 30)
    assert order.shape == (len(xy), 4) and count_right(order, shuffled) > 0.9


def test_maps_lead_where_a_wrong_mode_ought_to_be(rng: np.random.Generator) -> None:
    xy = spread_places(MASK)
    true = turn_square(xy, bend=15.0)
    modes = true.copy()
    modes[7, 2] = modes[7, 0]
    modes[9] = np.nan
    there = predict(xy, MASK, modes, np.full(modes.shape[:2], 5.0))
    errors = np.linalg.norm(there - true, axis=-1)
    assert errors[[7, 9]].max() < 0.05 * SIDE and np.median(errors) < 0.05 * SIDE


def test_a_rope_s_halves_are_told_apart_where_its_maps_cross(rng: np.random.Generator) -> None:
    mask = np.zeros((60, 400), bool)
    mask[25:35, 20:380] = True
    xy = spread_places(mask)
    along = (xy[:, 0] - 20) / 360
    ends = [np.stack([40 + 320 * t, 200 + 60 * np.sin(5 * t)], 1) for t in (along, 1 - along)]
    modes, shuffled = shuffle(np.stack(ends, 1), rng)
    order = sort(xy, modes, mask, len(xy))
    clear = np.abs(along - 0.5) > 0.1  # in the middle both are one
    assert count_right(order[clear], shuffled[clear]) > 0.9


def test_a_shirt_and_its_mirror_image_are_told_apart(rng: np.random.Generator) -> None:
    mask = np.zeros((260, 260), bool)
    mask[60:110, 20:240] = True  # sleeves
    mask[60:240, 80:180] = True
    xy = spread_places(mask)
    mirrored = np.stack([259 - xy[:, 0], xy[:, 1]], 1)  # both maps are one along the middle
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    modes, shuffled = shuffle(np.stack([xy, mirrored], 1) @ turn + 300, rng)
    order, clear = sort(xy, modes, mask, len(xy)), np.abs(xy[:, 0] - 129.5) > 15
    assert count_right(order[clear], shuffled[clear]) > 0.9


def test_parts_that_nothing_joins_are_sorted_too(rng: np.random.Generator) -> None:
    mask = MASK.copy()
    mask[:, 120:140] = False  # a gripper in front
    xy = spread_places(mask)
    modes, shuffled = shuffle(turn_square(xy), rng)
    assert count_right(sort(xy, modes, mask, len(xy)), shuffled) > 0.8


def test_modes_that_are_not_there_fit_anywhere(rng: np.random.Generator) -> None:
    xy = spread_places(MASK)
    modes, shuffled = shuffle(turn_square(xy), rng)
    modes[::7, 2] = np.nan
    order = sort(xy, modes, MASK, len(xy))
    assert (np.sort(order, 1) == np.arange(4)).all() and count_right(order[1::7], shuffled[1::7]) > 0.8


@pytest.mark.parametrize(("count", "n"), [(0, 4), (1, 4), (2, 4), (5, 1)])
def test_where_nothing_can_be_told_modes_keep_their_order(rng: np.random.Generator, count: int, n: int) -> None:
    order = sort(rng.uniform(40, 200, (count, 2)), rng.uniform(40, 200, (count, n, 2)), MASK, 0)
    assert order.tolist() == [list(range(n))] * count


@pytest.mark.parametrize("count", [1, 16, 64])
def test_places_lie_on_the_object_and_apart(count: int) -> None:
    places = spread_places(MASK, count)
    columns, rows = places.astype(int).T
    assert len(places) == count and MASK[rows, columns].all()
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) + 1e9 * np.eye(count)
    assert count == 1 or gaps.min() > 0.4 * SIDE / np.sqrt(count)
    assert len(spread_places(np.zeros((9, 9), bool))) == 0


# The matcher. -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["cloth", "rope"])
def data(request: pytest.FixtureRequest) -> Dataset:
    return load_dataset(ROOT / "data" / "sample" / request.param, "test")


@pytest.fixture(scope="module")
def asked(data: Dataset) -> tuple[Match, Match, np.ndarray]:
    """A joint answer and one query by query about the same pixels of two sample images, and their material points."""
    points = np.flatnonzero(data.visible[0])[::60]
    images = data.load_image(0), data.load_image(1)
    matcher = mmgsd.load(data.object)
    together, alone = (matcher.match(*images, data.xy[0][points], joint=on) for on in (True, False))
    return together, alone, points


def test_a_joint_answer_holds_the_same_modes_in_another_order(asked) -> None:
    together, alone, _ = asked
    apart = np.isfinite(alone.modes).all((1, 2))  # no two modes on one spot, which are one where they answer alone
    assert apart.mean() > 0.5
    for name in ("weights", "visible", "spread_px"):
        one, other = (np.sort(getattr(match[apart], name), 1) for match in (together, alone))
        np.testing.assert_allclose(one, other, rtol=0.01)
    assert alone.joint_weights is None and together.joint_weights.sum() == pytest.approx(1)
    assert (np.diff(together.joint_weights) <= 1e-6).all()


def test_a_joint_answer_is_of_one_member_more_often_than_the_heaviest_modes(data: Dataset, asked) -> None:
    together, alone, points = asked
    true = data.xy[1][np.array(data.group(DEFAULT_GROUP[data.object]).permutations)[:, points]].astype(float)
    near = [np.linalg.norm(match.modes[None, :, 0] - true, axis=-1) < 30 for match in (together, alone)]  # (G, S)
    assert near[0].mean(1).max() > near[1].mean(1).max()


def test_best_of_a_joint_answer_is_of_one_member(asked) -> None:
    together, *_ = asked
    xy = together.best().xy
    same = (np.linalg.norm(together.modes - xy[:, None], axis=-1) < 1e-3) | np.isnan(xy).any(1)[:, None]
    assert same.all(0).any()
    assert together[:2].joint_weights is together.joint_weights


def test_fewer_joint_answers_are_the_first(data: Dataset, asked) -> None:
    together, _, points = asked
    images = data.load_image(0), data.load_image(1)
    one = mmgsd.load(data.object).match(*images, data.xy[0][points], joint=True, n=1)
    np.testing.assert_allclose(one.modes[:, 0], together.modes[:, 0], atol=1e-3)
    assert one.weights.tolist() == [[1.0]] * len(points) and one.joint_weights.tolist() == [1.0]


@pytest.mark.parametrize("n", [0, 5, "auto", [1, 2], True])
def test_joint_answers_are_as_many_as_the_group_has_members(n: object) -> None:
    image = np.zeros((128, 128, 3), np.uint8)
    with pytest.raises(ValueError, match="n must"):
        mmgsd.load("cloth").match(image, image, [(5, 5), (9, 9)], n=n, joint=True)


def test_weights_without_a_mask_ask_for_the_users() -> None:
    torch.manual_seed(0)
    network, config = build_network("lite0", 8, pretrained=False), TrainConfig(input_px=64, descriptor_dim=8)
    matcher = Matcher(network, config, modes=4, size=(260, 260), device="cpu")
    image = np.zeros((260, 260, 3), np.uint8)
    with pytest.raises(ValueError, match="mask0 must"):
        matcher.match(image, image, [(60, 60), (90, 90)], joint=True)
    match = matcher.match(image, image, [(60, 60), (90, 90)], joint=True, mask0=MASK)
    assert match.joint_weights.shape == (4,) and dataclasses.replace(match).modes.shape == (2, 4, 2)


@pytest.mark.parametrize("joint_", ["maybe", 2, None])
def test_joint_is_true_or_false(joint_: object) -> None:
    image = np.zeros((128, 128, 3), np.uint8)
    with pytest.raises(ValueError, match="joint must be"):
        mmgsd.load("cloth").match(image, image, [(5, 5)], joint=joint_)


@pytest.mark.parametrize("joint_", [False, True])
@pytest.mark.parametrize("mask", [None, np.ones((128, 128), bool)])
@pytest.mark.parametrize("count", [0, 1])
def test_no_pixel_or_one_is_answered_too(joint_: bool, mask: np.ndarray | None, count: int) -> None:
    image = np.zeros((128, 128, 3), np.uint8)
    match = mmgsd.load("cloth").match(image, image, np.full((count, 2), 9.0), joint=joint_, mask0=mask)
    assert match.modes.shape == (count, 4, 2) and len(match.best().xy) == count
    assert match.joint_weights is None or match.joint_weights.sum() == pytest.approx(1)
