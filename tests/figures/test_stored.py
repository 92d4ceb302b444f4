"""A stored figure is shown small enough to be kept in a notebook."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from PIL import Image

from mmgsd.figures.stored import DRAWN, PHOTOGRAPHS, show_stored


@pytest.mark.parametrize(("kind", "width"), [("png", DRAWN[0]), ("jpg", PHOTOGRAPHS[0])])
def test_a_wide_figure_is_shrunk_and_a_small_one_stays(tmp_path: Path, kind: str, width: int) -> None:
    for size, shown in (((2 * width, 600), (width, 300)), ((300, 200), (300, 200)), ((200, 300), (200, 300))):
        Image.new("RGB", size, "white").save(tmp_path / f"figure.{kind}")
        picture = show_stored(tmp_path / f"figure.{kind}")
        assert picture.format == "jpeg"
        assert Image.open(io.BytesIO(picture.data)).size == shown


def test_a_figure_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.png"):
        show_stored(tmp_path / "none.png")
