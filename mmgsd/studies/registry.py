"""What a study says of itself, in its one file, and the loop over all of them that reads, runs and shows them.

A study is a module of this package that defines ``STUDY``. Pages, the report, claims, findings and the verdict find it
there: nothing lists the studies.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import pandas as pd

import mmgsd.studies
from mmgsd.checks import check_choice
from mmgsd.command import Option
from mmgsd.config import PRESETS, Preset, load_preset
from mmgsd.files import DamagedFileError, read_json
from mmgsd.paths import Paths, find_root
from mmgsd.studies.claims import Claim
from mmgsd.studies.parameters import check_made
from mmgsd.studies.table import Table, to_markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REMEDY = "restore it (it may be in git), or run its notebook again with run=True"
Results = Mapping[str, Any]  # {name of a results file: its content}


@dataclass(frozen=True)
class Measure:
    """The least tolerance of a number that the verdict compares: the larger of ``floor`` and ``share``.

    Another number of threads alone moves an RMSE by 2 % and a share of matches by 0.01: of quick, compare rmse.json,
    trained by two, with the seed 0 of seeds.json, trained by one.
    """

    floor: float = 0.0  # in its own unit
    contrastive: float = 0.0  # the floor of PCL and SPCL, whose heatmap's bandwidth is chosen in steps of two
    share: float = 0.0  # of the stored value
    like: str = ""  # the measure whose spread over seeds is its own


ERROR_MEASURES = {
    "rmse_mean": Measure(share=0.03, like="rmse_mean"),
    "median": Measure(share=0.03, like="median"),
    "pck@20px": Measure(floor=0.015, like="pck@20px"),
}


@dataclass(frozen=True)
class Shown:
    """A table or a sentence that documents mark by its name, made from what ``file`` below data/results holds."""

    file: str | tuple[str, ...]  # a folder stands for all of a preset's results, several files for {file: content}
    make: Callable[[Any], Table | str]
    report: str = ""  # what the LaTeX report calls the same table, if it has it


@dataclass(frozen=True)
class Finding:
    """A row of the README's findings, and the section of the results page that it leads to."""

    place: int  # among the findings of all studies
    name: str  # the link
    text: str  # what goes on after it
    section: str
    count: Callable[[Results], Mapping[str, str]]  # {object: cell}, and under "seeds" of how many it is


@dataclass(frozen=True)
class Study:
    """One study, in all of its parts; a part that it lacks is left out.

    ``run`` makes its results file and returns its path, ``check`` is a ValueError that names what ``run`` would lack.
    Both take the `Paths` of a preset and the options that the study has.
    """

    name: str
    place: int  # among the studies, in the order of the table of claims
    run: Callable[..., Path]
    check: Callable[..., None] = lambda paths, **options: None
    notebook: str = ""  # that shows it
    results: Sequence[str] = ()  # names of its results files
    shows: Callable[..., Sequence[Path]] | None = None  # files of the preset that it shows; default: the first result
    derive: Callable[[Path, dict[str, Any]], Results] | None = None  # more, from a preset's folder and its results
    tables: Mapping[str, Shown] = field(default_factory=dict)
    figures: Mapping[str, Callable[[Path], Figure | None]] = field(default_factory=dict)  # from a preset's results
    claims: Sequence[Callable[[Results], Claim]] = ()
    findings: Sequence[Finding] = ()
    compared: Mapping[str, Measure] = field(default_factory=dict)  # by the verdict, of its first results file

    def list_shown(self, paths: Paths, **options: Any) -> Sequence[Path]:
        """The files that the study with these options shows."""
        return self.shows(paths, **options) if self.shows else [paths.results / f"{n}.json" for n in self.results[:1]]

    def load(self, folder: Path) -> dict[str, Any]:
        """{name: content} of its results files that are there, and what it derives from them."""
        files = {name: folder / f"{name}.json" for name in self.results}
        results = {name: read_table(path) for name, path in files.items() if path.is_file()}
        with told_where(next(iter(files.values()), folder)):
            return results | (self.derive(folder, results) if self.derive else {})


