"""Figures are drawn whatever backend the environment asks for, and with that one where it can be had."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

DRAW = """
import os
{before}
import mmgsd.figures
from matplotlib import pyplot
pyplot.subplots()[0].savefig("figure.png")
print(pyplot.get_backend().lower(), os.environ.get("MPLBACKEND"))
"""


@pytest.mark.parametrize(
    ("asked", "before", "used"),
    [
        ("none_of_matplotlibs", "", "agg Agg"),
        ("module://of_another.environment", "", "agg Agg"),
        ("module://of_another.environment", "import matplotlib.pyplot", "agg Agg"),
        ("svg", "", "svg svg"),
        ("svg", "import matplotlib; matplotlib.use('pdf')", "pdf svg"),
    ],
)
def test_a_backend_that_is_not_here_is_said_and_replaced(tmp_path, asked: str, before: str, used: str) -> None:
    environment = {**os.environ, "MPLBACKEND": asked, "PYTHONPATH": os.getcwd()}
    command = [sys.executable, "-c", DRAW.format(before=before)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == used and (tmp_path / "figure.png").stat().st_size
    assert (asked in done.stderr and "MPLBACKEND" in done.stderr) == used.startswith("agg")
