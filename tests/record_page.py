"""Record the README's animation of the page in a real browser: ``python tests/record_page.py`` (Chromium).

`figures/page.webp`: a drag over a cloth of the sample, from a corner to the centre and on to another corner.
"""

import io
import tempfile
from pathlib import Path

import numpy as np
from browser import PATIENCE_MS, ROOT, open_chromium, serve_folder, visit_page
from PIL import Image

import mmgsd
from mmgsd.extras.page import make_page

CORNERS, STEPS, FRAME_MS, WIDTH_PX = [(232, 77), (279, 243), (161, 340)], 16, 140, 900  # px of the first sample
VIEWPORT, SIZE = {"width": 1000, "height": 900}, (485, 485)


def main() -> None:
    """Write the animation."""
    frames, parts = [], [np.linspace(a, b, STEPS) for a, b in zip(CORNERS, CORNERS[1:], strict=False)]
    with tempfile.TemporaryDirectory() as folder, open_chromium() as page:
        page.set_viewport_size(VIEWPORT)
        with serve_folder(make_page(mmgsd.load("cloth"), Path(folder) / "page", name="cloth")) as address:
            visit_page(page, address)
            box = page.locator("canvas").first.bounding_box()
            scale = min(box["width"] / SIZE[0], box["height"] / SIZE[1])
            origin = [box["x"] + (box["width"] - scale * SIZE[0]) / 2, box["y"] + (box["height"] - scale * SIZE[1]) / 2]
            for xy in np.concatenate(parts).round():
                page.mouse.move(*(origin + (xy + 0.5) * scale))
                page.mouse.down()
                page.get_by_text(f"Pixel ({xy[0]:.0f}, {xy[1]:.0f})").wait_for(timeout=PATIENCE_MS)
                shot = Image.open(io.BytesIO(page.locator(".mmgsd-pictures").screenshot())).convert("RGB")
                height = round(shot.height * WIDTH_PX / shot.width)
                frames.append(shot.resize((WIDTH_PX, height), Image.Resampling.LANCZOS))
                page.mouse.up()
    times = [FRAME_MS] * len(frames)
    times[0] = times[STEPS] = times[-1] = 1200
    frames[0].save(ROOT / "figures" / "page.webp", save_all=True, append_images=frames[1:], duration=times, loop=0,
                   quality=70, method=6)  # fmt: skip


if __name__ == "__main__":
    main()
