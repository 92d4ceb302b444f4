"""The packed data sets' metadata hold what Croissant 1.0 asks for, and what is packed."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mmgsd.config import OBJECTS
from mmgsd.dataset import load_dataset
from mmgsd.extras.croissant import FIELDS
from mmgsd.extras.packing import pack_dataset

PACKS = Path(__file__).resolve().parents[2] / "data" / "packs"
REQUIRED = ("@context", "@type", "conformsTo", "name", "description", "license", "url", "creator", "datePublished",
            "distribution", "recordSet")  # fmt: skip


@pytest.fixture(scope="module")
def packed(cloth_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    archive = tmp_path_factory.mktemp("packs") / "tiny-cloth.zip"
    pack_dataset(cloth_dataset, archive, progress=False)
    return archive


def test_packing_writes_metadata_beside_the_archive(packed: Path) -> None:
    said, note = (json.loads(packed.with_suffix(end).read_text()) for end in (".croissant.json", ".json"))
    assert said["name"] == "mmgsd-tiny-cloth" and "6 train and 4 test images" in said["description"]
    assert said["distribution"][0]["sha256"] == note["sha256"]


def test_every_field_is_a_column_of_the_labels(cloth_dataset: Path) -> None:
    assert {column for column, *_ in FIELDS} == set(load_dataset(cloth_dataset, "train").labels.columns)


def list_references(tree: Any) -> Iterator[str]:
    """Every ``{"@id": …}`` that points to another node."""
    if isinstance(tree, dict):
        if set(tree) == {"@id"}:
            yield tree["@id"]
        for key, value in tree.items():
            if key != "@context":
                yield from list_references(value)
    elif isinstance(tree, list):
        for value in tree:
            yield from list_references(value)


@pytest.mark.parametrize("name", [f"paper-{name}" for name in OBJECTS])
def test_the_committed_metadata_are_complete_and_agree_with_the_notes(name: str) -> None:
    said, note = (json.loads((PACKS / f"{name}{end}").read_text()) for end in (".croissant.json", ".json"))
    assert all(said[key] for key in REQUIRED)
    assert said["conformsTo"] == "http://mlcommons.org/croissant/1.0"
    archive, *inside = said["distribution"]
    assert (archive["sha256"], archive["contentSize"]) == (note["sha256"], f"{note['bytes']} B")
    assert all("encodingFormat" in file for file in said["distribution"])
    assert set(list_references(said)) <= {file["@id"] for file in said["distribution"]}
    assert all({"@id", "name", "dataType", "source"} <= set(field) for field in said["recordSet"][0]["field"])
