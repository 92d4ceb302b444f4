"""Photographs as training images: where marks and sure answers stand among the points, and where they lie."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from mmgsd.config import TrainConfig
from mmgsd.learn import photographs as prepared
from mmgsd.learn.augmentation import CACHE_SCALE, TrainingImages
from mmgsd.learn.objective import compute_place_loss
from mmgsd.learn.photographs import NOWHERE, SURE, add_points, prepare_photographs, take
from mmgsd.measure.photographs import Photograph
from mmgsd.model.heads import Outputs
from mmgsd.symmetry import load_group

GROUP = load_group("cloth", "c4")
POINTS, ORDER = GROUP.n_points, GROUP.order


class Blind:
    """A matcher that sees the object everywhere."""

    object, size, num_modes = "cloth", (400, 400), 4
    config = SimpleNamespace(input_px=128)

    def describe(self, images: list[np.ndarray]) -> list[Outputs]:
        return [Outputs(torch.zeros(4, 8, 8), mask=torch.full((8, 8), 9.0))]

    def resize_mask(self, logits: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
        return np.ones(size[::-1], np.float32)


@pytest.fixture(autouse=True)
def unsure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless a test says what else, nothing is sure."""
    monkeypatch.setattr(prepared, "_find_sure", lambda *_: np.zeros((0, ORDER, 2)))


def photograph(folder: Path, size: tuple[int, int], xy: list[list[float]], by: str = "corners") -> Photograph:
    """A black picture that is white about its marks."""
    image = np.zeros((*size[::-1], 3), np.uint8)
    for x, y in xy:
        image[max(0, int(y) - 6) : int(y) + 7, max(0, int(x) - 6) : int(x) + 7] = 255
    Image.fromarray(image).save(folder / f"{size[0]}.png")
    return Photograph(folder / f"{size[0]}.png", "own", np.array(xy, float).reshape(-1, 2), None, 0.5, True, by)


def test_marks_are_corners_or_points_of_their_own(tmp_path: Path) -> None:
    corners = photograph(tmp_path, (400, 400), [[100, 100], [300, 90], [280, 310]])
    others = photograph(tmp_path, (200, 200), [[50, 50], [150, 150]], by="marks")
    images, permutations = prepare_photographs([corners, others], Blind(), GROUP)
    assert permutations.shape == (ORDER, POINTS + ORDER * (1 + 2 * SURE))
    assert np.flatnonzero(images.visible[0]).tolist() == [0, 24, 624]
    np.testing.assert_allclose(images.xy[0, [0, 24, 624]], corners.xy, atol=1)
    assert np.flatnonzero(images.visible[1]).tolist() == [POINTS, POINTS + 1]
    np.testing.assert_allclose(images.xy[1, [POINTS, POINTS + 1]], [[100.5, 100.5], [300.5, 300.5]], atol=1)
    assert (images.xy[1, :POINTS] == NOWHERE).all()
    assert {*permutations[:, POINTS]} == {*range(POINTS, POINTS + ORDER)} and permutations[0].tolist() == [
        *range(permutations.shape[1])
    ]


@pytest.mark.parametrize("size", [(800, 400), (300, 500), (400, 400)])
def test_marks_move_as_the_pixels_do(tmp_path: Path, size: tuple[int, int]) -> None:
    marks = [[0.6 * size[0], 0.5 * size[1]], [0.7 * size[0], 0.6 * size[1]]]
    images, _ = prepare_photographs([photograph(tmp_path, size, marks)], Blind(), GROUP)
    image, xy = images.images[0], images.xy[0, [0, 24]]
    assert image.shape == (round(128 * CACHE_SCALE), round(128 * CACHE_SCALE), 3) == (*images.masks[0].shape, 3)
    columns, rows = np.rint((xy + 0.5) * (len(image) / 400) - 0.5).astype(int).T
    assert (image[rows, columns] > 150).all() and (image > 150).mean() < 0.05
    scale = np.sqrt(400 * 400 / (size[0] * size[1]))
    assert np.linalg.norm(xy[1] - xy[0]) == pytest.approx(scale * np.hypot(0.1 * size[0], 0.1 * size[1]), rel=0.02)


