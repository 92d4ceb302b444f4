"""Augmentation: labels move as the pixels do, at every resolution."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.learn import augmentation
from mmgsd.learn.augmentation import (
    UNCHANGED,
    Warp,
    jitter_colours,
    load_training_images,
    make_batch,
    sample_warp,
    warp_images,
)

CONFIG = TrainConfig(input_px=128)

RESOLUTIONS = [  # full image, the copy in memory, the network's input
    ((485, 485), (485, 485), (485, 485)),
    ((485, 485), (160, 160), (128, 128)),
    ((640, 480), (200, 150), (160, 120)),
    ((640, 480), (80, 60), (64, 48)),
]


def draw_dot(xy: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A bright spot of 8 px at ``xy`` on black, (H, W) uint8."""
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return (255 * np.exp(-((columns - xy[0]) ** 2 + (rows - xy[1]) ** 2) / (2 * 8**2))).astype(np.uint8)


def find_dot(image: np.ndarray, full: tuple[int, int], near: np.ndarray) -> np.ndarray:
    """Centre of brightness in full-image px within 60 px of ``near``: the border mirrors the spot farther away."""
    rows, columns = np.indices(image.shape)
    xy = (np.stack([columns, rows], axis=-1) + 0.5) * (np.array(full) / image.shape[1::-1]) - 0.5  # (h, w, 2)
    weight = image * (np.linalg.norm(xy - near, axis=-1) < 60)
    return (xy * weight[..., None]).sum((0, 1)) / weight.sum()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("bend", [0.0, 0.5])
