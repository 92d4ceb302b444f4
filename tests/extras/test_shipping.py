"""Shipped weights answer as the trained ones do, and their card says where they come from."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from mmgsd.config import TrainConfig
from mmgsd.dataset import load_dataset
from mmgsd.extras.shipping import restore_model, ship_model
from mmgsd.files import ForeignFileError, LockedError, locked
from mmgsd.learn.training import train_model
from mmgsd.match.matcher import Matcher, load
from mmgsd.paths import find_root

CARDS = sorted((find_root(Path(__file__).parent) / "data" / "weights").glob("*.md"))
ERRORS = {"rmse_mean": 12.34, "median": 10.0, "queries": 1234}
FACTS = {"preset": "smoke", "data_seed": 7, "measured": {"smoke": ERRORS}}


def test_half_precision_gives_the_same_answers(tiny_dataset: Callable[..., Path], tmp_path: Path) -> None:
    folder = tiny_dataset()
    config = TrainConfig(steps=2, batch=2, pairs=2, queries=8, input_px=64)
    weights = train_model(config, folder, tmp_path / "model", progress=False)
    shipped = ship_model(weights, tmp_path / "shipped" / "cloth.safetensors", FACTS)
    assert shipped.stat().st_size < 0.6 * weights.stat().st_size
    data = load_dataset(folder, "test")
    ours, theirs = (
        Matcher.load(path).match(data.load_image(0), data.load_image(1), data.xy[0, :3]) for path in (weights, shipped)
    )
    np.testing.assert_allclose(theirs.cells, ours.cells, rtol=0.05, atol=1e-5)
    card = shipped.with_suffix(".md").read_text()
    for said in ("12.3 px mean", "seed 7", "`c4`", "2 steps", 'mmgsd.load("cloth")'):
        assert said in card
    again = shipped.stat().st_mtime_ns
    assert ship_model(weights, shipped, FACTS).stat().st_mtime_ns == again

    back = restore_model(shipped, tmp_path / "restored", config)
    assert back.read_bytes() == shipped.read_bytes()
    assert train_model(config, folder, back.parent, progress=False) == back  # taken for trained, on the same data
    assert restore_model(shipped, weights.parent, config).read_bytes() != shipped.read_bytes()  # trained here: kept
    with pytest.raises(ValueError, match="train that one"):
        restore_model(shipped, tmp_path / "other", dataclasses.replace(config, seed=1))


def test_files_of_others_are_not_replaced(cloth_dataset: Path, tmp_path: Path) -> None:
    config = TrainConfig(steps=1, batch=2, pairs=2, queries=8, input_px=64, descriptor_dim=4)
    weights = train_model(config, cloth_dataset, tmp_path / "model", progress=False)
    out = tmp_path / "cloth.safetensors"
    save_file({"a": np.zeros(3)}, out)
    with pytest.raises(ForeignFileError, match="cloth.safetensors holds no"):
        ship_model(weights, out, FACTS)
    out.unlink()
    out.with_suffix(".md").write_text("# Diary")
    with pytest.raises(ForeignFileError, match="cloth.md is no"):
        ship_model(weights, out, FACTS)
    assert not out.exists()
    out.with_suffix(".md").unlink()
    shipped = ship_model(weights, out, FACTS)
    weights.write_bytes(weights.read_bytes()[:999])
    with pytest.warns(UserWarning, match="weights.safetensors is damaged"):
        assert restore_model(shipped, weights.parent, config).read_bytes() == shipped.read_bytes()
    with locked(tmp_path / "model", "training"), pytest.raises(LockedError, match="model is in use"):
        restore_model(shipped, tmp_path / "model", config)


@pytest.mark.parametrize("card", CARDS, ids=[card.stem for card in CARDS])
def test_what_is_shipped_loads_by_the_name_that_its_card_gives(card: Path) -> None:
    (name,) = re.findall(r'mmgsd\.load\("(.+)"\)', card.read_text())
    assert load(name).config.name == load(card.with_suffix(".safetensors")).config.name
