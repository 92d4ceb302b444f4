"""The explorer in a real browser: JupyterLab opens the notebook, runs it, and a click changes the picture."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from browser import CANVAS, CHROMIUM, PATIENCE_MS, click_figure, open_explorer, run_lab
from PIL import Image

pytest.importorskip("playwright")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with run_lab(tmp_path_factory.mktemp("lab")) as address, open_explorer(address) as page:
        yield page


def look(page: Any) -> np.ndarray:
    """The right half of the figure as (H, W, 3)."""
    image = np.asarray(Image.open(io.BytesIO(page.locator(CANVAS).screenshot())).convert("RGB")).astype(int)
    return image[:, image.shape[1] // 2 :]


def ask(page: Any, x: float, y: float) -> np.ndarray:
    """Click, wait for the answer's line to change, and look."""
    before = page.get_by_text("nats").first.inner_text()
    click_figure(page, x, y)
    page.wait_for_function("b => ![...document.querySelectorAll('.widget-html-content')].some(e => e.innerText === b)",
                           arg=before, timeout=PATIENCE_MS)  # fmt: skip
    page.wait_for_timeout(500)  # the picture follows the line
    return look(page)


def test_a_click_changes_the_picture(page: Any) -> None:
    start, first, second = look(page), ask(page, 0.2, 0.4), ask(page, 0.3, 0.6)
    for before, after in ((start, first), (first, second)):
        assert np.mean(np.abs(before - after).max(-1) > 8) > 0.01


def test_next_pair_shows_other_images(page: Any) -> None:
    before = look(page)
    page.get_by_role("button", name="next").click()
    page.wait_for_timeout(1500)
    assert np.mean(np.abs(before - look(page)).max(-1) > 8) > 0.1
