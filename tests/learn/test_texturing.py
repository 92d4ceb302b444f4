"""Another print on the object: it follows the surface, keeps the shading, and touches nothing beside the object."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.learn import augmentation, texturing
from mmgsd.learn.augmentation import Warp, make_batch, sample_warp, warp_images
from mmgsd.learn.compositing import composite, draw_things
from mmgsd.learn.texturing import draw_texture, retexture
from mmgsd.symmetry import locate_points

SHAPE = (96, 128)


@pytest.fixture
def cloth() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A grey square of 60 px on red, its mask and the px of its 625 points."""
    mask = np.zeros(SHAPE, np.uint8)
    mask[20:81, 30:91] = 255
    image = np.where(mask[..., None] > 0, np.uint8([150, 150, 150]), np.uint8([200, 0, 0]))
    return image, mask, locate_points("cloth", 625) * 60 + (30, 20)


def borrow() -> tuple[np.ndarray, np.ndarray]:
    return np.full((60, 60, 3), (0, 0, 200), np.uint8), np.zeros((60, 60), np.uint8)


def test_points_lie_on_a_print_as_they_do_on_the_object() -> None:
    cloth, rope = locate_points("cloth", 625), locate_points("rope", 625)
    assert cloth[[0, 24, 600, 624]].tolist() == [[0, 0], [1, 0], [0, 1], [1, 1]]
    assert rope[[0, 312, 624], 0].tolist() == [0, 0.5, 1] and (rope[:, 1] == 0.5).all()


def test_a_print_follows_the_surface_and_keeps_the_shading(cloth, rng, monkeypatch) -> None:
    image, mask, xy = cloth
    image[mask > 0] = np.where(np.arange(SHAPE[1])[None, :, None] < 60, 75, 150).repeat(SHAPE[0], 0)[mask > 0]
    ramp = np.zeros((texturing.TEXTURE_PX, texturing.TEXTURE_PX, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = np.linspace(0, 200, texturing.TEXTURE_PX), 100  # red grows along the rows
    monkeypatch.setattr(texturing, "draw_texture", lambda *_: ramp)
    turned = np.rot90(xy.reshape(25, 25, 2)).reshape(-1, 2)  # its rows run down the image
    printed = retexture(image, mask, turned, np.ones(625, bool), "cloth", borrow, rng).astype(int)
    assert (printed[mask == 0] == image[mask == 0]).all()
    assert printed[24, 80, 0] < 20 < 150 < printed[78, 80, 0]
    dark, light = printed[50, 45, 1], printed[50, 75, 1]
    assert 0.35 * light < dark < 0.8 * light and light == pytest.approx(100, abs=3)


def test_hidden_points_do_not_count_and_with_too_few_the_image_stays(cloth, rng) -> None:
    image, mask, xy = cloth
    visible = np.zeros(625, bool)
    visible[:3] = True
    assert retexture(image, mask, xy, visible, "cloth", borrow, rng) is image
    xy[3:] = np.nan
    visible[:3] = False
    assert retexture(image, mask, xy, visible, "cloth", borrow, rng) is image
    assert retexture(image, 0 * mask, xy, ~visible, "cloth", borrow, rng) is image


@pytest.mark.parametrize("object", ["cloth", "rope"])
def test_points_on_a_line_can_be_printed_on(cloth, rng, object: str) -> None:
    image, mask, _ = cloth
    line = np.stack([np.linspace(30, 90, 625), np.full(625, 50.0)], -1)
    printed = retexture(image, mask, line, np.ones(625, bool), object, borrow, rng)
    assert printed.shape == image.shape and (printed[mask == 0] == image[mask == 0]).all()


@pytest.mark.parametrize("object", ["cloth", "rope"])
def test_prints_are_pictures_of_many_kinds_that_the_generator_decides(object: str) -> None:
    prints = [draw_texture(object, borrow, np.random.default_rng(seed)) for seed in range(40)]
    again = draw_texture(object, borrow, np.random.default_rng(7))
    assert all(p.shape == (160, 160, 3) and p.dtype == np.uint8 for p in prints)
    assert (again == prints[7]).all()
    assert len({p.tobytes() for p in prints}) > 35


def test_a_sheet_like_the_object_lies_under_it_or_not_at_all(cloth) -> None:
    image, mask, _ = cloth
    ground, counts = np.full_like(image, 127), []
    for seed in range(120):
        covered = draw_things(ground.copy(), np.random.default_rng(seed), 1, under=mask)
        if covered.sum() > 0.25 * (mask > 0).sum():
            counts.append((covered & (mask > 0)).sum() / (mask > 0).sum())
    assert len(counts) > 5 and min(counts) >= 0.5
    beside = [composite(image, mask, borrow, np.random.default_rng(s), lookalikes_beside=False).image for s in range(5)]
    assert all(made.shape == image.shape for made in beside)


def test_strong_augmentation_shows_no_second_copy_of_the_object(monkeypatch) -> None:
    image = np.full((*SHAPE, 3), (200, 0, 0), np.uint8)
    mask = cv2.circle(np.zeros(SHAPE, np.uint8), (12, 50), 10, 255, -1)
    image[mask > 0] = (0, 200, 0)
    shift = Warp(np.array([[1.0, 0, 40], [0, 1, 0]]), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    mirrored, moved = warp_images([image, mask], shift, SHAPE[::-1], SHAPE[::-1])
    green = (mirrored[..., 1] > mirrored[..., 0]) & (moved == 0)
    assert green.sum() > 200  # as it is without: the background's mirror image has it once more
    whole, same = augmentation._warp_once([image, mask], shift, SHAPE[::-1], SHAPE[::-1])
    assert (same == moved).all() and not ((whole[..., 1] > whole[..., 0]) & (same == 0)).any()


def test_strong_augmentation_is_an_option_that_batches_obey(tiny_dataset) -> None:
    images = augmentation.load_training_images(load_dataset(tiny_dataset(object="cloth")), 128)
    plain = TrainConfig(object="cloth", network="lite0x2fine", clutter=True, heads=True, input_px=128)
    made = [make_batch(images, np.arange(4), dataclasses.replace(plain, strong=strong), np.random.default_rng(0),
                       torch.device("cpu")) for strong in (False, True, True)]  # fmt: skip
    assert (made[1].image == made[2].image).all() and not (made[0].image == made[1].image).all()


def test_zoom_and_shift_reach_as_far_as_is_asked() -> None:
    warps = [sample_warp((640, 480), np.random.default_rng(s), scale=0.35, shift=0.15) for s in range(300)]
    zooms = [np.sqrt(abs(np.linalg.det(warp.affine[:, :2]))) for warp in warps]
    assert 1.35 < max(zooms) <= np.exp(0.35) and min(zooms) < 0.75


def test_objects_of_ones_own_have_no_strong_augmentation() -> None:
    with pytest.raises(ValueError, match="strong must"):
        TrainConfig(object="flag", strong=True)
