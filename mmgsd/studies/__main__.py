"""The studies from a shell.

    python -m mmgsd.studies list                                        what there is
    python -m mmgsd.studies run sigma --preset quick                    train, ask, write the results, print their path
    python -m mmgsd.studies run sigma --preset paper --set steps=4000   an option of the study, as its `run` names it
"""

from __future__ import annotations

import argparse
import ast
from typing import Any

from mmgsd.command import run_command
from mmgsd.studies.registry import list_studies, run_study


def main() -> None:
    """Run a study, or list them."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.studies", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name the studies, and what shows each")
    run = commands.add_parser("run", help="make the results of one, and go on where it was killed")
    run.add_argument("study")
    run.add_argument("--preset", default="quick")
    run.add_argument("--set", dest="options", action="append", default=[], type=_read_option, metavar="NAME=VALUE",
                     help="an option of the study's run; may be given several times")  # fmt: skip
    args = parser.parse_args()
    if args.command == "list":
        print("\n".join(f"{study.name:<16} {study.notebook}" for study in list_studies()))
    else:
        print(run_study(args.study, args.preset, **dict(args.options)))


def _read_option(text: str) -> tuple[str, Any]:
    """ "steps=4000": the name, and the value as Python writes it, else as text."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"an option must be NAME=VALUE, got {text!r}")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


if __name__ == "__main__":
    run_command(main)
