"""Which package imports which: layers without a circle, and training goes without what only baselines need."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import mmgsd

PACKAGE = Path(mmgsd.__file__).parent
MODULES = {".".join(p.relative_to(PACKAGE.parent).with_suffix("").parts): p for p in PACKAGE.rglob("*.py")}
ATTENDANTS = ("checks", "config", "files", "images", "dataset", "dataset_format", "symmetry", "numerics", "paths",
              "progress", "command", "cluster", "video")  # fmt: skip  # every package but figures may import
LAYERS = {  # package: others that it may import, at the head of a module or in a function
    "model": (),
    "match": ("model",),
    "measure": ("model", "match"),
    "learn": ("model", "match", "measure"),
    "scene": (),
    "fold": ("scene", "match"),
    "figures": (),
    "studies": ("model", "match", "measure", "learn", "scene", "fold", "figures"),
    "report": ("model", "match", "measure", "learn", "scene", "fold", "figures", "studies"),
}  # extras, cli and __main__ may import all
OF_FIGURES = {"files"}  # modules of ours that drawing needs, to write whole files
EXCEPTION = ("mmgsd.match.match", "mmgsd.figures.plots")  # `Match.plot`


def list_imports(module: str, *, everywhere: bool) -> Iterator[str]:
    """Modules of ours that a module imports, in functions too if ``everywhere``; not what only annotations name."""
    tree = ast.parse(MODULES[module].read_text())
    typed = {child for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
             for child in ast.walk(node)}  # fmt: skip
    for node in ast.walk(tree) if everywhere else tree.body:
        if node in typed:
            continue
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in MODULES else node.module for name in names if name.startswith("mmgsd"))
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("mmgsd"))


def find_package(module: str) -> str:
    """ "match" of "mmgsd.match.match", "" of a module that stands beside the packages."""
    parts = module.split(".")
    return parts[1] if (PACKAGE / "/".join(parts[1:2])).is_dir() and len(parts) > 1 else ""


def test_modules_import_each_other_in_no_circle() -> None:
    known = {module: MODULES.keys() & {*list_imports(module, everywhere=False)} for module in MODULES}
    order = list(TopologicalSorter(known).static_order())
    assert order.index("mmgsd.match.matcher") < order.index("mmgsd.learn.training")


def test_packages_are_layers() -> None:
    list(TopologicalSorter(LAYERS).static_order())  # CycleError
    wrong = []
    for module in MODULES:
        package = find_package(module)
        for name in LAYERS.keys() & {package} and list_imports(module, everywhere=True):
            other = find_package(name)
            beside = name.split(".")[1] in (OF_FIGURES if package == "figures" else ATTENDANTS) if not other else False
            fits = beside or other in (package, *LAYERS[package]) or (module, name) == EXCEPTION
            wrong += [] if fits else [f"{module} imports {name}"]
    assert wrong == []


def test_what_stands_beside_the_packages_imports_none() -> None:
    found = {name for name in ATTENDANTS for other in list_imports(f"mmgsd.{name}", everywhere=True)
             if find_package(other)}  # fmt: skip
    assert found == set()


@pytest.mark.parametrize(
    ("code", "without"),
    [
        (
            "import mmgsd.learn.training, mmgsd.measure.calibration",
            ("mmgsd.match.baselines", "skimage", "sklearn", "scipy.stats", "matplotlib", "ipywidgets"),
        ),
        ("from mmgsd.studies.registry import list_studies; list_studies()", ("distributed", "bpy")),
    ],
    ids=["training and matching without baselines", "results without a cluster"],
)
def test_nobody_waits_for_what_others_need(code: str, without: tuple[str, ...]) -> None:
    code += f"; import sys; print([m for m in sys.modules if m.startswith({without})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
