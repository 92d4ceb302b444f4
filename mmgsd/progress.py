"""Bars of long work: tqdm's, which also tell a file how far they are, for who waits outside a notebook's kernel."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

TOLD = "MMGSD_PROGRESS"  # environment variable that names the file; without it, none is told
EVERY = 1.0  # s, at least, between two lines of a bar


class ProgressBar(tqdm):
    """The bar of tqdm.auto; where MMGSD_PROGRESS names a file, that holds the line "cloth-mmgsd: 12/40" while it moves.

    A bar that is disabled tells nothing.
    """

    _last = -EVERY

    def display(self, *args: Any, **kwargs: Any) -> Any:
        """Draw the bar, as tqdm does, and tell the file."""
        if time.monotonic() - self._last >= EVERY:
            self._last = time.monotonic()
            _tell(f"{self.desc}: {self.n}/{self.total or '?'}")
        return super().display(*args, **kwargs)

    def close(self) -> None:
        """End the bar, and its line."""
        moved = not self.disable
        super().close()
        if moved:
            _tell("")


def _tell(line: str) -> None:
    """Write the line as it is: whoever reads half of one reads the next in a second, and no work fails for it."""
    if os.environ.get(TOLD):
        with contextlib.suppress(OSError):
            Path(os.environ[TOLD]).write_text(line, "utf-8")
