"""make builds .venv where it must and never where it need not, and never empties what a link points to."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
MAKEFILE = ROOT / "Makefile"
# Stands for Python and pip: it writes down what it was asked, and makes and empties .venv as venv does.
PYTHON = """#!/bin/sh
echo "$@" >> "$LOG"
case "$*" in
    "-m venv --clear .venv") mkdir -p .venv && rm -rf .venv/* .venv/.installed && mkdir .venv/bin .venv/lib &&
        cp "$0" .venv/bin/python ;;
    *sysconfig*) echo .venv/lib ;;
    *"pip "*) [ ! -e no_network ] ;;
esac
"""


class Checkout:
    """A copy of the Makefile with a small lock, and a Python that installs nothing."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder / "log"
        shutil.copy(MAKEFILE, folder / "Makefile")
        (folder / "environment.lock").write_text("numpy==1.26.4 \\\n    --hash=sha256:0\ntorch==2.13.0+cpu\n")
        (folder / "python").write_text(PYTHON)
        (folder / "python").chmod(0o755)

    def make(self, *words: str) -> subprocess.CompletedProcess:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}
        command = ["make", f"PYTHON={self.folder / 'python'}", *words]
        environment = {**kept, "LOG": str(self.log)}
        return subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=60)

    def builds(self, *words: str) -> bool:
        """Whether a successful make with these words makes the environment anew."""
        self.log.write_text("")
        done = self.make(*words)
        assert done.returncode == 0, done.stderr
        return "-m venv --clear .venv" in self.log.read_text()


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def make_newer(path: Path) -> None:
    os.utime(path, (2_000_000_000, 2_000_000_000))


def test_the_environment_is_made_once(checkout: Checkout) -> None:
    assert checkout.builds(".venv")
    assert not checkout.builds(".venv") and not checkout.builds("lint")


def test_a_newer_date_of_the_lock_rebuilds_nothing_and_another_content_does(checkout: Checkout) -> None:
    lock = checkout.folder / "environment.lock"
    checkout.builds(".venv")
    make_newer(lock)
    assert not checkout.builds("lint")
    lock.write_text(lock.read_text())
    make_newer(checkout.folder / "Makefile")
    assert not checkout.builds(".venv")
    lock.write_text(lock.read_text().replace("1.26.4", "1.26.5"))
    os.utime(lock, (0, 0))
    assert checkout.builds("lint") and not checkout.builds("lint")


@pytest.mark.parametrize("target", [".venv", "lint", "smoke"])
def test_what_a_linked_environment_points_to_is_left_alone(checkout: Checkout, target: str) -> None:
    theirs = checkout.folder / "elsewhere"
    theirs.mkdir()
    (theirs / "precious").write_text("")
    (checkout.folder / ".venv").symlink_to("elsewhere")
    done = checkout.make(target)
    assert done.returncode and ".venv is a link to elsewhere" in done.stderr
    assert [path.name for path in theirs.iterdir()] == ["precious"]


def test_a_linked_environment_of_the_same_lock_is_used(checkout: Checkout) -> None:
    checkout.builds(".venv")
    (checkout.folder / ".venv").rename(checkout.folder / "elsewhere")
    (checkout.folder / ".venv").symlink_to("elsewhere")
    assert not checkout.builds("lint")
    done = checkout.make("lint", "CUDA=1")
    assert done.returncode and "is a link to elsewhere" in done.stderr
    assert (checkout.folder / "elsewhere" / ".installed").is_file()


def test_an_interrupted_installation_is_done_again(checkout: Checkout) -> None:
    (checkout.folder / "no_network").write_text("")
    assert checkout.make(".venv").returncode
    (checkout.folder / "no_network").unlink()
    assert checkout.builds(".venv")
    (checkout.folder / "no_network").write_text("")
    assert checkout.make(".venv", "CUDA=1").returncode  # that of the CPU is gone by then
    (checkout.folder / "no_network").unlink()
    assert checkout.builds("lint")


def test_cuda_replaces_the_cpu_environment_and_stays(checkout: Checkout) -> None:
    checkout.builds(".venv")
    assert checkout.builds(".venv", "CUDA=1")
    assert not checkout.builds("lint") and not checkout.builds("lint", "CUDA=1")


def test_every_target_is_listed(checkout: Checkout) -> None:
    listed = checkout.make("help").stdout
    assert all(f"make {name} " in listed for name in ("reproduce", "test", "data-sample", ".venv", "clean"))


def test_the_lock_has_a_fitting_version_of_every_requirement_and_extra() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]
    pins = dict(re.findall(r"^([\w.-]+)==([^ \\;]+)", (ROOT / "environment.lock").read_text(), re.MULTILINE))
    for requirement in map(Requirement, asked):
        assert requirement.specifier.contains(pins[requirement.name]), requirement


def test_every_imported_package_is_a_requirement() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    light = {Requirement(line).name for line in project["dependencies"]}
    full = light | {Requirement(line).name for extra in ("render", "notebooks") for line in extras[extra]}
    distributions = packages_distributions()
    for path in (ROOT / "mmgsd").rglob("*.py"):
        for package in list_imports(path) - {*sys.stdlib_module_names, "mmgsd", "mathutils"}:  # the last comes with bpy
            assert full & {name.lower().replace("_", "-") for name in distributions[package]}, (path, package)


def list_imports(path: Path) -> set[str]:
    """The top-level packages that a module imports, at its top or within."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module.partition(".")[0])
    return found
