"""The committed sample of a data set: few images, small, in the data set's own format.

Images are WebP at a quality where the eye sees no difference, and labels are rounded to 1/16 px.

    python -m mmgsd write-sample paper     24 images of each object -> data/sample/cloth; of any other preset
                                           -> data/sample/workspace/cloth
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from mmgsd.checks import check
from mmgsd.command import Option
from mmgsd.config import OBJECTS, load_preset
from mmgsd.dataset import Dataset, check_dataset, load_dataset
from mmgsd.dataset_format import find_owner
from mmgsd.files import check_ours, locked, replace_folder, scratch_folder
from mmgsd.images import encode_image, encode_mask
from mmgsd.paths import Paths, find_root

WEBP_QUALITY = 50  # of WebP, 1 to 100
LABEL_STEP = 1 / 16  # px that labels are rounded to
SAMPLE = {"train": 16, "test": 8}  # images of a sample


def write_sample(folder: Path, out: Path, *, quality: int = WEBP_QUALITY) -> Path:
    """Copy a few images of ``folder``, of as many simulations as possible, into the data set ``out`` (replaced).

    ForeignFileError where ``out`` holds anything but a data set, LockedError while another process works on it.
    """
    check("quality", quality, "between 1 and 100", 1 <= quality <= 100)
    splits = [_thin(load_dataset(folder, split), count) for split, count in SAMPLE.items()]
    with locked(out, "sampling"):
        if out.exists() or out.is_symlink():
            check_ours(out, find_owner(out))  # before minutes of work, and again before it is replaced
        with scratch_folder(out.parent, out.name) as aside:
            for name, data in _encode(splits, quality):
                (aside / name).parent.mkdir(parents=True, exist_ok=True)
                (aside / name).write_bytes(data)
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
    """Names and contents of the sample's files."""
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


def main(
    preset: str = "paper", *, quality: Annotated[int, Option("of WebP, 1 to 100 (default: %(default)s)")] = WEBP_QUALITY
) -> None:
    """Sample both objects of a preset."""
    load_preset(preset)
    paths = Paths(find_root(), preset)
    sample = paths.root / "data" / "sample" / ("" if preset == "paper" else preset)
    for name in OBJECTS:
        print(f"{write_sample(paths.dataset(name), sample / name, quality=quality)}: checked")
    from mmgsd.measure.photographs import write_sample_marks  # needs torch, as nothing else here

    print(f"{write_sample_marks(sample)}: their corners and ends")
