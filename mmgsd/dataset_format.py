"""What the files of a data set may hold, tested whenever one is opened, and which files of a folder are its own."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from mmgsd.config import RenderConfig, from_dict
from mmgsd.files import ASIDE, DamagedFileError, ForeignFileError, read_json

FORMAT = 1
SPLITS = ("train", "test")
DATASET_FILES = ("dataset.json", "labels.parquet")
REQUIRED_COLUMNS = ("file", "mask", "split", "episode", "view", "xy", "visible", "intrinsics", "camera_pose")
REQUIRED_KEYS = ("format", "object", "size", "symmetry", "default_group", "config", "images", "versions")
LARGEST = 8192  # px that a side of an image may have
REMEDY = "copy or render the data set again (overwrite=True)"

IMAGE, MASK = (re.compile(rf"{place}/(?!\.)[A-Za-z0-9_.-]+\.{ending}") for place, ending in
               (("images", "webp"), ("masks", "png")))  # fmt: skip
RENDERED = re.compile(r"(images/(train|test)_\d+_\d+\.webp)|(masks/(train|test)_\d+_\d+\.png)")
NAME, GROUP = re.compile("[a-z][a-z0-9_-]{0,63}"), re.compile("[A-Za-z][A-Za-z0-9_]{0,31}")
WORDS, DIGEST = re.compile(r"([A-Za-z0-9][A-Za-z0-9 _.,+()-]{0,99})?"), re.compile("[0-9a-f]{64}")
UNREADABLE = (OSError, ValueError, TypeError, LookupError, ArithmeticError, NotImplementedError, MemoryError,
              AttributeError, pa.ArrowException)  # fmt: skip  # what pandas raises about a damaged table


class DatasetError(DamagedFileError):
    """A data set's file is missing, truncated or not of the format; the message names the file."""


def read_info(path: Path) -> dict[str, Any]:
    """The description dataset.json, every value tested; FileNotFoundError, or DatasetError with the key's name."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: no data set here, or one that is still being rendered")
    try:
        info = read_json(path, remedy=REMEDY)
    except DamagedFileError as error:
        raise DatasetError(str(error)) from error
    if not isinstance(info, dict):
        raise DatasetError(f"{path} must hold an object with keys, got {_shorten(info)}: {REMEDY}")
    missing = [key for key in REQUIRED_KEYS if key not in info]
    if missing:
        raise DatasetError(f"{path} lacks the keys {missing}: {REMEDY}")
    if info["format"] != FORMAT or isinstance(info["format"], bool):
        raise DatasetError(f"{path} has format {_shorten(info['format'])}, this version reads {FORMAT}")
    for key, (accepted, fits) in DESCRIBED.items():
        if key in info and not fits(info[key]):
            raise DatasetError(f"{path}: {key} must be {accepted}, got {_shorten(info[key])}: {REMEDY}")
    _check_points(path, info)
    return info


def count_points(info: dict[str, Any]) -> int:
    """Number of material points that a description's groups permute."""
    return len(info["symmetry"][info["default_group"]][0])


def read_labels(path: Path, info: dict[str, Any]) -> pd.DataFrame:
    """The table labels.parquet, tested against its description; DatasetError names the column."""
    try:
        data = path.read_bytes()
        if info.get("labels_sha256") not in (None, hashlib.sha256(data).hexdigest()):
            raise ValueError("its SHA-256 is not the labels_sha256 of dataset.json")
        labels = pd.read_parquet(io.BytesIO(data))
    except UNREADABLE as error:
        raise DatasetError(f"{path} is missing, damaged or no Parquet table: {error}: {REMEDY}") from error
    missing = [name for name in REQUIRED_COLUMNS if name not in labels]
    if missing:
        raise DatasetError(f"{path} lacks the columns {missing}")
    _check_words(path, labels)
    _check_numbers(path, labels, count_points(info))
    counts = labels.split.value_counts().to_dict()
    if counts != info["images"]:
        raise DatasetError(f"{path} has {counts} rows a split, dataset.json says {info['images']}")
    return labels


def encode_table(labels: pd.DataFrame) -> tuple[bytes, str]:
    """A table's Parquet bytes, and their SHA-256 for its description."""
    buffer = io.BytesIO()
    labels.to_parquet(buffer, index=False)
    return buffer.getvalue(), hashlib.sha256(buffer.getvalue()).hexdigest()


def find_owner(folder: Path) -> Callable[[Path], bool]:
    """What tells a data set's own files in ``folder`` from all others, by their paths relative to it.

    Its own are its two tables and what the labels name; where these cannot be read, what is named as rendering does.
    ForeignFileError where a folder holds something and no description of a data set.
    """
    described = folder / "dataset.json"
    if folder.is_dir() and not folder.is_symlink() and any(folder.iterdir()) and not _is_description(described):
        raise ForeignFileError(f"{folder} is not empty and no data set of this project: choose another folder")
    try:
        labels = pd.read_parquet(folder / "labels.parquet", columns=["file", "mask"])
        named = {*labels.file, *labels["mask"]}
    except UNREADABLE:
        named = set()

    def is_ours(path: Path) -> bool:
        """Whether this project writes a file of that path, relative to the data set."""
        name = path.as_posix()
        own = name in DATASET_FILES or (name in named if named else RENDERED.fullmatch(name) is not None)
        return own or ASIDE.fullmatch(path.name) is not None

    return is_ours


