"""Data sets that travel: packed into one small archive each, unpacked and checked elsewhere.

An archive holds the data set in its own format, but for two things: images are WebP at a quality where the eye sees
no difference, and labels are rounded to 1/16 px. Beside it lies a note (JSON) with its SHA-256, size, seed and quality.

    python -m mmgsd.packing pack paper       data/generated/paper/cloth -> data/packs/paper-cloth.zip + .json
    python -m mmgsd.packing unpack paper     and back
    python -m mmgsd.packing sample paper     24 images of each object -> data/sample/cloth
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image
from tqdm.auto import tqdm

from mmgsd.command import run_command
from mmgsd.config import OBJECTS, Paths, find_root, load_preset
from mmgsd.dataset import SPLITS, Dataset, check_dataset, encode_mask, load_dataset

QUALITY = 50  # of WebP, 1 to 100: 4,000 images with their labels stay under 60 MB
LABEL_STEP = 1 / 16  # px that labels are rounded to
SAMPLE = {"train": 16, "test": 8}  # images of a sample
FILES = ("dataset.json", "labels.parquet")
FOLDERS = {"images": ".webp", "masks": ".png"}


def pack_dataset(folder: Path, archive: Path, *, quality: int = QUALITY, progress: bool = True) -> dict:
    """Write a data set into ``archive`` (zip) and a note beside it; returns the note.

    The same data set gives the same bytes with the same versions of the libraries. ValueError for a quality out of
    1 to 100, DatasetError for a damaged data set.
    """
    if not 1 <= quality <= 100:
        raise ValueError(f"quality must be between 1 and 100, got {quality!r}")
    splits = [load_dataset(folder, split) for split in SPLITS]
    total, aside = sum(map(len, splits)), archive.with_suffix(".tmp")
    archive.parent.mkdir(parents=True, exist_ok=True)
    entries = tqdm(_encode(splits, quality), total=2 * total + 2, desc=f"pack {folder.name}", disable=not progress)
    with zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as target:
        for name, data in entries:
            target.writestr(zipfile.ZipInfo(name), data)
    os.replace(aside, archive)
    note = {
        "sha256": hashlib.sha256(archive.read_bytes()).hexdigest(),
        "bytes": archive.stat().st_size,
        "images": {data.split: len(data) for data in splits},
        "seed": splits[0].info["config"].get("seed"),
        "quality": quality,
        "versions": splits[0].info["versions"],
    }
    archive.with_suffix(".json").write_text(json.dumps(note, indent=1) + "\n")
    return note


def unpack_dataset(archive: Path, folder: Path) -> Path:
    """Unpack an archive of `pack_dataset` into the new ``folder``, whole or not at all, and check every image.

    ValueError where the archive is not the one its note describes, or holds files that are none of a data set's;
    FileExistsError where ``folder`` is there already.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists: remove it first, or keep it")
    note, digest = _read_note(archive), hashlib.sha256(archive.read_bytes()).hexdigest()
    if digest != note["sha256"]:
        raise ValueError(f"{archive} is damaged or another file: its SHA-256 is {digest}, expected {note['sha256']}")
    aside = folder.with_name(f"{folder.name}.unpacking")
    shutil.rmtree(aside, ignore_errors=True)
    with zipfile.ZipFile(archive) as source:
        for name in source.namelist():
            if not _is_ours(name):
                raise ValueError(f"{archive} holds {name!r}, which is no file of a data set")
            target = aside / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read(name))
    check_dataset(aside)
    os.replace(aside, folder)
    return folder


def write_sample(folder: Path, out: Path, *, quality: int = QUALITY) -> Path:
    """Copy a few images of ``folder``, of as many simulations as possible, into the data set ``out`` (replaced)."""
    aside = out.with_name(f"{out.name}.writing")
    shutil.rmtree(aside, ignore_errors=True)
    for name, data in _encode([_thin(load_dataset(folder, split), count) for split, count in SAMPLE.items()], quality):
        (aside / name).parent.mkdir(parents=True, exist_ok=True)
        (aside / name).write_bytes(data)
    check_dataset(aside)
    shutil.rmtree(out, ignore_errors=True)
    os.replace(aside, out)
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
            yield row.file, _encode_webp(data.load_image(index), quality)
            yield row.mask, encode_mask(data.load_mask(index))
    labels = pd.concat([data.labels for data in splits], ignore_index=True)
    yield "labels.parquet", _encode_labels(labels, splits[0].size)
    counts = {data.split: len(data) for data in splits}
    yield "dataset.json", json.dumps({**splits[0].info, "images": counts, "packed": {"quality": quality}}).encode()


def _encode_webp(image: np.ndarray, quality: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "WEBP", quality=quality, method=6)
    return buffer.getvalue()


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


def _read_note(archive: Path) -> dict:
    for path in (archive, archive.with_suffix(".json")):
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} does not exist: an archive and its note belong together, are made by `make data-pack` on the "
                "machine that rendered, and are copied here by you, for they are not in git"
            )
    return json.loads(archive.with_suffix(".json").read_text())


def _is_ours(name: str) -> bool:
    path = PurePosixPath(name)
    if len(path.parts) == 1:
        return name in FILES
    return len(path.parts) == 2 and FOLDERS.get(path.parts[0]) == path.suffix and ".." not in path.parts


def main() -> None:
    """Pack, unpack or sample both objects of a preset."""
    parser = argparse.ArgumentParser(prog="python -m mmgsd.packing", description=__doc__.split("\n")[0])
    parser.add_argument("action", choices=("pack", "unpack", "sample"))
    parser.add_argument("preset", nargs="?", default="paper")
    parser.add_argument("--quality", type=int, default=QUALITY, help="of WebP, 1 to 100 (default %(default)s)")
    asked = parser.parse_args()
    load_preset(asked.preset)
    paths = Paths(find_root(), asked.preset)
    for name in OBJECTS:
        folder, archive = paths.dataset(name), paths.root / "data" / "packs" / f"{asked.preset}-{name}.zip"
        if asked.action == "pack":
            note = pack_dataset(folder, archive, quality=asked.quality)
            print(f"{archive}: {note['bytes'] / 1e6:.1f} MB, SHA-256 {note['sha256']}, seed {note['seed']}")
        elif asked.action == "unpack":
            print(f"{unpack_dataset(archive, folder)}: complete and checked")
        else:
            print(f"{write_sample(folder, paths.root / 'data' / 'sample' / name, quality=asked.quality)}: checked")


if __name__ == "__main__":
    run_command(
        main, kept="finished archives and data sets are kept, an unfinished one is made anew by the same command"
    )
