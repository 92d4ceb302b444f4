"""Record a picture of the explorer in a real browser: ``python tests/record_explorer.py`` (Chromium).

`figures/explorer.png`: the notebook's cell, a corner of a cloth of the sample being asked about.
"""

import tempfile
from pathlib import Path

from browser import CANVAS, ROOT, locate, open_explorer, run_lab

CORNER = (0.478, 0.16)  # of the left picture


def main() -> None:
    """Write the picture."""
    with tempfile.TemporaryDirectory() as folder, run_lab(Path(folder)) as address, open_explorer(address) as page:
        page.get_by_role("button", name="next").click()
        page.wait_for_timeout(1000)
        x, y = locate(page, *CORNER)
        page.mouse.move(x, y)
        page.mouse.down()
        page.wait_for_timeout(2000)  # the pair's descriptors are computed
        page.mouse.move(x + 1, y + 1)
        page.wait_for_timeout(1000)
        page.locator(f".jp-OutputArea:has({CANVAS})").first.screenshot(path=ROOT / "figures" / "explorer.png")


if __name__ == "__main__":
    main()
