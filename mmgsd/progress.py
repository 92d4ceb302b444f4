"""How far long work is: a bar where somebody sees it move, else lines; and a file, for who waits outside the kernel."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import time
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

TOLD = "MMGSD_PROGRESS"  # environment variable that names the file; without it, none is told
EVERY = 1.0  # s, at least, between two changes of the file
SAY = 30.0  # s, at least, between two lines of text
LINE = "{desc}: {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"


class Nowhere(io.TextIOBase):
    """Where a bar is drawn that nobody would see move."""

    def write(self, text: str) -> int:
        """Keep nothing."""
        return len(text)


class ProgressBar(tqdm):
    """The bar of tqdm.auto in a terminal and in Jupyter; under papermill and in a log, a line now and then.

    Where MMGSD_PROGRESS names a file, that holds the line "cloth-mmgsd: 12/40" while it moves. A bar that is disabled
    tells nothing.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._last, self._last_line, self._lines = -EVERY, time.monotonic(), not _is_watched()
        in_notebook = getattr(sys.modules.get("tqdm.notebook"), "tqdm_notebook", ())
        hidden = {"display": False} if issubclass(tqdm, in_notebook) else {"file": Nowhere()}
        super().__init__(*args, **kwargs, **(hidden if self._lines else {}))

    def display(self, *args: Any, **kwargs: Any) -> Any:
        """Draw the bar, as tqdm does, or say a line, and tell the file."""
        if time.monotonic() - self._last >= EVERY:
            self._last = time.monotonic()
            _tell(f"{self.desc}: {self.n}/{self.total or '?'}")
        if not self._lines:
            return super().display(*args, **kwargs)
        if time.monotonic() - self._last_line >= SAY:
            self._say()

    def _say(self) -> None:
        self._last_line = time.monotonic()
        shape = {**self.format_dict, "bar_format": LINE, "ncols": None}
        print(self.format_meter(**shape), file=sys.stderr, flush=True)

    def close(self) -> None:
        """End the bar, and its line."""
        moved = not self.disable
        super().close()
        if moved:
            _tell("")
            if self._lines and self.leave:
                self._say()


def _is_watched() -> bool:
    """Whether a bar can be drawn over: in a terminal, and in a notebook that Jupyter's server shows somebody."""
    return sys.stderr.isatty() or "JPY_SESSION_NAME" in os.environ


def _tell(line: str) -> None:
    """Write the line as it is: whoever reads half of one reads the next in a second, and no work fails for it."""
    if os.environ.get(TOLD):
        with contextlib.suppress(OSError):
            Path(os.environ[TOLD]).write_text(line, "utf-8")
