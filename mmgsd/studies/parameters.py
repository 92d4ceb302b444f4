"""What a notebook may be told: every parameter is read and checked before anything slow or destructive is done.

A reader takes a parameter's name and what it was given, and returns what the notebook goes on with, or raises the
ValueError that names both and what is accepted. papermill hands over text for all but True, False and numbers, so
readers take text as well: "8", "false", "[1, 4]", "cloth rope".
"""

from __future__ import annotations

import ast
import json
import math
import numbers
import re
from collections.abc import Callable, Collection, Iterable, Mapping, MutableMapping
from pathlib import Path
from typing import Any

from mmgsd.checks import check, check_choice, describe_choices, read_flag  # noqa: F401  # a reader as well
from mmgsd.config import OBJECTS, PRESETS, TrainConfig
from mmgsd.paths import Paths, find_root, find_shipped
from mmgsd.studies.models import list_rows

Reader = Callable[[str, Any], Any]
INJECTED = "# Parameters"  # how the cell begins that papermill puts after the one tagged ``parameters``


def read_parameters(namespace: MutableMapping[str, Any], **readers: Reader) -> None:
    """Replace each named parameter in a notebook's ``globals()`` by what its reader makes of it: all of them, or none.

    ValueError from the first reader that refuses, for a parameter that is not set, and for one that is no parameter of
    this notebook: papermill runs on after a mistyped name.
    """
    for cell in namespace.get("In", [])[-3:-1]:  # the parameters and papermill's, if this cell is run after them
        for name in _list_assigned(cell, readers):
            if name not in readers:
                raise ValueError(f"{name} is no parameter of this notebook: {describe_choices(name, readers)}")
    for name in readers:
        if name not in namespace:
            raise ValueError(f"{name} must be set in the cell of the parameters")
    namespace.update({name: reader(name, namespace[name]) for name, reader in readers.items()})


def open_paths(preset: str) -> Paths:
    """Where a preset's files lie in this checkout."""
    return Paths(find_root(), preset)


def choose_objects(objects: str | Iterable[str]) -> list[str]:
    """The cloth, the rope, or both, as a study is told; ValueError for others."""
    names = [objects] if isinstance(objects, str) else list(objects)
    for name in names:
        check_choice("objects", name, OBJECTS)
    return names


def check_made(paths: Paths, by: str, files: Iterable[Path], **options: str) -> None:
    """ValueError where one of ``files`` is not there; ``by`` makes it, for the preset and the other ``options``."""
    same = ", ".join(f"{name}={value!r}" for name, value in {"preset": paths.preset, **options}.items())
    for file in files:
        if not file.exists():
            place = file.relative_to(paths.root) if file.is_relative_to(paths.root) else file
            raise ValueError(f"for {same} there is no {place} yet: run {by} for it first")


def check_images(paths: Paths, objects: Iterable[str], *, split: str = "test") -> None:
    """ValueError where the images of a split of any of ``objects`` are not rendered."""
    files = [paths.dataset(name) / "dataset.json" for name in objects]
    check_made(paths, "01_render_data with run=True", files)
    for file in files:
        if split not in json.loads(file.read_text())["images"]:
            raise ValueError(f"for preset={paths.preset!r} there are no {split} images in {file.parent}: "
                             "run 01_render_data for it with run=True, only_test=False first")  # fmt: skip


def check_training(paths: Paths, models: Iterable[TrainConfig], *, overwrite: bool = False) -> None:
    """ValueError where images are missing that ``models`` need: test images, and training images of what is trained."""
    from mmgsd.model.tensors import WEIGHTS  # with torch: not in every notebook that reads parameters

    there = {model: (paths.model(model) / WEIGHTS).is_file() and not overwrite for model in models}
    check_images(paths, sorted({model.object for model in there}))
    check_images(paths, sorted({model.object for model, trained in there.items() if not trained}), split="train")


def one_of(choices: Collection[str]) -> Reader:
    """A reader of one of some names."""

    def read(name: str, value: Any) -> str:
        """The choice, without blanks around it."""
        check(name, value, describe_choices(value, choices), isinstance(value, str) and value.strip() in choices)
        return value.strip()

    return read


read_preset = one_of(PRESETS)
read_method = one_of([row.name for row in list_rows("main")])  # the main table has the same models in every preset


def among(values: Collection[int], whose: str) -> Reader:
    """A reader of one of some whole numbers, ``whose`` says which these are."""
    first = ", ".join(map(str, sorted(values)[:3]))
    return _numbers(f"one of {whose} ({first}, … {max(values)})", lambda value: value in values, int)


def whole(least: int = 0, most: float = math.inf) -> Reader:
    """A reader of whole numbers from ``least`` on, up to and with ``most`` if given."""
    accepted = f"a whole number {_describe_range(least, most)}"
    return _numbers(accepted, lambda value: value == int(value) and least <= value <= most, int)


def number(*, above: float | None = None, least: float = -math.inf, most: float = math.inf) -> Reader:
    """A reader of finite numbers ``above`` one, or from ``least`` to ``most``."""
    accepted = f"a number {_describe_range(least, most)}" if above is None else f"a number greater than {above:g}"
    return _numbers(accepted, lambda value: least <= value <= most and (above is None or value > above), float)


