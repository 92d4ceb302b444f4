"""From a click to the changed picture, in a real browser: ``python tests/bench/bench_explorer.py [clicks]``.

JupyterLab and a headless Chromium (which must be installed) on this machine; the clock runs in the page, from the mouse
button to the first frame in which the figure's right canvas has other pixels. The last line is the median of 30 clicks.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.command import run_command

sys.path.insert(0, str(Path(__file__).parents[1]))
from browser import CHROMIUM, click_figure, open_explorer, run_lab

WATCH = """() => {
    const canvas = document.querySelectorAll('.mmgsd-picture canvas')[1];
    const read = () => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    const differs = (a, b) => { for (let i = 0; i < a.length; i += 41) if (a[i] !== b[i]) return true; return false; };
    window.took = new Promise(resolve => document.addEventListener('pointerdown', () => {
        const start = performance.now(), before = read();
        const look = () => differs(before, read()) ? resolve(performance.now() - start) : requestAnimationFrame(look);
        look();
    }, {once: true, capture: true}));
}"""


def time_clicks(page: Any, count: int) -> list[float]:
    """Milliseconds of each click at random places of the explorer that a page (playwright) shows."""
    took = []
    for x, y in np.random.default_rng(0).uniform((0.24, 0.3), (0.76, 0.7), (count, 2)):
        page.wait_for_timeout(300)
        page.evaluate(WATCH)
        click_figure(page, float(x), float(y))
        took.append(page.evaluate("() => window.took"))
    return took


def main() -> None:
    """Print the median milliseconds, and the slowest tenth's."""
    if CHROMIUM is None:
        raise RuntimeError("the program chromium is not installed: the page is shown in it")
    clicks = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    with tempfile.TemporaryDirectory() as folder, run_lab(Path(folder)) as address, open_explorer(address) as page:
        took = time_clicks(page, clicks + 3)[3:]  # the first ones compute the descriptors of the pair
    half, most = np.quantile(took, (0.5, 0.9))
    print(f"{half:.0f} ms from click to picture, {most:.0f} ms or less in 90 % of {clicks}")


if __name__ == "__main__":
    run_command(main)
