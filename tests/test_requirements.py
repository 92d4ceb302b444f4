"""Every extra can be installed: no requirement asks a supported Python for what that cannot have."""

from __future__ import annotations

import importlib.metadata
import itertools
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = {name: list(map(Requirement, lines)) for name, lines in PROJECT["optional-dependencies"].items()}
PYTHONS = [f"3.{minor}" for minor in range(8, 16) if f"3.{minor}" in SpecifierSet(PROJECT["requires-python"])]


def choose(asked: list[Requirement], python: str) -> list[Requirement]:
    """What a Python takes of some requirements."""
    there = {"python_version": python, "python_full_version": f"{python}.0", "extra": ""}
    return [one for one in asked if one.marker is None or one.marker.evaluate(there)]


def list_needs(asked: list[Requirement], python: str) -> Iterator[Requirement]:
    """What is asked for, and what the pinned ones of it ask for in turn."""
    for one in choose(asked, python):
        yield one
        if any(part.operator == "==" for part in one.specifier):
            yield from choose(list(map(Requirement, importlib.metadata.requires(one.name) or ())), python)


@pytest.mark.parametrize(("extra", "python"), list(itertools.product(EXTRAS, PYTHONS)))
def test_what_an_extra_pins_is_to_be_had_for_each_python_that_takes_it(extra: str, python: str) -> None:
    needed: dict[str, SpecifierSet] = {}
    for one in list_needs([*map(Requirement, PROJECT["dependencies"]), *EXTRAS[extra]], python):
        needed[one.name.lower()] = needed.get(one.name.lower(), SpecifierSet()) & one.specifier
    for name, versions in needed.items():
        bounds = {Version(part.version.rstrip(".*")) for part in versions}
        nearby = {Version(f"{bound}.{end}") for bound in bounds for end in ("1", "999")} | bounds | {Version("0.0.1")}
        assert not versions or any(versions.contains(version) for version in nearby), (name, versions)
    for one in choose(EXTRAS[extra], python):
        if any(part.operator == "==" for part in one.specifier):
            metadata = importlib.metadata.metadata(one.name)
            assert metadata["Version"] in one.specifier
            assert f"{python}.99" in SpecifierSet(metadata["Requires-Python"] or ""), one


def test_uv_resolves_all_extras_for_every_python(tmp_path: Path) -> None:
    if not (uv := shutil.which("uv")):
        pytest.skip("uv is not installed")
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text("utf-8"), "utf-8")
    (tmp_path / "README.md").write_text("")
    done = subprocess.run([uv, "lock", "--no-progress"], cwd=tmp_path, capture_output=True, text=True, timeout=600)
    if done.returncode and "No solution found" not in done.stderr:
        pytest.skip(f"uv reaches no index: {done.stderr.strip()[-300:]}")
    assert done.returncode == 0, done.stderr
    locked = set(re.findall(r'^name = "(.+)"$', (tmp_path / "uv.lock").read_text("utf-8"), re.MULTILINE))
    assert {one.name.lower() for asked in EXTRAS.values() for one in asked} <= locked