def _numbers(accepted: str, fits: Callable[[float], bool], kind: type) -> Reader:
    def read(name: str, value: Any) -> Any:
        """The number, of the kind that is asked for."""
        parsed = _to_number(value)
        check(name, value, accepted, parsed is not None and fits(parsed))
        return kind(parsed)

    return read


def listed(reader: Reader, *, least: int = 0, most: float = math.inf) -> Reader:
    """A reader of lists of so many items; text may hold a list, or items between commas or blanks."""
    accepted = f"a list, its length {least if least == most else _describe_range(least, most)}"

    def read(name: str, value: Any) -> list:
        """Each item as ``reader`` reads it."""
        items = _to_list(value)
        check(name, value, accepted, items is not None and least <= len(items) <= most)
        return [reader(f"each of {name}", item) for item in items]

    return read


def optional(reader: Reader) -> Reader:
    """A reader that takes "" (or None) as well, and returns "" then."""

    def read(name: str, value: Any) -> Any:
        """What ``reader`` reads, or ""."""
        if value is None or value == "":
            return ""
        try:
            return reader(name, value)
        except ValueError as error:
            raise ValueError(f'{error}; or "" for none') from error

    return read


def read_pixels(name: str, value: Any) -> list:
    """At least one pixel, as `mmgsd.images.check_pixels` takes and checks them, or text that holds such a list."""
    pixels = _to_list(value)
    check(name, value, "pixels [[column, row], …] of image0, such as [[235, 80]]", bool(pixels))
    return pixels


def read_device(name: str, value: Any) -> str:
    """What torch computes on: "" for the GPU where there is one, "cpu", "cuda", or the GPU of a number, "cuda:1"."""
    from mmgsd.model.network import find_device  # with torch: not in every notebook that reads parameters

    return "" if value is None or value == "" else find_device(value)


def read_scheduler(name: str, value: Any) -> str:
    """The address of a Dask scheduler that answers, host:port or tcp://host:port; "" (or None) for none."""
    if value is None or value == "":
        return ""
    from mmgsd.cluster import check_scheduler

    return check_scheduler(name, value)


def read_weights(name: str, value: Any) -> str:
    """Trained weights: the name of a model in data/weights, or a safetensors file (see `read_file`)."""
    shipped = sorted(path.stem for path in find_shipped().glob("*.safetensors"))
    if value in shipped:
        return value
    try:
        file = read_file(name, value)
    except ValueError as error:
        raise ValueError(f"{error}; or {describe_choices(value, shipped)}") from error
    return str(value) if Path(value).is_file() else str(file)  # a model's name depends on how its start was written


def read_object(name: str, value: Any) -> str:
    """The name of a file in data/objects."""
    return one_of(sorted(path.stem for path in (find_root() / "data" / "objects").glob("*.json")))(name, value)


def read_file(name: str, value: Any) -> Path:
    """An existing file, by one rule wherever a path is asked for.

    A relative path is looked for from where the notebook or the command was started, then from the repository's root;
    ``~`` is the home folder.
    """
    if not isinstance(value, str | Path) or not str(value).strip():
        raise ValueError(f"{name} must be the path of a file, got {value!r}")
    path = Path(value).expanduser()
    places = dict.fromkeys(place / path for place in (Path.cwd(), find_root()))  # an absolute path stays as it is
    for place in places:
        if place.is_file():
            return place
    looked = " or ".join(map(str, places))
    raise ValueError(f"{name} must be the path of a file that exists, got {str(value)!r}: there is no file {looked}")


def _list_assigned(cell: str, parameters: Mapping[str, Any]) -> list[str]:
    """The names that a cell assigns: one that papermill wrote, or assigns some of ``parameters`` and only values."""
    try:
        statements = ast.parse(cell).body
    except SyntaxError:
        return []
    if not all(isinstance(s, ast.Assign) and isinstance(s.targets[0], ast.Name) for s in statements):
        return []
    names = [statement.targets[0].id for statement in statements]
    return names if cell.startswith(INJECTED) or set(names) & set(parameters) else []


def _describe_range(least: float, most: float) -> str:
    return f"from {least:g} on" if math.isinf(most) else f"from {least:g} to {most:g}"


def _to_number(value: Any) -> float | None:
    """A finite number, or text that is one."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real | str):
        return None
    try:
        result = float(value)
    except (ValueError, OverflowError):
        return None
    return result if math.isfinite(result) else None


def _to_list(value: Any) -> list | None:
    """The items of a list, of text that holds one, or of text between commas or blanks; a number is a list of one."""
    if isinstance(value, str):
        text = value.strip()
        try:
            value = ast.literal_eval(text)
        except (ValueError, SyntaxError, TypeError):
            value = [item for item in re.split(r"[\s,]+", re.sub(r"^\[(.*)\]$", r"\1", text)) if item]
        value = [value] if isinstance(value, str) else value
    if _to_number(value) is not None:
        return [value]
    return list(value) if isinstance(value, Iterable) and not isinstance(value, Mapping) else None
