"""A figure that is stored, as a notebook shows it: small enough to be kept in the notebook."""

from __future__ import annotations

import io
from pathlib import Path

from IPython.display import Image as Shown
from PIL import Image

WIDTH_PX, QUALITY = 1065, 80  # of a page's figure at 150 dpi; of JPEG


def show_stored(path: Path) -> Shown:
    """The picture of a file, at most `WIDTH_PX` wide, as JPEG; FileNotFoundError where there is none."""
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    picture.thumbnail((WIDTH_PX, 4 * WIDTH_PX), Image.Resampling.LANCZOS)
    written = io.BytesIO()
    picture.save(written, "JPEG", quality=QUALITY, subsampling=0, optimize=True)
    return Shown(written.getvalue(), format="jpeg")
