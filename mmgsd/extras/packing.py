"""Data sets that travel: packed into one small archive each, unpacked and checked elsewhere.

An archive holds the data set in its own format, but for two things: images are WebP at a quality where the eye sees
no difference, and labels are rounded to 1/16 px. Beside it lie a note (JSON) with its SHA-256, size, seed and quality,
and Croissant metadata for data catalogues.

    python -m mmgsd.extras.packing pack paper       data/generated/paper/cloth -> data/packs/paper-cloth.zip + .json
    python -m mmgsd.extras.packing unpack paper     and back
    python -m mmgsd.extras.packing describe paper   Croissant metadata beside each note, from both
    python -m mmgsd.extras.packing sample paper     24 images of each object -> data/sample/cloth; of any other preset
                                                    -> data/sample/workspace/cloth
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from mmgsd.checks import read_flag
from mmgsd.command import run_command
from mmgsd.config import OBJECTS, load_preset
from mmgsd.dataset import Dataset, check_dataset, load_dataset
from mmgsd.dataset_format import SPLITS, TABLES, find_owner, is_member
from mmgsd.extras.croissant import write_croissant
from mmgsd.files import (
    DamagedFileError,
    ForeignFileError,
    check_ours,
    locked,
    read_json,
    replace_folder,
    saying_what_stays,
    scratch_folder,
    write_json,
    writing,
)
from mmgsd.images import encode_image, encode_mask
from mmgsd.paths import Paths, find_root
from mmgsd.progress import ProgressBar

QUALITY = 50  # of WebP, 1 to 100: 4,000 images with their labels stay under 60 MB
LABEL_STEP = 1 / 16  # px that labels are rounded to
SAMPLE = {"train": 16, "test": 8}  # images of a sample


def pack_dataset(folder: Path, archive: Path, *, quality: int = QUALITY, progress: bool = True) -> dict:
    """Write a data set into ``archive`` (zip) and a note beside it; returns the note.

    The same data set gives the same bytes with the same versions of the libraries. ValueError for a quality out of
    1 to 100, DatasetError for a damaged data set, ForeignFileError where the archive would replace another file,
    LockedError while another process packs into it.
    """
    quality, progress = _read_quality(quality), read_flag("progress", progress)
    _check_replaceable(archive)
    splits = [load_dataset(folder, split) for split in SPLITS]
    entries = _encode(splits, quality)
    bar = ProgressBar(entries, total=2 * sum(map(len, splits)) + 2, desc=f"pack {folder.name}", disable=not progress)
    with locked(archive, "packing"), saying_what_stays(lambda: f"stopped: {archive} is as it was before"):
        with writing(archive) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as target:
            for name, data in bar:
                target.writestr(zipfile.ZipInfo(name), data)
        note = _write_note(archive, splits, quality)
        write_croissant(archive, splits[0].info, note)
        return note


def _write_note(archive: Path, splits: list[Dataset], quality: int) -> dict:
    note = {
        "sha256": _hash(archive),
        "bytes": archive.stat().st_size,
        "images": {data.split: len(data) for data in splits},
        "seed": splits[0].info["config"].get("seed"),
        "quality": quality,
        "versions": splits[0].info["versions"],
    }
    write_json(archive.with_suffix(".json"), note)
    return note


def describe_archive(archive: Path, folder: Path) -> Path:
    """Write the Croissant metadata of an archive, which need not be here, from its note and the data set it packs."""
    return write_croissant(archive, load_dataset(folder, SPLITS[0]).info, _read_note(archive, alone=True))


def _check_replaceable(archive: Path) -> None:
    """ForeignFileError where the archive's place, or its note's, is taken by what no packing wrote."""
    note = archive.with_suffix(".json")
    if note.is_file() and "sha256" not in note.read_text(errors="replace"):
        raise ForeignFileError(f"{note} is no note of an archive: move it away, or choose another name")
    if archive.exists() and not note.is_file():
        raise ForeignFileError(f"{archive} has no note beside it, so it is not ours: move it, or choose another name")


def unpack_dataset(archive: Path, folder: Path) -> Path:
    """Unpack an archive of `pack_dataset` into the new ``folder``, whole or not at all, and check every image.

    ValueError where the archive is not the one its note describes, or holds files that are none of a data set's or
    more than the note says; FileExistsError where ``folder`` is there already.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists: remove it first, or keep it")
    note = _read_note(archive)
    digest = _hash(archive)
    if digest != note["sha256"]:
        raise DamagedFileError(
            f"{archive} is damaged or another file: its SHA-256 is {digest}, expected {note['sha256']}: copy both again"
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with locked(folder, "unpacking"), scratch_folder(folder.parent, folder.name) as aside:
        _write_members(_read_members(archive, note), aside)
        check_dataset(aside)
        replace_folder(aside, folder, find_owner(folder))
    return folder


def _read_members(archive: Path, note: dict) -> Iterator[tuple[str, bytes]]:
    """Names and contents of an archive's files, after all their names and sizes were tested."""
    try:
        with zipfile.ZipFile(archive) as source:
            _check_members(archive, source.infolist(), note)
            for member in source.infolist():
                yield member.filename, source.read(member)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise DamagedFileError(f"{archive} is damaged ({error}): copy it and its note again") from error


def _check_members(archive: Path, members: list[zipfile.ZipInfo], note: dict) -> None:
    """What is packed is stored as it is, a file once: it can unpack to no more than the archive's own size."""
    for member in members:
        if not is_member(member.filename):
            raise ValueError(f"{archive} holds {member.filename!r}, which is no file of a data set")
        if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
            raise ValueError(f"{archive} holds {member.filename!r} compressed, which no archive of ours does")
    size, count = sum(member.file_size for member in members), 2 * sum(note["images"].values()) + len(TABLES)
    if size > note["bytes"]:
        raise ValueError(f"{archive} unpacks to {size} bytes, and its note says that it has {note['bytes']}")
    if len(members) != count or len({member.filename for member in members}) != count:
        raise ValueError(f"{archive} holds {len(members)} files, and by its note these should be {count}")


def _write_members(members: Iterator[tuple[str, bytes]], folder: Path) -> None:
    """Write files into a folder that takes its place as a whole later."""
    for name, data in members:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def write_sample(folder: Path, out: Path, *, quality: int = QUALITY) -> Path:
    """Copy a few images of ``folder``, of as many simulations as possible, into the data set ``out`` (replaced).

    ForeignFileError where ``out`` holds anything but a data set, LockedError while another process works on it.
    """
    quality = _read_quality(quality)
    splits = [_thin(load_dataset(folder, split), count) for split, count in SAMPLE.items()]
    with locked(out, "sampling"):
        if out.exists() or out.is_symlink():
            check_ours(out, find_owner(out))  # before minutes of work, and again before it is replaced
        with scratch_folder(out.parent, out.name) as aside:
            _write_members(_encode(splits, quality), aside)
            check_dataset(aside)
            replace_folder(aside, out, find_owner(out))
    return out


def _thin(data: Dataset, count: int) -> Dataset:
    """A split of ``count`` images: the first view of simulations evenly spread over it."""
    first = data.labels.drop_duplicates("episode")
    if len(first) < count:
        raise ValueError(f"{data.folder} must show at least {count} simulations in {data.split}, got {len(first)}")
    labels = first.iloc[np.linspace(0, len(first) - 1, count).astype(int)].reset_index(drop=True)
    return Dataset(data.folder, data.split, data.info, labels)


def _encode(splits: list[Dataset], quality: int) -> Iterator[tuple[str, bytes]]:
    """Names and contents of a packed data set's files."""
    for data in splits:
        for index, row in enumerate(data.labels.itertuples()):
            yield row.file, encode_image(data.load_image(index), quality=quality)
            yield row.mask, encode_mask(data.load_mask(index))
    labels = pd.concat([data.labels for data in splits], ignore_index=True)
    table, counts = _encode_labels(labels, splits[0].size), {data.split: len(data) for data in splits}
    yield "labels.parquet", table
    own = {"images": counts, "packed": {"quality": quality}, "labels_sha256": hashlib.sha256(table).hexdigest()}
    yield "dataset.json", json.dumps({**splits[0].info, **own}).encode()


def _encode_labels(labels: pd.DataFrame, size: tuple[int, int]) -> bytes:
    xy = np.round(np.stack(labels.xy.to_list()) / LABEL_STEP).reshape(len(labels), -1, 2) * LABEL_STEP
    inside = xy.clip(LABEL_STEP - 0.5, np.array(size) - 0.5 - LABEL_STEP)  # rounding must not put what is seen outside
    xy = np.where(np.stack(labels.visible.to_list())[..., None], inside, xy).reshape(len(labels), -1)
    table = pa.Table.from_pandas(labels.assign(xy=list(xy.astype(np.float32))), preserve_index=False)
    plain = [c for c in table.column_names if c not in ("xy", "intrinsics", "camera_pose")]
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd", compression_level=19, use_dictionary=plain,
                   use_byte_stream_split=["xy.list.element"])  # fmt: skip
    return buffer.getvalue()


