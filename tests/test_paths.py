"""Paths: every file of a preset has a place of its own, and the repository's root is found."""

from __future__ import annotations

from pathlib import Path

import pytest

from mmgsd import paths as paths_module
from mmgsd.config import METHODS, RenderConfig, TrainConfig
from mmgsd.paths import Paths, find_root


def test_nothing_that_a_preset_keeps_lies_where_an_objects_data_may() -> None:
    paths = Paths(Path("root"), "smoke")
    kept = (paths.model(TrainConfig()), paths.queries("cloth"))
    for folder in {path.relative_to(paths.generated).parts[0] for path in kept}:
        with pytest.raises(ValueError, match="another name"):
            RenderConfig(object=folder)


def test_model_folders_differ_between_configurations() -> None:
    paths = Paths(Path("root"), "smoke")
    configs = [TrainConfig(method=m, sigma_px=s) for m in METHODS for s in (1.0, 4.0)]
    assert len({paths.model(c) for c in configs}) == len(configs)


def test_find_root_from_a_subfolder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MMGSD_ROOT", raising=False)
    (tmp_path / "environment.lock").touch()
    (tmp_path / "notebooks" / "deep").mkdir(parents=True)
    assert find_root(tmp_path / "notebooks" / "deep") == tmp_path


def test_find_root_prefers_the_environment_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MMGSD_ROOT", str(tmp_path))
    assert find_root() == tmp_path


def test_find_root_without_a_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MMGSD_ROOT", raising=False)
    monkeypatch.setattr(paths_module, "__file__", str(tmp_path / "site" / "paths.py"))
    with pytest.raises(FileNotFoundError, match="environment.lock.*MMGSD_ROOT"):
        find_root(tmp_path)