def is_member(name: str) -> bool:
    """Whether a path, with ``/`` between its parts, may be one of a data set's files."""
    return name in DATASET_FILES or any(kind.fullmatch(name) for kind in (IMAGE, MASK))


def _is_description(path: Path) -> bool:
    """Whether a file is a data set's description, or a damaged one."""
    if not path.is_file():
        return False
    try:
        values = read_json(path)
    except DamagedFileError:
        return True
    return isinstance(values, dict) and sum(key in values for key in REQUIRED_KEYS) >= len(REQUIRED_KEYS) // 2


def _check_points(path: Path, info: dict[str, Any]) -> None:
    """All groups, and the mirror, must permute the same points."""
    if info["default_group"] not in info["symmetry"]:
        raise DatasetError(f"{path}: default_group must be one of symmetry's, got {_shorten(info['default_group'])}")
    if info["config"].get("object", info["object"]) != info["object"]:
        raise DatasetError(f"{path}: object must be that of config, got {_shorten(info['object'])}")
    points = count_points(info)
    for name, permutations in info["symmetry"].items():
        if len(permutations[0]) != points:
            raise DatasetError(f"{path}: symmetry's group {name!r} must permute {points} points")
    if info.get("mirror") is not None and len(info["mirror"]) != points:
        raise DatasetError(f"{path}: mirror must hold each of 0 to {points - 1} once")


def _check_words(path: Path, labels: pd.DataFrame) -> None:
    """Names of files must be those of the format, never another folder's, and words be plain."""
    patterns = {"file": IMAGE, "mask": MASK}
    for column in labels:
        if pd.api.types.is_numeric_dtype(labels[column]) or column in ("xy", "visible", "intrinsics", "camera_pose"):
            continue
        pattern = patterns.get(column, WORDS)
        values = labels[column] if column in patterns else labels[column].astype(object).fillna("")
        wrong = [value for value in values if not _is_text(value, pattern)]
        if wrong:
            raise DatasetError(f"{path}: {column} must be like {pattern.pattern}, got {_shorten(wrong[0])}: {REMEDY}")
    for column in patterns:
        if not labels[column].is_unique:
            raise DatasetError(f"{path}: {column} names a file twice: {REMEDY}")


def _check_numbers(path: Path, labels: pd.DataFrame, points: int) -> None:
    for column in ("episode", "view"):
        if not pd.api.types.is_integer_dtype(labels[column]) or (labels[column] < 0).any():
            raise DatasetError(f"{path}: {column} must hold integers of at least 0: {REMEDY}")
    for column, length in {"xy": 2 * points, "visible": points, "intrinsics": 9, "camera_pose": 16}.items():
        wrong = labels.index[labels[column].map(np.size) != length]
        if len(wrong):
            raise DatasetError(f"{path}: {column} of row {wrong[0]} is not of length {length}")
        values = np.stack(labels[column].to_list()) if len(labels) else np.zeros(0, bool)
        if values.dtype.kind not in ("b" if column == "visible" else "fiu"):
            raise DatasetError(f"{path}: {column} must hold {'truth values' if column == 'visible' else 'numbers'}")
        if not np.isfinite(values).all():
            raise DatasetError(f"{path}: {column} holds values that are not finite")


def _is_integer(value: Any, least: int, most: float = np.inf) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_text(value: Any, pattern: re.Pattern[str]) -> bool:
    return isinstance(value, str) and pattern.fullmatch(value) is not None


def _is_permutation(value: Any) -> bool:
    integers = isinstance(value, list) and value and all(type(v) is int for v in value)
    return bool(integers) and sorted(value) == list(range(len(value)))


def _are_permutations(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_is_permutation, value))


def _is_table(value: Any, is_key: Callable[[Any], bool], is_value: Callable[[Any], bool]) -> bool:
    return isinstance(value, dict) and all(is_key(key) and is_value(item) for key, item in value.items())


def _is_config(value: Any) -> bool:
    try:
        return bool(from_dict(RenderConfig, value))
    except (ValueError, TypeError):
        return False


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


DESCRIBED: dict[str, tuple[str, Callable[[Any], bool]]] = {  # key: what is accepted, and a test of it
    "object": ("a name of small letters, digits, - and _", lambda v: _is_text(v, NAME)),
    "size": (
        f"[width, height], each 1 to {LARGEST} px",
        lambda v: isinstance(v, list) and len(v) == 2 and all(_is_integer(side, 1, LARGEST) for side in v),
    ),
    "symmetry": (
        "permutations of the points 0, 1, … by the names of their groups",
        lambda v: v and _is_table(v, lambda name: _is_text(name, GROUP), _are_permutations),
    ),
    "default_group": ("a group's name", lambda v: _is_text(v, GROUP)),
    "config": ("what RenderConfig accepts", _is_config),
    "images": (
        f"the number of images of one or more of {SPLITS}",
        lambda v: v and _is_table(v, lambda split: split in SPLITS, lambda count: _is_integer(count, 1)),
    ),
    "versions": (
        "version numbers by the names of packages",
        lambda v: _is_table(v, lambda name: _is_text(name, NAME), lambda n: _is_integer(n, 0) or _is_text(n, WORDS)),
    ),
    "mirror": ("null, or each of the points 0, 1, … once", lambda v: v is None or _is_permutation(v)),
    "packed": (
        '{"quality": 1 to 100}',
        lambda v: v and _is_table(v, lambda key: key == "quality", lambda quality: _is_integer(quality, 1, 100)),
    ),
    "labels_sha256": ("64 hexadecimal digits", lambda v: _is_text(v, DIGEST)),
}