@dataclass(frozen=True)
class Experiment:
    """A study of a preset with its options, checked by `open_study`; only with ``runs`` does `run` make anything."""

    study: Study
    paths: Paths
    runs: bool
    options: Mapping[str, Any]
    shown: Sequence[Path]  # files

    @cached_property
    def preset(self) -> Preset:
        """The sizes of the preset."""
        return load_preset(self.paths.preset)

    def run(self) -> Path | None:
        """Make the results, unless stored ones are to be shown; the file."""
        return self.study.run(self.paths, **self.options) if self.runs else None

    def read(self, name: str = "", *, depth: int = 1) -> dict[str, Any]:
        """The content of a results file beside those that the study shows, by default of the first; {} of none."""
        from mmgsd.measure.evaluation import read_results  # with torch

        return read_results(self.shown[0].with_name(f"{name}.json") if name else self.shown[0], depth=depth)

    def draw(self, name: str) -> Figure | None:
        """A figure of the study, from the preset's results; None where these are not there."""
        return self.study.figures[name](self.paths.results)

    def show(self, name: str) -> Any:
        """A table or a sentence of the study from the preset's results, as a notebook displays it."""
        from IPython.display import Markdown

        table = self.study.tables[name]
        file = Path(table.file)
        results = self.read(file.stem) if file.suffix else load_results(self.paths.results)
        return Markdown(to_markdown(table.make(results)))

    def show_file(self, path: Path) -> Any:
        """A stored figure, as a notebook displays it."""
        from mmgsd.figures.stored import show_stored

        return show_stored(path)


def list_modules() -> list[ModuleType]:
    """The modules of all studies, in their order."""
    names = [module.name for module in pkgutil.iter_modules(mmgsd.studies.__path__) if module.name[0] != "_"]
    modules = [importlib.import_module(f"mmgsd.studies.{name}") for name in names]
    return sorted((m for m in modules if hasattr(m, "STUDY")), key=lambda m: (m.STUDY.place, m.STUDY.name))


def list_studies() -> list[Study]:
    """All studies, in their order."""
    return [module.STUDY for module in list_modules()]


def get_study(name: str) -> Study:
    """The study of a name; ValueError where there is none."""
    studies = {study.name: study for study in list_studies()}
    check_choice("study", name, tuple(studies))
    return studies[name]


def open_study(name: str, preset: str, *, run: bool = False, **options: Any) -> Experiment:
    """A study of a preset, to be ``run`` or to be shown from what is stored.

    ValueError, which says what to run first, where what it needs for that is not there.
    """
    study, paths = get_study(name), Paths(find_root(), preset)
    files = study.list_shown(paths, **options)
    if run:
        study.check(paths, **options)
    else:
        by = f"{study.notebook} with run=True" if study.notebook else "python -m mmgsd run " + name
        check_made(paths, by, files)
    return Experiment(study, paths, run, options, files)


def save_figures(figures: Mapping[str, Figure | None], folder: Path) -> pd.DataFrame:
    """Write those of some figures that there are into a folder, as PDF and PNG; the files' names."""
    from mmgsd.figures.style import save_figure

    saved = [path for name, figure in figures.items() if figure for path in save_figure(figure, folder / name)]
    return pd.Series([path.name for path in saved], name="file").to_frame()


def run_study(name: str, preset: str, **options: Any) -> Path:
    """Run a study of a preset; the results file.

    ValueError for an unknown study or preset, and where something has to be made first.
    """
    study, paths = get_study(name), Paths(find_root(), load_preset(preset).name)
    study.check(paths, **options)
    return study.run(paths, **options)


def make_command(name: str) -> Callable[..., None]:
    """What ``mmgsd run NAME`` calls, with its options."""

    def run(
        *,
        preset: Annotated[str, Option("whose models and images", choices=tuple(PRESETS))] = "quick",
        set: Annotated[list, Option("of what the study's `run` takes; may be given several times", type=read_option,
                                    action="append", metavar="NAME=VALUE")] = None,
    ) -> None:  # fmt: skip
        """Run the study, and print where its results are."""
        print(run_study(name, preset, **dict(set or ())))

    run.__module__ = next(module.__name__ for module in list_modules() if module.STUDY.name == name)  # for its words
    return run


def read_option(text: str) -> tuple[str, Any]:
    """ "steps=4000": the name, and the value as Python writes it, else as text."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"must be NAME=VALUE, got {text!r}")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def load_results(folder: Path) -> dict[str, Any]:
    """{name: content} of a preset's results files that are there, and what the studies derive from them."""
    return {name: content for study in list_studies() for name, content in study.load(folder).items()}


def read_table(path: Path) -> dict[str, Any]:
    """The content of a results file; FileNotFoundError, or DamagedFileError where it is no dictionary."""
    values = read_json(path, remedy=REMEDY)
    if not isinstance(values, dict):
        raise DamagedFileError(f"{path} holds no table of results: {REMEDY}")
    return values


@contextmanager
def told_where(path: Path) -> Iterator[None]:
    """Name the file, or the folder, in which a number is missing, or is none."""
    try:
        yield
    except (LookupError, TypeError, AttributeError) as error:
        raise DamagedFileError(f"{path} lacks a number, or has one that is none ({error!r}): {REMEDY}") from error