def _read_note(archive: Path, *, alone: bool = False) -> dict:
    """What is said of an archive, which must be there unless the note is asked for ``alone``."""
    path = archive.with_suffix(".json")
    for file in (path,) if alone else (archive, path):
        if not file.is_file():
            raise FileNotFoundError(
                f"{file} does not exist: an archive and its note belong together, are made by `make data-pack` on the "
                "machine that rendered, and are copied here by you, for they are not in git"
            )
    note = read_json(path, remedy="copy it and its archive again")
    kinds = {"sha256": str, "bytes": int, "images": dict}
    wrong = [key for key, kind in kinds.items() if not isinstance(note, dict) or not isinstance(note.get(key), kind)]
    if wrong or not all(isinstance(count, int) for count in note["images"].values()):
        raise DamagedFileError(f"{path} does not say {', '.join(wrong or ['images'])}: copy it and its archive again")
    return note


def _hash(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def _read_quality(quality: int) -> int:
    if not isinstance(quality, int) or isinstance(quality, bool) or not 1 <= quality <= 100:
        raise ValueError(f"quality must be between 1 and 100, got {quality!r}")
    return quality


def main() -> None:
    """Pack, unpack, describe or sample both objects of a preset."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.extras.packing", description=__doc__.split("\n")[0])
    parser.add_argument("action", choices=("pack", "unpack", "describe", "sample"))
    parser.add_argument("preset", nargs="?", default="paper")
    parser.add_argument("--quality", type=int, default=QUALITY, help="of WebP, 1 to 100 (default %(default)s)")
    args = parser.parse_args()
    load_preset(args.preset)
    paths = Paths(find_root(), args.preset)
    sample = paths.root / "data" / "sample" / ("" if args.preset == "paper" else args.preset)
    for name in OBJECTS:
        folder, archive = paths.dataset(name), paths.root / "data" / "packs" / f"{args.preset}-{name}.zip"
        if args.action == "pack":
            note = pack_dataset(folder, archive, quality=args.quality)
            print(f"{archive}: {note['bytes'] / 1e6:.1f} MB, SHA-256 {note['sha256']}, seed {note['seed']}")
        elif args.action == "describe":
            print(describe_archive(archive, folder))
        elif args.action == "unpack":
            print(f"{unpack_dataset(archive, folder)}: complete and checked")
        else:
            print(f"{write_sample(folder, sample / name, quality=args.quality)}: checked")
    if args.action == "sample":
        from mmgsd.measure.photographs import write_sample_marks  # needs torch, as nothing else here

        print(f"{write_sample_marks(sample)}: their corners and ends")


if __name__ == "__main__":
    run_command(
        main, kept="finished archives and data sets are kept, an unfinished one is made anew by the same command"
    )