@pytest.mark.parametrize(("full", "memory", "size"), RESOLUTIONS)
def test_labels_move_as_pixels_do(
    full: tuple[int, int], memory: tuple[int, int], size: tuple[int, int], bend: float, coloured: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    warp = sample_warp(full, rng, bend=bend)
    xy = np.array(full) / 2 + rng.uniform(-60, 60, 2)
    image = cv2.resize(draw_dot(xy, full), memory, interpolation=cv2.INTER_AREA)
    image = np.repeat(image[..., None], 3, axis=-1) if coloured else image
    (warped,) = warp_images([image], warp, full, size)
    assert warped.shape[:2] == (size[1], size[0])
    expected = warp.move(xy)
    found = find_dot(warped[..., 0] if coloured else warped, full, expected)
    np.testing.assert_allclose(found, expected, atol=0.75 if bend == 0 else 1.5)  # a bent spot is not quite round


def find_source(warp: Warp, xy: np.ndarray) -> np.ndarray:
    """Old px of new px (n, 2)."""
    return np.array([warp.find_grid_source(x[None], y[None])[0, 0] for x, y in xy])


def test_identity_changes_nothing(rng: np.random.Generator) -> None:
    image = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
    np.testing.assert_array_equal(warp_images([image], UNCHANGED, (80, 60), (80, 60))[0], image)
    points = rng.uniform(0, 60, (2, 7, 2))
    np.testing.assert_array_equal(UNCHANGED.move(points), points)


def test_points_by_hand() -> None:
    affine = np.array([[0.0, -2.0, 5.0], [2.0, 0.0, 1.0]])  # turned by 90°, doubled, moved by (5, 1)
    turned = dataclasses.replace(UNCHANGED, affine=affine)
    np.testing.assert_array_equal(turned.move(np.array([[1.0, 3.0]])), [[-1.0, 3.0]])
    np.testing.assert_array_equal(find_source(turned, np.array([[-1.0, 3.0]])), [[1.0, 3.0]])


def test_a_wave_by_hand() -> None:
    # what is shown at column x comes from column x + 3 sin(x / 20)
    wave = Warp(np.eye(2, 3), np.array([[3.0, 0.0]]), np.array([[0.05, 0.0]]), np.zeros(1))
    np.testing.assert_allclose(find_source(wave, np.array([[10 * np.pi, 7.0]])), [[10 * np.pi + 3, 7.0]])
    np.testing.assert_allclose(wave.move(np.array([10 * np.pi + 3, 7.0])), [10 * np.pi, 7.0], atol=0.01)


@pytest.mark.parametrize("seed", range(8))
def test_move_inverts_find_source(seed: int) -> None:
    rng = np.random.default_rng(seed)
    warp, xy = sample_warp((640, 480), rng, bend=0.5), rng.uniform(0, 480, (200, 2))
    np.testing.assert_allclose(warp.move(find_source(warp, xy)), xy, atol=0.02)


def test_bend_bounds_the_stretching(rng: np.random.Generator) -> None:
    for _ in range(50):
        warp = sample_warp((485, 485), rng, rotate=False, scale=0, bend=0.4)
        xy = rng.uniform(0, 485, (100, 2))
        for step in ([1e-3, 0], [0, 1e-3]):
            change = (find_source(warp, xy + step) - find_source(warp, xy)) / 1e-3 - np.sign(step)
            assert np.linalg.norm(change, axis=1).max() <= 0.4 + 1e-6


def test_no_object_enters_a_mask_from_outside() -> None:
    shift = dataclasses.replace(UNCHANGED, affine=np.array([[1.0, 0, 20], [0, 1, 0]]))
    (moved,) = warp_images([np.full((50, 50), 255, np.uint8)], shift, (50, 50), (50, 50))
    assert (moved[:, :20] == 0).all()
    assert (moved[:, 20:] == 255).all()


def test_affine_without_rotation_only_scales_and_moves(rng: np.random.Generator) -> None:
    affine = sample_warp((640, 480), rng, rotate=False).affine
    assert affine[0, 1] == affine[1, 0] == 0
    assert affine[0, 0] == affine[1, 1] > 0


def test_affine_stays_within_its_ranges(rng: np.random.Generator) -> None:
    full, centre = np.array([640, 480]), np.array([319.5, 239.5])
    for warp in (sample_warp((640, 480), rng) for _ in range(100)):
        assert np.exp(-0.2) <= np.sqrt(np.linalg.det(warp.affine[:, :2])) <= np.exp(0.2)
        assert (np.abs(warp.move(centre) - centre) <= 0.06 * full + 1e-9).all()


@pytest.mark.parametrize("seed", range(4))
def test_jitter_keeps_shape_and_type_and_leaves_its_argument_alone(seed: int) -> None:
    image = np.full((8, 8, 3), 100, dtype=np.uint8)
    jittered = jitter_colours(image, np.random.default_rng(seed))
    assert (jittered.shape, jittered.dtype) == (image.shape, np.uint8)
    assert (jittered != image).any() and (image == 100).all()


def test_randomness_is_the_generators() -> None:
    image = np.full((20, 20, 3), 90, dtype=np.uint8)
    generators = np.random.default_rng(5), np.random.default_rng(5)
    one, two = ((sample_warp((20, 20), rng), jitter_colours(image, rng)) for rng in generators)
    np.testing.assert_array_equal(one[0].affine, two[0].affine)
    np.testing.assert_array_equal(one[0].phases, two[0].phases)
    np.testing.assert_array_equal(one[1], two[1])


@pytest.mark.parametrize("object", ["cloth", "rope"])
def test_labels_follow_a_mirrored_image(
    tiny_dataset: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, object: str
) -> None:
    monkeypatch.setattr(augmentation, "jitter_colours", lambda image, rng: image)
    images = load_training_images(load_dataset(tiny_dataset(object=object)), 128)
    point, rng, mirrored = 260, np.random.default_rng(0), set()
    for image, xy in zip(images.images, images.xy, strict=True):
        dot = draw_dot(xy[point], images.size)
        image[:] = cv2.resize(dot, image.shape[1::-1], interpolation=cv2.INTER_AREA)[..., None]
    for _ in range(12):
        batch = make_batch(images, np.array([0]), CONFIG, rng, torch.device("cpu"))
        shown = batch.image[0, 0].numpy()
        labels = batch.xy[0, [point, images.mirror[point]]].numpy()
        apart = [np.linalg.norm(find_dot(shown, images.size, xy) - xy) for xy in labels]
        assert np.nanmin(apart) < 3
        mirrored.add(int(np.nanargmin(apart)))
    assert mirrored == ({0, 1} if object == "cloth" else {0})


@pytest.mark.parametrize(("object", "last"), [("cloth", 24), ("rope", 624)])
def test_a_mirror_image_is_not_turned_end_for_end_where_nothing_turns(
    tiny_dataset: Callable[..., Path], rng: np.random.Generator, object: str, last: int
) -> None:
    images = load_training_images(load_dataset(tiny_dataset(object=object)), 64)
    along = images.xy[:, last] - images.xy[:, 0]
    index = int(np.abs(along[:, 0]).argmax())
    config = dataclasses.replace(CONFIG, object=object, rotate=False, bend=0.0)
    batch = make_batch(images, np.full(40, index), config, rng, torch.device("cpu"))
    found = (batch.xy[:, last] - batch.xy[:, 0]).numpy()
    assert (np.sign(found[:, 0]) == np.sign(along[index, 0])).all()
    assert len(set(np.sign(found[:, 1]))) == 2  # some are mirrored


def test_without_a_mirror_nothing_is_mirrored(tiny_dataset: Callable[..., Path], rng: np.random.Generator) -> None:
    images = dataclasses.replace(load_training_images(load_dataset(tiny_dataset()), 64), mirror=None)
    for _ in range(8):  # three corners of a cloth keep their sense of rotation
        xy = make_batch(images, np.array([0]), CONFIG, rng, torch.device("cpu")).xy[0].numpy()
        (ax, ay), (bx, by) = xy[24] - xy[0], xy[600] - xy[0]
        assert ax * by - ay * bx > 0


def test_clutter_hides_points_and_takes_objects_away(tiny_dataset: Callable[..., Path]) -> None:
    images = load_training_images(load_dataset(tiny_dataset(), "train"), 128)
    config = dataclasses.replace(CONFIG, clutter=True)
    rng = np.random.default_rng(0)
    made = [make_batch(images, np.arange(4), config, rng, torch.device("cpu")) for _ in range(30)]
    masks, inside, askable = (torch.cat([getattr(batch, name) for batch in made])
                              for name in ("mask", "inside", "askable"))  # fmt: skip
    absent = ~inside.any(1)
    assert 0 < absent.float().mean() < 0.2
    assert not masks[absent].any() and not askable[absent].any()
    assert (askable.sum(1) < inside.sum(1)).any()  # something lies in front


def test_an_absent_object_is_nobodys_match(tiny_dataset: Callable[..., Path], rng: np.random.Generator) -> None:
    images = augmentation.load_training_images(load_dataset(tiny_dataset()), 64)
    images = dataclasses.replace(images, present=np.array([True, False, True, True]))
    batch = make_batch(images, np.array([0, 1]), TrainConfig(input_px=64), rng, torch.device("cpu"))
    assert batch.inside[0].any() and not batch.inside[1].any()
    assert batch.askable[0].any() and not batch.askable[1].any()
