"""Packing: small, repeatable, nearly lossless; an archive that is not what its note says is not unpacked."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mmgsd.config import OBJECTS
from mmgsd.dataset import check_dataset, load_dataset
from mmgsd.extras import packing
from mmgsd.extras.packing import LABEL_STEP, pack_dataset, unpack_dataset, write_sample
from mmgsd.files import ForeignFileError, LockedError, locked

SAMPLE = Path(__file__).resolve().parents[2] / "data" / "sample"


@pytest.fixture
def archive(cloth_dataset: Path, tmp_path: Path) -> Path:
    """The shared cloth data set, packed."""
    pack_dataset(cloth_dataset, tmp_path / "cloth.zip", progress=False)
    return tmp_path / "cloth.zip"


def test_what_is_unpacked_is_what_was_packed(archive: Path, cloth_dataset: Path, tmp_path: Path) -> None:
    unpacked = unpack_dataset(archive, tmp_path / "back")
    for split in ("train", "test"):
        before, after = load_dataset(cloth_dataset, split), load_dataset(unpacked, split)
        assert np.abs(before.xy - after.xy).max() <= LABEL_STEP / 2 + 1e-5
        assert np.array_equal(before.visible, after.visible)
        for i in range(len(before)):
            assert np.array_equal(before.load_mask(i), after.load_mask(i))
            assert np.abs(before.load_image(i).astype(int) - after.load_image(i)).mean() < 3.0
    assert before.fingerprint != after.fingerprint  # a model must say which of the two it was trained on


def test_same_data_same_bytes(archive: Path, cloth_dataset: Path, tmp_path: Path) -> None:
    note = pack_dataset(cloth_dataset, tmp_path / "again.zip", progress=False)
    assert (tmp_path / "again.zip").read_bytes() == archive.read_bytes()
    assert note == json.loads(archive.with_suffix(".json").read_text())


def test_a_damaged_archive_is_refused_and_leaves_nothing(archive: Path, tmp_path: Path) -> None:
    data = bytearray(archive.read_bytes())
    data[len(data) // 2] ^= 1
    archive.write_bytes(data)
    with pytest.raises(ValueError, match=r"cloth\.zip is damaged or another file: its SHA-256 is"):
        unpack_dataset(archive, tmp_path / "back")
    assert not (tmp_path / "back").exists()


@pytest.mark.parametrize("name", ["../evil.webp", "images/../../evil.webp", "/etc/evil.webp", "run.py", "images/a.py"])
def test_files_of_no_data_set_are_refused(archive: Path, tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(archive, "a") as target:
        target.writestr(name, b"")
    note = json.loads(archive.with_suffix(".json").read_text())
    note["sha256"] = packing.hashlib.sha256(archive.read_bytes()).hexdigest()
    archive.with_suffix(".json").write_text(json.dumps(note))
    with pytest.raises(ValueError, match="which is no file of a data set"):
        unpack_dataset(archive, tmp_path / "folder" / "back")
    assert not list(tmp_path.rglob("evil*"))


def repack(archive: Path, change: Callable[[zipfile.ZipFile], None], **said: object) -> None:
    """Add to an archive, and have its note say so."""
    with zipfile.ZipFile(archive, "a") as target:
        change(target)
    note = json.loads(archive.with_suffix(".json").read_text())
    note |= {"sha256": packing.hashlib.sha256(archive.read_bytes()).hexdigest(), **said}
    archive.with_suffix(".json").write_text(json.dumps(note))


def test_an_archive_that_unpacks_to_more_than_its_note_says_is_refused(archive: Path, tmp_path: Path) -> None:
    zeros = bytes(50_000_000)
    repack(archive, lambda zip: zip.writestr("images/bomb.webp", zeros, zipfile.ZIP_DEFLATED))
    with pytest.raises(ValueError, match="holds 'images/bomb.webp' compressed"):
        unpack_dataset(archive, tmp_path / "back")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cloth.croissant.json", "cloth.json", "cloth.zip"]


@pytest.mark.parametrize(
    ("name", "message"), [("images/more.webp", "files, and by its note these should be"), (None, "unpacks to")]
)
def test_an_archive_holds_what_its_note_says(archive: Path, tmp_path: Path, name: str | None, message: str) -> None:
    if name:
        repack(archive, lambda zip: zip.writestr(name, b"x"), bytes=10**9)
    else:
        repack(archive, lambda zip: None, bytes=10)
    with pytest.raises(ValueError, match=message):
        unpack_dataset(archive, tmp_path / "back")


def test_files_of_others_are_not_replaced(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing, "SAMPLE", {"train": 2, "test": 1})
    (tmp_path / "sample").mkdir()
    for name in ("thesis.zip", "sample/photo.webp"):
        (tmp_path / name).write_text("mine")
    folder = tiny_dataset()
    with pytest.raises(ForeignFileError, match="thesis.zip has no note beside it"):
        pack_dataset(folder, tmp_path / "thesis.zip", progress=False)
    with pytest.raises(ForeignFileError, match="sample is not empty and no data set"):
        write_sample(folder, tmp_path / "sample")
    assert [(tmp_path / name).read_text() for name in ("thesis.zip", "sample/photo.webp")] == ["mine", "mine"]
    (tmp_path / "sample" / "photo.webp").unlink()
    for _ in range(2):  # into an empty folder, then over itself
        assert write_sample(folder, tmp_path / "sample") == tmp_path / "sample"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_what_is_in_use_is_not_packed_or_sampled(cloth_dataset: Path, tmp_path: Path) -> None:
    with locked(tmp_path / "a.zip", "packing"), pytest.raises(LockedError, match="a.zip is in use by process"):
        pack_dataset(cloth_dataset, tmp_path / "a.zip", progress=False)


def test_bad_arguments(archive: Path, cloth_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="quality must be between 1 and 100, got 0"):
        pack_dataset(cloth_dataset, tmp_path / "x.zip", quality=0)
    with pytest.raises(FileExistsError, match="exists: remove it first"):
        unpack_dataset(archive, tmp_path)
    with pytest.raises(FileNotFoundError, match="an archive and its note belong together"):
        unpack_dataset(tmp_path / "none.zip", tmp_path / "back")


def test_a_sample_shows_different_simulations(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packing, "SAMPLE", {"train": 3, "test": 1})
    folder = tiny_dataset(n_train=8, n_test=2)
    sample = write_sample(folder, tmp_path / "sample")
    assert load_dataset(sample, "train").labels.episode.is_unique
    assert check_dataset(sample).images.to_list() == [3, 1]
    with pytest.raises(ValueError, match="must show at least 3 simulations in train, got 2"):
        write_sample(tiny_dataset(object="rope", n_train=4, n_test=2), tmp_path / "other")


@pytest.mark.parametrize("name", OBJECTS)
def test_the_committed_sample_is_whole_and_small(name: str) -> None:
    assert check_dataset(SAMPLE / name).images.to_list() == [16, 8]
    assert sum(path.stat().st_size for path in (SAMPLE / name).rglob("*")) < 1_500_000


def test_rounding_puts_no_visible_point_outside(cloth_dataset: Path) -> None:
    data = load_dataset(cloth_dataset)
    labels = data.labels.iloc[:1].copy()
    xy, (width, height) = data.xy[:1].copy(), data.size
    xy[0, :3] = [(-0.499, 5), (width - 0.501, height - 0.501), (-0.6, 3)]
    labels["xy"], visible = [xy.reshape(-1)], data.visible[0].copy()
    visible[2] = False
    labels["visible"] = [visible]
    kept = np.stack(pd.read_parquet(io.BytesIO(packing._encode_labels(labels, data.size))).xy[0]).reshape(-1, 2)
    assert (np.rint(kept[:2]) >= 0).all()
    assert (np.rint(kept[:2]) < data.size).all()
    assert np.abs(kept - xy[0]).max() <= LABEL_STEP
    assert kept[2, 0] == pytest.approx(-0.625)  # what is outside stays there
