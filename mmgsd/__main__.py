"""The command line ``mmgsd``, or ``python -m mmgsd``: each command is a function, its options are its parameters."""

from __future__ import annotations

import argparse
import functools
import importlib
import inspect
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mmgsd
from mmgsd.command import KEPT, add_arguments, call, run_command

COMMANDS = {  # name: where its function is, seen from this package, and what it does
    "match": ("cli.answers.match", "find all matches of pixels of an image in others"),
    "find": ("cli.answers.find", "find places of the object by name, without a first image"),
    "track": ("cli.answers.track", "follow points of the first frame through a video, each as itself"),
    "segment": ("cli.answers.segment", "write where an image shows the object"),
    "measure": ("cli.weights.measure", "measure on photographs with marked corners or ends"),
    "adapt": ("cli.weights.adapt", "go on from weights with photographs of yours"),
    "fold": ("cli.answers.fold", "say where to pick and place in a picture, as a demonstration did"),
    "export": ("cli.weights.export", "write a network as ONNX: image in, descriptors out"),
    "page": ("cli.weights.page", "write a folder of static files that matches in a browser"),
    "calibrate": ("cli.weights.calibrate", "fit what ellipses, radii and confidences promise, and keep it"),
    "heads": ("cli.weights.heads", "measure the masks, hidden matches and absence that weights tell"),
    "samples": ("cli.answers.samples", "print the paths of two sample images"),
    "reproduce": ("report.reproduce.main", "run every stage of a preset, and judge its numbers"),
    "tables": ("report.tables.main", "make the tables of Markdown files from the results"),
    "interface": ("extras.interface.main", "make docs/api.md from the docstrings"),
    "latex": ("report.latex.main", "make the numbers and tables of paper/report.tex from a preset's results"),
    "ship": ("extras.shipping.main", "put a preset's models into data/weights, or take them back from there"),
    "rounds": ("extras.rounds.main", "train the shipped models on, in rounds of new images"),
    "write-sample": ("extras.sampling.main", "copy a few images of each object of a preset into data/sample"),
    "backbone": ("extras.backbones.main", "make the file of a frozen backbone's weights"),
}
STUDIES = {  # likewise, of the command ``run``: what has options of its own
    "models": ("studies.matrix.main", "train and ask all models of a preset and its baselines, or those of a study"),
    "shipped": ("studies.shipped.main", "shipped weights and baselines on clean and cluttered renders and photographs"),
    "joint": ("studies.joint.main", "whether answers to several pixels belong together"),
    "continuity": ("studies.continuity.main", "whether the matches of neighbouring points neighbour each other"),
    "grasp": ("studies.grasp.main", "take the corner that one is surest of"),
    "folding": ("studies.folding.main", "fold by one demonstration, every policy from the same states"),
    "tracking": ("studies.tracking.main", "points through films of objects that are folded, turned and hidden"),
    "adaptation": ("studies.adaptation.main", "what adapting to photographs gives, by their number"),
}


def main(arguments: list[str] | None = None) -> None:
    """Run a command; `mmgsd.command.run_command` says how it ends."""
    run_command(functools.partial(_run, _join_negative(sys.argv[1:] if arguments is None else arguments)))


def _run(words: list[str]) -> None:
    options = make_parser(words).parse_args(words)
    place, _ = _list_studies()[options._study] if options._command == "run" else COMMANDS[options._command]
    note = KEPT
    if place.startswith("cli."):
        note = _describe_outputs(options)
        os.environ["MPLBACKEND"] = "Agg"  # another environment's, such as a notebook's, may be missing in this one
    run_command(functools.partial(call, load_function(place), options), kept=note)


def load_function(place: str) -> Callable[..., None]:
    """What a command calls, from its place in `COMMANDS` or `STUDIES`."""
    place, _, study = place.partition(":")
    module, _, name = place.rpartition(".")
    function = getattr(importlib.import_module(f"mmgsd.{module}"), name)
    return function(study) if study else function


def _list_studies() -> dict[str, tuple[str, str]]:
    """`STUDIES`, and all others, which have the same options; their files are read, for an import takes seconds."""
    studies = {}
    for module in pkgutil.iter_modules(importlib.import_module("mmgsd.studies").__path__):
        text = Path(module.module_finder.path, f"{module.name}.py").read_text("utf-8")
        name = re.search(r'^STUDY = Study\(\s*"(\w+)"', text, re.MULTILINE)
        line = re.match(r'"""(.*?)\.?("""|\n)', text)
        if name:
            studies[name[1]] = f"studies.registry.make_command:{name[1]}", line[1] if line else ""
    return STUDIES | {name: place for name, place in studies.items() if name not in STUDIES}


def make_parser(words: list[str]) -> argparse.ArgumentParser:
    """The commands, of which the one that ``words`` begin with has its arguments: no other is imported."""
    prog = "python -m mmgsd" if Path(sys.argv[0]).name == "__main__.py" else "mmgsd"
    parser = argparse.ArgumentParser(prog=prog, description=mmgsd.__doc__.partition("\n")[0])
    parser.add_argument("--version", action="version", version=f"mmgsd {mmgsd.__version__}")
    commands = parser.add_subparsers(dest="_command", required=True, metavar="command")
    _add_commands(commands, COMMANDS, words)
    studies = _list_studies() if words[:1] == ["run"] else {}
    line = "run a study, or train what studies compare"
    run = commands.add_parser("run", help=line, description=f"{line[0].upper()}{line[1:]}.")
    _add_commands(run.add_subparsers(dest="_study", required=True, metavar="study"), studies, words[1:])
    return parser


def _add_commands(commands: Any, table: Mapping[str, tuple[str, str]], words: list[str]) -> None:
    for name, (place, line) in table.items():
        command = commands.add_parser(name, help=line, formatter_class=argparse.RawDescriptionHelpFormatter)
        if words[:1] == [name]:
            function = load_function(place)
            documented = function if place.startswith("cli.") else sys.modules[function.__module__]  # with examples
            command.description, _, command.epilog = (inspect.getdoc(documented) or "").partition("\n\n")
            add_arguments(command, function)


def _join_negative(words: list[str]) -> list[str]:
    """``--xy -0.4,3`` as ``--xy=-0.4,3``: argparse takes what begins with a minus for an option."""
    joined = []
    for word in words:
        if joined and joined[-1].startswith("--") and re.match(r"-\.?\d", word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _describe_outputs(options: argparse.Namespace) -> str:
    written = [str(path) for path in (getattr(options, name, None) for name in ("out", "csv")) if path]
    if not written:
        return "there was nothing to keep"
    return f"{' and '.join(written)} {'is as it was' if len(written) == 1 else 'are as they were'} before"


if __name__ == "__main__":
    main()
