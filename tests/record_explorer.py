"""Record the README's pictures of the explorer in a real browser: ``python tests/record_explorer.py`` (Chromium).

`figures/explorer.webp`: a drag over a cloth of the sample, from a corner to the centre and on to another corner;
`figures/explorer.png`: the notebook's cell at its start.
"""

import io
import tempfile
from pathlib import Path

import numpy as np
from browser import CANVAS, ROOT, locate, open_explorer, run_lab
from PIL import Image

CORNERS, STEPS, FRAME_MS, WIDTH_PX = [(0.478, 0.16), (0.575, 0.5), (0.332, 0.7)], 16, 140, 900


def main() -> None:
    """Write the animation and the picture."""
    frames = []
    with tempfile.TemporaryDirectory() as folder, run_lab(Path(folder)) as address, open_explorer(address) as page:
        page.get_by_role("button", name="next").click()
        page.wait_for_timeout(1000)
        parts = [np.linspace(a, b, STEPS) for a, b in zip(CORNERS, CORNERS[1:], strict=False)]
        path = np.array([locate(page, *share) for share in np.concatenate(parts)])
        page.mouse.move(*path[0])
        page.mouse.down()
        page.wait_for_timeout(2000)  # the pair's descriptors are computed
        page.mouse.move(*(path[0] + 1))
        page.wait_for_timeout(1000)
        page.locator(f".jp-OutputArea:has({CANVAS})").first.screenshot(path=ROOT / "figures" / "explorer.png")
        for xy in path:
            page.mouse.move(*xy)
            page.wait_for_timeout(400)
            shot = Image.open(io.BytesIO(page.locator(f"{CANVAS} .mmgsd-pictures").screenshot())).convert("RGB")
            frames.append(shot.resize((WIDTH_PX, round(shot.height * WIDTH_PX / shot.width)), Image.Resampling.LANCZOS))
        page.mouse.up()
    times = [FRAME_MS] * len(frames)
    times[0] = times[STEPS] = times[-1] = 1200
    frames[0].save(ROOT / "figures" / "explorer.webp", save_all=True, append_images=frames[1:], duration=times, loop=0,
                   quality=70, method=6)  # fmt: skip


if __name__ == "__main__":
    main()
