"""What imports what: no circle, and training goes without what only baselines need."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import mmgsd

PACKAGE = Path(mmgsd.__file__).parent
MODULES = {".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")}


def list_imports(module: str) -> set[str]:
    """Modules of ours that a module imports when it is imported."""
    names = set()
    for node in ast.parse(MODULES[module].read_text()).body:
        if isinstance(node, ast.ImportFrom):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names & MODULES.keys()


def test_modules_import_each_other_in_no_circle() -> None:
    order = list(TopologicalSorter({module: list_imports(module) for module in MODULES}).static_order())
    assert order.index("mmgsd.match.matcher") < order.index("mmgsd.learn.training")


@pytest.mark.parametrize("module", ["mmgsd.learn.training", "mmgsd.match.matcher", "mmgsd.measure.calibration"])
def test_training_and_matching_go_without_baselines(module: str) -> None:
    unwanted = "m for m in sys.modules if m.startswith(('mmgsd.match.baselines', 'skimage', 'matplotlib'))"
    code = f"import sys, {module}; print([{unwanted}])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
