"""The committed sample: small, nearly lossless, of as many simulations as it has images."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mmgsd.config import OBJECTS
from mmgsd.dataset import check_dataset, load_dataset
from mmgsd.extras import sampling
from mmgsd.extras.sampling import LABEL_STEP, write_sample
from mmgsd.files import ForeignFileError, LockedError, locked

SAMPLE = Path(__file__).resolve().parents[2] / "data" / "sample"


def test_files_of_others_are_not_replaced(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "SAMPLE", {"train": 2, "test": 1})
    (tmp_path / "sample").mkdir()
    (tmp_path / "sample" / "photo.webp").write_text("mine")
    folder = tiny_dataset()
    with pytest.raises(ForeignFileError, match="sample is no"):
        write_sample(folder, tmp_path / "sample")
    assert (tmp_path / "sample" / "photo.webp").read_text() == "mine"
    (tmp_path / "sample" / "photo.webp").unlink()
    for _ in range(2):  # into an empty folder, then over itself
        assert write_sample(folder, tmp_path / "sample") == tmp_path / "sample"
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_what_is_in_use_is_not_sampled(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "SAMPLE", {"train": 2, "test": 1})
    with locked(tmp_path / "a", "sampling"), pytest.raises(LockedError, match="a is in use by process"):
        write_sample(tiny_dataset(), tmp_path / "a")


def test_the_quality_is_checked(cloth_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="quality .* got 0"):
        write_sample(cloth_dataset, tmp_path / "x", quality=0)


def test_a_sample_is_nearly_lossless(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "SAMPLE", {"train": 2, "test": 1})
    folder = tiny_dataset()
    before, after = (load_dataset(data, "test") for data in (folder, write_sample(folder, tmp_path / "sample")))
    assert np.abs(before.xy[0] - after.xy[0]).max() <= LABEL_STEP / 2 + 1e-5
    assert np.array_equal(before.visible[0], after.visible[0])
    assert np.array_equal(before.load_mask(0), after.load_mask(0))
    assert np.abs(before.load_image(0).astype(int) - after.load_image(0)).mean() < 3.0
    assert before.fingerprint != after.fingerprint  # a model must say which of the two it was trained on


def test_a_sample_shows_different_simulations(
    tiny_dataset: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sampling, "SAMPLE", {"train": 3, "test": 1})
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
    kept = np.stack(pd.read_parquet(io.BytesIO(sampling._encode_labels(labels, data.size))).xy[0]).reshape(-1, 2)
    assert (np.rint(kept[:2]) >= 0).all()
    assert (np.rint(kept[:2]) < data.size).all()
    assert np.abs(kept - xy[0]).max() <= LABEL_STEP
    assert kept[2, 0] == pytest.approx(-0.625)  # what is outside stays there
