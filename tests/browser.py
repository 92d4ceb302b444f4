"""JupyterLab in a headless Chromium, for the test and the bench of the explorer."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mmgsd.config import find_root

ROOT = find_root(Path(__file__).parent)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CANVAS = ".mmgsd-explorer"
PATIENCE_MS = 120_000


@contextmanager
def run_lab(folder: Path) -> Iterator[str]:
    """Address of a JupyterLab that serves ``folder`` with a copy of the explorer's notebook, on loopback."""
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
        _wait_for(address, folder / "lab.log")
        yield address
    finally:
        server.terminate()
        server.wait(30)


@contextmanager
def open_explorer(address: str) -> Iterator[Any]:
    """A page (playwright) with the notebook run to its end, the explorer showing an answer."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        # tall enough for the whole notebook: JupyterLab hides the cells that are out of sight
        page = browser.new_page(viewport={"width": 1400, "height": 1800})
        page.goto(f"{address}/tree/explore.ipynb", timeout=PATIENCE_MS)
        page.locator(".jp-Notebook .jp-CodeCell").first.wait_for(timeout=PATIENCE_MS)
        page.get_by_text("(ipykernel) | Idle").wait_for(timeout=PATIENCE_MS)  # what is run before is lost
        page.get_by_text("Run", exact=True).first.click()
        page.get_by_text("Run All Cells", exact=True).click()
        page.locator(CANVAS).wait_for(timeout=PATIENCE_MS)
        page.get_by_text("nats").wait_for(timeout=PATIENCE_MS)  # the last cell asks about a pixel
        yield page
        browser.close()


def click_figure(page: Any, x: float, y: float) -> None:
    """Click at a share of the figure's width and height."""
    box = page.locator(CANVAS).bounding_box()
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


def _wait_for(address: str, log: Path, *, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            urllib.request.urlopen(address, timeout=5).close()
            return
        except OSError:
            time.sleep(0.5)
    raise RuntimeError(f"JupyterLab did not start:\n{log.read_text()[-2000:]}")
