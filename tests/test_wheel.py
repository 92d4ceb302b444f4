"""The wheel, built and tried where neither the checkout nor what a light installation lacks can be imported."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from mmgsd.config import OBJECTS
from mmgsd.paths import find_sample_sets

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "data" / "sample" / "cloth" / "images"
IMAGES = [str(SAMPLE / f"test_{name}_00.webp") for name in ("000007", "000002")]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "mmgsd", "data/weights", "data/sample")
NEWER = re.compile(  # than Python 3.10; of the syntax, ruff tells
    r"file_digest|datetime\.UTC|StrEnum|tomllib|typing import .*\b(Self|override|Never)\b|catch_warnings\(\w"
    r"|itertools\.batched|ExceptionGroup|asyncio\.(TaskGroup|timeout)|contextlib\.chdir|math\.(cbrt|exp2|sumprod)|(?<!os)\.walk\("
)
# Before anything is imported: only the wheel's folder, the light dependencies and those of some extras are there.
REFUSE = """
import importlib.abc, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in REFUSED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name.split(".")[0])

sys.meta_path.insert(0, Refuse())
"""
COMMAND = "import runpy; sys.argv[0] = 'mmgsd'; runpy.run_module('mmgsd', run_name='__main__')"
USE = """
import json, mmgsd
images = [mmgsd.read_image(path) for path in sys.argv[1:]]
modes = {}
for name in ("cloth", "rope"):
    match = mmgsd.load(name).match(*images, xy=[(235, 80)])
    modes[name] = match.modes[0].tolist()
print(json.dumps({"file": mmgsd.__file__, "modes": modes}))
"""


OPTIONAL = "optional-dependencies"
PLOT = """
import mmgsd
A, B = sys.argv[2:4]
mmgsd.load("cloth").match(mmgsd.read_image(A), mmgsd.read_image(B), xy=[(235, 80)]).plot()
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy: a build leaves folders beside its sources."""
    copy, out = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        take = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        take(ROOT / name, copy / name)
    run_pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", out, copy)
    (built,) = out.glob("mmgsd-*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("installed")
    run_pip("install", "--no-deps", "--target", folder, wheel)
    return folder


def run_pip(*arguments: object) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def list_refused(*extras: str) -> list[str]:
    """The importable packages here that mmgsd's installation with some extras would not bring."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    asked, brought = [*project["dependencies"], *(one for name in extras for one in project[OPTIONAL][name])], set()
    while asked:
        one = Requirement(asked.pop())
        name = canonicalize_name(one.name)
        if name not in brought and (one.marker is None or one.marker.evaluate({"extra": ""})):
            brought.add(name)
            asked += importlib.metadata.requires(name) or []
    packages = importlib.metadata.packages_distributions()
    return [name for name, owners in packages.items() if not brought & set(map(canonicalize_name, owners))]


def run_installed(
    folder: Path, cwd: Path, code: str, *arguments: str, extras: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """Run Python with the installed mmgsd alone, from an empty folder, without the environment's settings of ours."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MMGSD_")}
    environment |= {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "MPLBACKEND": "module://of_another.environment"}
    command = [sys.executable, "-c", f"REFUSED = {list_refused(*extras)}\n{REFUSE}{code}", *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


def test_the_wheel_holds_every_module_and_the_shipped_weights(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    kinds = {".py", ".js", ".css", ".html", ".typed"}
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "mmgsd").rglob("*") if path.suffix in kinds}
    kinds = {".safetensors", ".md"}
    shipped = {f"mmgsd/weights/{path.name}" for path in (ROOT / "data" / "weights").iterdir() if path.suffix in kinds}
    sets = [place for name in OBJECTS for place in find_sample_sets(name)]
    sample = [path.relative_to(ROOT / "data" / "sample") for place in sets for path in place.rglob("*.*")]
    samples = {f"mmgsd/samples/{path.as_posix()}" for path in sample}
    assert held == modules | shipped | samples


def test_the_modules_do_without_what_python_3_10_lacks() -> None:
    for path in (ROOT / "mmgsd").rglob("*.py"):
        assert not NEWER.search(path.read_text("utf-8")), path


def test_answers_anywhere_with_the_light_dependencies_alone(installed: Path, tmp_path: Path) -> None:
    done = run_installed(installed, tmp_path, USE, *IMAGES)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert Path(said["file"]).is_relative_to(installed)
    assert {name: len(modes) for name, modes in said["modes"].items()} == {"cloth": 4, "rope": 2}
    assert all(-1 <= value <= 486 for modes in said["modes"].values() for xy in modes for value in xy)


def read_block(start: str) -> str:
    """README's first block of code that begins so."""
    return re.search(rf"^```\w+\n({start}.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.M | re.S)[1]


def test_the_readmes_first_lines_run_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    code = read_block("import mmgsd") + "\nprint(match.modes.shape, both.modes.shape)"
    done = run_installed(installed, tmp_path, code)
    assert (done.returncode, done.stdout) == (0, "(1, 4, 2) (2, 4, 2)\n"), done.stderr


def test_the_readmes_first_command_runs_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MMGSD_")}
    environment |= {"PYTHONPATH": str(installed), "PATH": f"{installed / 'bin'}:{os.environ['PATH']}"}
    for command in read_block("mmgsd match").splitlines():
        done = subprocess.run(["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, ""), command
        assert "px" in done.stdout


def test_answers_for_a_folder_of_images_with_the_light_dependencies_alone(installed: Path, tmp_path: Path) -> None:
    for image in IMAGES:
        shutil.copy(image, tmp_path)
    asked = ["match", IMAGES[0], str(tmp_path), "--xy", "235,80", "--weights", "cloth", "--json"]
    done = run_installed(installed, tmp_path, COMMAND, *asked)
    assert done.returncode == 0, done.stderr
    assert [json.loads(line)["image1"] for line in done.stdout.splitlines()] == sorted(map(os.path.basename, IMAGES))


@pytest.mark.parametrize(("code", "asked", "extra"), [
    (COMMAND, ["match", *IMAGES, "--xy", "235,80", "--weights", "cloth", "--out", "match.png"], "plot"),
    (PLOT, ["match", *IMAGES], "plot"),
    (COMMAND, ["measure", "nowhere"], "notebooks"),
])  # fmt: skip
def test_what_is_not_installed_names_the_extra_to_install(
    installed: Path, tmp_path: Path, code: str, asked: list[str], extra: str
) -> None:
    done = run_installed(installed, tmp_path, code, *asked)
    assert done.returncode and not done.stdout
    assert f"pip install 'mmgsd[{extra}]'" in done.stderr.splitlines()[-1]
    assert ("Traceback" in done.stderr) == (code == PLOT)


@pytest.mark.parametrize("asked", [
    ["match", *IMAGES, "--xy", "235,80", "--out", "one.png"],
    ["fold", str(ROOT / "data" / "demonstrations" / "edge.json"), IMAGES[0], "--out", "one.png"],
])  # fmt: skip
def test_the_extra_plot_is_enough_for_pictures(installed: Path, tmp_path: Path, asked: list[str]) -> None:
    done = run_installed(installed, tmp_path, COMMAND, *asked, "--weights", "cloth", extras=("plot",))
    assert (done.returncode, done.stderr) == (0, "") and done.stdout
    assert [path.stat().st_size > 10_000 for path in tmp_path.iterdir()] == [True]


def test_a_folder_of_a_models_name_does_not_hide_the_model(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "cloth").mkdir()
    done = run_installed(installed, tmp_path, "import mmgsd; print(mmgsd.load('cloth').object)")
    assert done.stdout.strip() == "cloth", done.stderr