def test_what_is_cut_off_is_not_asked_about(tmp_path: Path) -> None:
    wide = photograph(tmp_path, (1600, 400), [[20, 200], [800, 200], [1580, 200]])
    images, _ = prepare_photographs([wide], Blind(), GROUP)
    assert np.flatnonzero((images.xy[0] != NOWHERE).all(1)).tolist() == [24]
    assert np.flatnonzero(images.visible[0]).tolist() == [24]


def test_a_sure_pixel_is_a_block_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = np.array([[[100, 100], [300, 100], [300, 300], [100, 300]]], float)
    monkeypatch.setattr(prepared, "_find_sure", lambda *_: modes)
    images, permutations = prepare_photographs([photograph(tmp_path, (400, 400), [])] * 2, Blind(), GROUP)
    for number in (0, 1):
        first = POINTS + ORDER * (1 + SURE * number)
        assert np.flatnonzero(images.visible[number]).tolist() == [first]
        np.testing.assert_allclose(images.xy[number, permutations[:, first]], modes[0], atol=1)
        assert (images.xy[1 - number, permutations[:, first]] == NOWHERE).all()


def test_only_what_the_model_is_sure_of_is_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    square = np.array([[100, 100], [300, 100], [300, 300], [100, 300]], float)
    places = square[[2, 0, 1]] + 2
    modes = np.stack([square, square, square + 80])  # of the third none lies where was asked
    confidence = np.array([[0.9, 0.8, 0.7, 0.6], [0.9, 0.9, 0.9, 0.1], [0.9] * 4])
    answer = SimpleNamespace(modes=modes, confidence=lambda: confidence)
    monkeypatch.setattr(prepared, "spread_places", lambda *_: places)
    monkeypatch.setattr(prepared, "Pair", lambda *_: SimpleNamespace(match=lambda _: answer))
    sure = prepared._find_sure(Blind(), np.zeros((400, 400, 3), np.uint8), None, np.ones((400, 400), np.uint8))
    assert sure.shape == (1, 4, 2) and sure[0, 0].tolist() == places[0].tolist()
    assert {*map(tuple, sure[0, 1:])} == {*map(tuple, square[[0, 1, 3]])}


def test_points_are_added_to_renders_and_images_taken() -> None:
    planes = [np.full((4, 4, 3), k, np.uint8) for k in range(3)]
    images = TrainingImages(planes, planes, np.zeros((3, 2, 2)), np.ones((3, 2), bool), (4, 4), np.array([1, 0]))
    added = take(add_points(images, 5), [2, 0])
    assert [plane[0, 0, 0] for plane in added.images] == [2, 0]
    assert added.mirror.tolist() == [1, 0, 2, 3, 4] and added.visible[0].tolist() == [True, True, False, False, False]
    assert (added.xy[:, 2:] == NOWHERE).all() and (added.xy[:, :2] == 0).all()


def test_places_are_asked_for_where_they_are_seen() -> None:
    config = TrainConfig(descriptor_dim=2, queries=4, sigma_px=0.001, sigma_start_px=0.001)
    target = torch.zeros(1, 2, 4, 4)
    target[0, 0, 0, 0] = 3.0  # cell (0, 0) is described as the first place is
    places = torch.tensor([[3.0, 0.0], [0.0, 9.0]])
    known = torch.tensor([[True, False]])
    loss = []
    for x in (1.5, 13.5):  # centres of the first and the last cell of a 16 px image
        xy = torch.tensor([[[x, x], [0.0, 0.0]]])
        batch = SimpleNamespace(askable=known, inside=known, xy=xy)
        loss.append(compute_place_loss(config, target, batch, places, torch.tensor([[0, 1]]), (16, 16), 0).item())
    log_total = np.log(1 + 15 * np.exp(-9))
    assert loss == pytest.approx([log_total, 9 + log_total], abs=0.05)  # of a std of 0.01 px some lies beside the cell
