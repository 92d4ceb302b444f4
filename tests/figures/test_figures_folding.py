"""Pictures of rollouts: a row a task, a column a picture, the middle square of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mmgsd.figures.folding import (
    THUMBNAIL_PX,
    crop_square,
    mark_moves,
    mark_success,
    plot_moves,
    plot_rollouts,
    save_slides,
)
from mmgsd.studies.folding import plot_success

PICTURE = np.zeros((48, 64, 3), np.uint8)


def test_a_row_a_task_and_a_column_a_picture() -> None:
    figure = plot_rollouts(
        {"in half": {"found": PICTURE, "MMGSD": PICTURE}, "unfold": dict(found=PICTURE, MMGSD=PICTURE)}
    )
    assert len(figure.axes) == 4
    assert [axis.get_title() for axis in figure.axes] == ["found", "MMGSD", "", ""]
    assert [axis.get_ylabel() for axis in figure.axes] == ["in half", "", "unfold", ""]


def test_the_middle_square_is_shown() -> None:
    picture = PICTURE.copy()
    picture[:, 8:56] = 255
    cropped = crop_square(picture)
    assert cropped.shape == (THUMBNAIL_PX, THUMBNAIL_PX, 3) and cropped.min() == 255


@pytest.mark.parametrize(("success", "colour"), [(True, 1), (False, 0)])
def test_a_frame_says_whether_it_is_a_success(success: bool, colour: int) -> None:
    framed = mark_success(PICTURE, success)
    assert framed.shape == (THUMBNAIL_PX, THUMBNAIL_PX, 3) and not framed[80, 80].any()
    assert framed[80, 1].argmax() == colour and not PICTURE.any()


def test_moves_are_arrows_from_pick_to_place() -> None:
    moves = np.array([[[5.0, 6], [40, 30]], [[8, 9], [-10, 50]]])
    figure = plot_moves({"demonstration": (PICTURE, moves), "now": (PICTURE, moves[:1])})
    first, second = figure.axes
    assert [axis.get_title() for axis in figure.axes] == ["demonstration", "now"]
    ends = {(*text.xyann, *text.xy) for text in first.texts}
    assert ends == {(5, 6, 40, 30), (8, 9, -10, 50)} and len(second.texts) == 2  # a dark and a bright one each
    assert first.get_xlim() == (-0.5, 63.5)


def test_slides_hold_pairs_with_their_moves(tmp_path: Path) -> None:
    moved = mark_moves(PICTURE, np.array([[[10.0, 20], [50, 20]]]))
    assert moved[20, 30].max() > 200 and not PICTURE.any() and not moved[40].any()
    path = save_slides([(PICTURE, moved), (moved, PICTURE)], tmp_path / "slides.webp")
    with Image.open(path) as slides:
        assert slides.n_frames == 2 and slides.width == 2 * slides.height


def test_success_has_a_dot_with_its_interval_for_what_was_measured() -> None:
    def row(low: float, mean: float, high: float) -> dict:
        return {"reachable": {"success": {"mean": mean, "low": low, "high": high, "count": 7}}}

    policies = {"cloth": {"truth": row(1, 1, 1), "mmgsd": row(0.5, 0.75, 0.9)}, "rope": {"truth": row(1, 1, 1)}}
    figure = plot_success({"policies": policies})
    cloth, rope = figure.axes
    assert [tick.get_text() for tick in cloth.get_yticklabels()] == ["true matches", "MMGSD, modes that agree"]
    assert [len(axis.containers) for axis in (cloth, rope)] == [2, 1]
    assert cloth.get_title() == "Cloth, 7 rollouts" and cloth.containers[1].lines[0].get_xdata().tolist() == [75.0]
