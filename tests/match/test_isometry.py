"""Modes are sorted by distances on the object: where it is turned, folded and crossed, and where some are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import mmgsd
from mmgsd.config import DEFAULT_GROUP, TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.match.isometry import compute_odds
from mmgsd.match.joint import join
from mmgsd.match.matcher import Matcher
from mmgsd.model.network import build_network
from mmgsd.symmetry import load_group, locate_points

ROOT = Path(__file__).parents[2]
MASK = np.ones((480, 640), bool)


def bend(object: str, flat: np.ndarray) -> np.ndarray:
    """Where (…, 2) in [0, 1] of the object is in a picture (px): a cloth folded over, a rope in a loop that crosses."""
    u, v = np.moveaxis(flat, -1, 0)
    if object == "cloth":
        return np.stack([150 + 250 * np.minimum(u, 1.3 - u), 100 + 250 * v], -1)  # folded along u = 0.65
    turn = 2 * np.pi * np.clip((u - 0.3) / 0.4, 0, 1)
    run = 700 * (u - 0.4 * np.clip((u - 0.3) / 0.4, 0, 1))
    return np.stack([120 + run + 45 * np.sin(turn), 200 + 45 * (1 - np.cos(turn))], -1)


def make_question(
    object: str, rng: np.random.Generator, *, noise: float = 0.0, count: int = 64
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, their modes in any order and whose each is, and where each member takes them, up to the symmetry."""
    group, flat = load_group(object, DEFAULT_GROUP[object]).permutations, locate_points(object)
    points = rng.choice(len(flat), count, replace=False)
    modes, order = flat[group[:, points]].transpose(1, 0, 2), rng.random((count, len(group))).argsort(1)
    modes = np.take_along_axis(bend(object, modes), order[..., None], 1)
    like = group[rng.integers(len(group), size=count), points]  # which of them it is, nobody knows
    return 30 + 200 * flat[points], modes + noise * rng.normal(size=modes.shape), order, flat[group[:, like]]


def sort(xy: np.ndarray, modes: np.ndarray, located: np.ndarray) -> np.ndarray:
    even = np.full(modes.shape[:2], 1 / modes.shape[1])
    return join(xy, MASK, modes, even, 0 * even + 5.0, places=len(xy), located=located)


def count_right(order: np.ndarray, shuffled: np.ndarray, modes: np.ndarray) -> float:
    """Share of places that are sorted as the most are, or whose modes are too near each other to say."""
    member = np.take_along_axis(shuffled, order, 1)
    most = np.array([np.bincount(column, minlength=order.shape[1]).argmax() for column in member.T])
    assert len(set(most)) == len(most)  # each map another member
    true = np.take_along_axis(modes, np.argsort(shuffled, 1)[:, most][..., None], 1)
    chosen = np.take_along_axis(modes, order[..., None], 1)
    return float((np.linalg.norm(true - chosen, axis=-1) < 20).all(1).mean())


@pytest.mark.parametrize("object", ["cloth", "rope"])
@pytest.mark.parametrize("noise", [0.0, 5.0])
def test_a_fold_and_a_crossing_do_not_mix_members(object: str, noise: float, rng: np.random.Generator) -> None:
    xy, modes, shuffled, located = make_question(object, rng, noise=noise)
    assert count_right(sort(xy, modes, located), shuffled, modes) > 0.95


@pytest.mark.parametrize("object", ["cloth", "rope"])
def test_some_wrong_modes_and_places_do_not_mislead_the_others(object: str, rng: np.random.Generator) -> None:
    xy, modes, shuffled, located = make_question(object, rng)
    modes[::8, 0] = rng.uniform(100, 400, modes[::8, 0].shape)
    modes[1::8, 1] = np.nan
    located[:, 2::8] = located[:, 3::8]
    order, good = sort(xy, modes, located), np.arange(len(xy)) % 8 > 2
    assert (np.sort(order, 1) == np.arange(modes.shape[1])).all()
    assert count_right(order[good], shuffled[good], modes[good]) > 0.9


def test_a_picture_s_size_does_not_matter(rng: np.random.Generator) -> None:
    xy, modes, _, located = make_question("cloth", rng)
    np.testing.assert_array_equal(sort(xy, modes, located), sort(3 * xy, modes / 4, located))


def test_odds_are_symmetric_and_say_nothing_of_a_mode_that_is_not_there(rng: np.random.Generator) -> None:
    xy, modes, _, located = make_question("rope", rng, count=12)
    modes[3, 1] = np.nan
    odds = compute_odds(xy, modes, located)
    assert odds.shape == (24, 24) and np.isfinite(odds).all()
    np.testing.assert_array_equal(odds, odds.T)
    assert not odds[7].any()
    assert not odds.reshape(12, 2, 12, 2)[np.arange(12), :, np.arange(12)].any()


def test_all_pixels_in_one_place_are_sorted_without_a_number_that_is_none() -> None:
    same = np.ones((5, 2))
    odds = compute_odds(same, np.ones((5, 2, 2)), np.zeros((2, 5, 2)))
    assert np.isfinite(odds).all()


@pytest.mark.parametrize("object", ["cloth", "rope"])
def test_pixels_are_located_on_the_object_up_to_the_symmetry(object: str) -> None:
    data, matcher = load_dataset(ROOT / "data" / "sample" / object, "test"), mmgsd.load(object)
    points, image = np.flatnonzero(data.visible[0])[::20], data.load_image(0)
    located = matcher.locate(matcher.describe([image])[0], torch.from_numpy(data.xy[0][points]), data.size)
    group = load_group(object, DEFAULT_GROUP[object]).permutations
    true = locate_points(object)[group[:, points]]
    errors = np.linalg.norm(located[:, None] - true[None], axis=-1).min(0)  # (G, S)
    assert located.shape == (len(group), len(points), 2) and np.median(errors) < 0.03
    np.testing.assert_allclose(errors, np.broadcast_to(errors[:1], errors.shape), atol=1e-6)  # each member has one


def test_where_it_lies_is_not_known_without_places_or_of_an_object_of_one_s_own() -> None:
    torch.manual_seed(0)
    network, config = build_network("lite0", 8, pretrained=False), TrainConfig(input_px=64, descriptor_dim=8)
    matcher = Matcher(network, config, modes=4, size=(260, 260), device="cpu")
    outputs = matcher.describe([np.zeros((260, 260, 3), np.uint8)])[0]
    assert matcher.locate(outputs, torch.zeros(1, 2), (260, 260)) is None
    matcher.places = torch.zeros(625, 8)
    assert matcher.locate(outputs, torch.zeros(1, 2), (260, 260)).shape == (4, 1, 2)
    matcher.object = "towel"
    assert matcher.locate(outputs, torch.zeros(1, 2), (260, 260)) is None
