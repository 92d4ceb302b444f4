"""Compositing: the object stays where its mask says, what is covered is not seen, and the same numbers come again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mmgsd.learn import compositing
from mmgsd.learn.compositing import Picture, composite, disturb, draw_things, fill_object

SHAPE = (96, 128)


@pytest.fixture
def scene() -> tuple[np.ndarray, np.ndarray]:
    """A green disc on red, and its mask."""
    mask = cv2.circle(np.zeros(SHAPE, np.uint8), (60, 50), 25, 255, -1)
    return np.where(mask[..., None] > 0, np.uint8([0, 200, 0]), np.uint8([200, 0, 0])), mask


def make(scene: tuple[np.ndarray, np.ndarray], seed: int) -> Picture:
    blue = np.full((60, 60, 3), (0, 0, 200), np.uint8), np.zeros((60, 60), np.uint8)
    return composite(*scene, lambda: blue, np.random.default_rng(seed))


def test_the_object_is_where_the_mask_says(scene) -> None:
    for seed in range(40):
        made = make(scene, seed)
        red, green, blue = made.image[made.mask == 255].astype(int).T
        assert ((green > red) & (green > blue)).all() if made.present else not made.mask.any()  # shadows may fall on it


def test_what_is_covered_is_not_in_the_mask(scene) -> None:
    pictures = [make(scene, seed) for seed in range(60)]
    assert any((made.covered & (scene[1] > 0)).any() for made in pictures)
    for made in pictures:
        assert not made.mask[made.covered].any()
        if made.present:
            assert (made.mask[~made.covered] == scene[1][~made.covered]).all()


def test_shares_are_those_of_the_constants(scene) -> None:
    pictures = [make(scene, seed) for seed in range(600)]
    absent = np.mean([not made.present for made in pictures])
    replaced = np.mean([not (made.image[scene[1] == 0] == (200, 0, 0)).all(-1).mean() > 0.4 for made in pictures])
    assert absent == pytest.approx(compositing.REMOVED, abs=0.03)
    assert replaced == pytest.approx(compositing.REPLACED + compositing.REMOVED * (1 - compositing.REPLACED), abs=0.08)


def test_arguments_are_left_alone_and_the_generator_decides(scene) -> None:
    image, mask = (a.copy() for a in scene)
    for seed in range(20):
        first, second = make(scene, seed), make(scene, seed)
        assert (first.image == second.image).all() and (first.mask == second.mask).all()
    assert (scene[0] == image).all() and (scene[1] == mask).all()


def test_things_out_of_the_picture_cover_nothing(rng: np.random.Generator) -> None:
    image = np.full((*SHAPE, 3), 127, np.uint8)
    covered = draw_things(image, rng, 0)
    assert not covered.any() and (image == 127).all()


def test_filling_takes_the_object_out_and_leaves_the_rest(scene) -> None:
    filled = fill_object(*scene)
    assert np.abs(filled[scene[1] == 255] - np.float32([200, 0, 0])).max() < 30
    away = cv2.dilate(scene[1], np.ones((9, 9))) == 0
    assert (filled[away] == scene[0][away]).all()


def test_filling_a_picture_that_is_all_object_gives_numbers() -> None:
    image = np.full((*SHAPE, 3), 90, np.uint8)
    assert fill_object(image, np.full(SHAPE, 255, np.uint8)).shape == image.shape


@pytest.mark.parametrize("seed", range(30))
def test_a_disturbed_image_is_an_image(scene, seed: int) -> None:
    disturbed = disturb(scene[0], np.random.default_rng(seed))
    assert disturbed.shape == scene[0].shape and disturbed.dtype == np.uint8
