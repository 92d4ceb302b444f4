"""Notebooks import little, have short cells, and show the figures that they draw."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
NAMES, LINES = 6, 12  # of ours that a notebook imports, of a cell


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_imports_little_and_has_short_cells(path: Path) -> None:
    cells = [cell for cell in json.loads(path.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]
    sources = ["".join(line for line in cell["source"] if line[0] not in "%!") for cell in cells]
    statements = [node for source in sources for node in ast.walk(ast.parse(source))
                  if isinstance(node, ast.Import | ast.ImportFrom)]  # fmt: skip
    ours = [alias.name for node in statements for alias in node.names
            if (getattr(node, "module", None) or alias.name).startswith("mmgsd")]  # fmt: skip
    assert len(ours) <= NAMES
    assert max(len(source.splitlines()) for source in sources) <= LINES


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_stored_figure_is_a_picture(path: Path) -> None:
    shown = [output["data"] for cell in json.loads(path.read_text("utf-8"))["cells"]
             for output in cell.get("outputs", []) if "data" in output]  # fmt: skip
    for data in shown:
        if "".join(data.get("text/plain", "")).startswith("<Figure"):
            assert any(kind.startswith("image/") for kind in data)
