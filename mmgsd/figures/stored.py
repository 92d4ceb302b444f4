"""A figure that is stored, as a notebook shows it: small enough to be kept in the notebook."""

from __future__ import annotations

import io
from pathlib import Path

from IPython.display import Image as NotebookImage
from PIL import Image

DRAWN, PHOTOGRAPHS = (1065, 80, 0), (900, 75, 2)  # px wide at most, and JPEG's quality and subsampling


def show_stored(path: Path) -> NotebookImage:
    """The picture of a file, shrunk, as JPEG: a PNG as what is drawn, others as photographs; or FileNotFoundError."""
    width, quality, subsampling = DRAWN if path.suffix == ".png" else PHOTOGRAPHS
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    picture.thumbnail((width, picture.height), Image.Resampling.LANCZOS)
    written = io.BytesIO()
    picture.save(written, "JPEG", quality=quality, subsampling=subsampling, optimize=True)
    return NotebookImage(written.getvalue(), format="jpeg")
