"""The explorer in a real browser: JupyterLab opens the notebook, runs it, and a click changes the picture."""

from __future__ import annotations

import io
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mmgsd.config import find_root

playwright = pytest.importorskip("playwright.sync_api")
ROOT = find_root(Path(__file__).parent)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CANVAS = ".jupyter-matplotlib-canvas-div"
PATIENCE_MS = 120_000

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs the program chromium")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a JupyterLab whose folder holds a copy of the notebook."""
    folder = tmp_path_factory.mktemp("lab")
    shutil.copy(ROOT / "notebooks" / "explore.ipynb", folder)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = ["--no-browser", "--allow-root", "--ServerApp.ip=127.0.0.1", f"--ServerApp.port={port}",
               f"--ServerApp.root_dir={folder}", "--IdentityProvider.token="]  # fmt: skip
    places = {f"JUPYTER_{kind}_DIR": str(folder / kind) for kind in ("CONFIG", "RUNTIME", "DATA")}
    env = {**os.environ, **places, "MMGSD_ROOT": str(ROOT), "PYTHONPATH": str(ROOT)}
    with (folder / "lab.log").open("w") as log:
        server = subprocess.Popen([sys.executable, "-m", "jupyterlab", *options], env=env, stdout=log, stderr=log)
    try:
        address = f"http://127.0.0.1:{port}/lab"
        wait_for(address, folder / "lab.log")
        yield address
    finally:
        server.terminate()
        server.wait(30)


def wait_for(address: str, log: Path, *, seconds: float = 60) -> None:
    """Until the server answers."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            urllib.request.urlopen(address, timeout=5).close()
            return
        except OSError:
            time.sleep(0.5)
    pytest.fail(f"JupyterLab did not start:\n{log.read_text()[-2000:]}")


@pytest.fixture(scope="module")
def page(lab: str) -> Iterator[playwright.Page]:
    """The notebook, run to its end."""
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.goto(f"{lab}/tree/explore.ipynb", timeout=PATIENCE_MS)
        page.locator(".jp-Notebook .jp-CodeCell").first.wait_for(timeout=PATIENCE_MS)
        page.get_by_text("Run", exact=True).first.click()
        page.get_by_text("Run All Cells", exact=True).click()
        page.locator(CANVAS).wait_for(timeout=PATIENCE_MS)
        page.get_by_text("nats").wait_for(timeout=PATIENCE_MS)  # the last cell asked about a pixel
        yield page
        browser.close()


def look(page: playwright.Page) -> np.ndarray:
    """The right half of the figure as (H, W, 3)."""
    image = np.asarray(Image.open(io.BytesIO(page.locator(CANVAS).screenshot())).convert("RGB")).astype(int)
    return image[:, image.shape[1] // 2 :]


def click(page: playwright.Page, x: float, y: float) -> None:
    """Click at a share of the figure's width and height, and wait for the answer's line to change."""
    line = page.get_by_text("nats").first
    before, box = line.inner_text(), page.locator(CANVAS).bounding_box()
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.wait_for_function("([b]) => ![...document.querySelectorAll('.widget-html-content')]"
                           ".some(e => e.innerText === b)", arg=[before], timeout=PATIENCE_MS)  # fmt: skip
    page.wait_for_timeout(500)  # the picture follows the line


def test_a_click_changes_the_picture(page: playwright.Page) -> None:
    before = look(page)
    click(page, 0.2, 0.4)
    first = look(page)
    click(page, 0.3, 0.6)
    changed = [np.mean(np.abs(a - b).max(-1) > 8) for a, b in ((before, first), (first, look(page)))]
    assert min(changed) > 0.01


def test_next_pair_clears_the_answer(page: playwright.Page) -> None:
    before = look(page)
    page.get_by_role("button", name="next").click()
    page.wait_for_timeout(1500)
    assert np.mean(np.abs(before - look(page)).max(-1) > 8) > 0.1
