"""JupyterLab in a headless Chromium, for the test and the bench of the explorer."""

from __future__ import annotations

import http.server
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import nbformat

from mmgsd.paths import find_root

ROOT = find_root(Path(__file__).parent)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CANVAS = ".mmgsd-explorer"
PATIENCE_MS = 120_000
VIEWPORT = {"width": 1400, "height": 1800}  # tall enough for the whole notebook


@contextmanager
def run_lab(folder: Path) -> Iterator[str]:
    """Address of a JupyterLab that serves ``folder`` with the explorer's notebook, not yet run, on loopback."""
    notebook = nbformat.read(ROOT / "notebooks" / "explore.ipynb", as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.update(outputs=[], execution_count=None)
    nbformat.write(notebook, folder / "explore.ipynb")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = ["--no-browser", "--allow-root", "--ServerApp.ip=127.0.0.1", f"--ServerApp.port={port}",
               f"--ServerApp.root_dir={folder}", "--IdentityProvider.token="]  # fmt: skip
    places = {f"JUPYTER_{kind}_DIR": str(folder / kind) for kind in ("CONFIG", "RUNTIME", "DATA")}
    # show every cell, also those out of sight, and no question about news
    settings = folder / "CONFIG" / "lab" / "user-settings" / "@jupyterlab"
    for name, text in {"notebook-extension/tracker": '{"windowingMode": "none"}',
                       "apputils-extension/notification": '{"fetchNews": "false"}'}.items():  # fmt: skip
        file = settings / f"{name}.jupyterlab-settings"
        file.parent.mkdir(parents=True)
        file.write_text(text)
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
def open_chromium() -> Iterator[Any]:
    """An empty page (playwright)."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-dev-shm-usage"])
        yield browser.new_page(viewport=VIEWPORT)
        browser.close()


@contextmanager
def serve_folder(folder: Path) -> Iterator[str]:
    """Address of a folder's files on loopback."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def visit_page(page: Any, address: str) -> None:
    """Open the page without installation, until it can be asked."""
    page.goto(address, timeout=PATIENCE_MS)
    ended = page.locator(".mmgsd-line", has_text=re.compile("Tap in the left|did not work"))
    ended.wait_for(timeout=3 * PATIENCE_MS)  # its threads share the processors with other tests
    assert ended.inner_text() == "Tap in the left picture."


@contextmanager
def open_explorer(address: str, page: Any = None) -> Iterator[Any]:
    """A page (playwright), a new one unless given, with the notebook run to its end, the explorer showing an answer."""
    from playwright.sync_api import Error

    with nullcontext(page) if page else open_chromium() as page:
        console: list[str] = []
        page.on("console", lambda message: console.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: console.append(f"uncaught: {error}"))
        try:
            page.goto(f"{address}/tree/explore.ipynb", timeout=PATIENCE_MS)
            page.locator(".jp-Notebook .jp-CodeCell").first.wait_for(timeout=PATIENCE_MS)
            # What is run before is lost; a kernel starts beside other tests.
            page.get_by_text("(ipykernel) | Idle").wait_for(timeout=3 * PATIENCE_MS)
            _run_all(page)
            page.locator(CANVAS).wait_for(timeout=3 * PATIENCE_MS)
            page.get_by_text("nats").first.wait_for(timeout=PATIENCE_MS)  # the last cell asks about a pixel
        except Error as error:
            shown = page.locator("body").inner_text()[-4000:]
            raise AssertionError(f"{error}\nthe page: {shown}\nits console: {console[-20:]}") from error
        yield page


def _run_all(page: Any) -> None:
    """Run all cells; once more where the kernel was not ready and nothing began."""
    from playwright.sync_api import TimeoutError

    for _ in range(5):
        page.get_by_text("Run", exact=True).first.click()
        page.get_by_text("Run All Cells", exact=True).click()
        try:
            page.locator(".jp-InputPrompt", has_text=re.compile(r"\[[*\d]+\]")).first.wait_for(timeout=PATIENCE_MS / 10)
            return
        except TimeoutError:
            continue


def locate(page: Any, x: float, y: float, *, side: int = 0) -> tuple[float, float]:
    """Where a share of a picture's width and height lies on the page."""
    box = page.locator(f"{CANVAS} .mmgsd-picture canvas").nth(side).bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def click_figure(page: Any, x: float, y: float) -> None:
    """Click at a share of the left picture's width and height."""
    page.mouse.click(*locate(page, x, y))


def _wait_for(address: str, log: Path, *, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            urllib.request.urlopen(address, timeout=5).close()
            return
        except OSError:
            time.sleep(0.5)
    raise RuntimeError(f"JupyterLab did not start:\n{log.read_text()[-2000:]}")
