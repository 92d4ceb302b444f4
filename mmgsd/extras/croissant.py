"""What a packed data set is, for machines: metadata in Croissant 1.0 (MLCommons), which data catalogues read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mmgsd.files import write_json

LICENCE = "https://spdx.org/licenses/MIT.html"
PUBLISHED = "2026-11-21"  # of the first archives; what follows has another version
CARD = "docs/data-card.md"  # in the repository: the archives have no address of their own
CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/", "dct": "http://purl.org/dc/terms/",
    "citeAs": "cr:citeAs", "column": "cr:column", "conformsTo": "dct:conformsTo", "containedIn": "cr:containedIn",
    "data": {"@id": "cr:data", "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "extract": "cr:extract", "field": "cr:field", "fileObject": "cr:fileObject", "fileSet": "cr:fileSet",
    "fileProperty": "cr:fileProperty", "includes": "cr:includes", "recordSet": "cr:recordSet",
    "repeated": "cr:repeated", "source": "cr:source", "subField": "cr:subField", "transform": "cr:transform",
}  # fmt: skip
FIELDS = (  # column of labels.parquet, type, whether it holds a list, what it is
    ("file", "sc:Text", False, "The image's file, WebP."),
    ("mask", "sc:Text", False, "The mask's file, PNG: white where the object is seen."),
    ("split", "sc:Text", False, "train or test; no simulation is in both."),
    ("episode", "sc:Integer", False, "The simulation."),
    ("view", "sc:Integer", False, "Which of the simulation's views."),
    ("state", "sc:Text", False, "How the object lies: flat, folded, ..."),
    ("xy", "sc:Float", True, "x and y of each material point in turn, px, the top left pixel's centre is 0, 0."),
    ("visible", "sc:Boolean", True, "Whether each material point is seen."),
    ("intrinsics", "sc:Float", True, "The camera's 3 x 3 matrix, row by row, px."),
    ("camera_pose", "sc:Float", True, "The camera's 4 x 4 pose in the world, row by row."),
)


def write_croissant(archive: Path, info: Mapping[str, Any], note: Mapping[str, Any]) -> Path:
    """Write ``NAME.croissant.json`` beside an archive, from its data set's ``dataset.json`` and its note."""
    return write_json(archive.with_suffix(".croissant.json"), describe_dataset(archive.name, info, note))


def describe_dataset(archive: str, info: Mapping[str, Any], note: Mapping[str, Any]) -> dict[str, Any]:
    """Croissant 1.0 metadata (JSON-LD) of an archive of that name."""
    width, height = info["size"]
    counts = " and ".join(f"{count} {split}" for split, count in note["images"].items())
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"mmgsd-{Path(archive).stem}",
        "description": f"{counts} images of {width} x {height} px of a {info['object']}, simulated and rendered in "
                       f"Blender (seed {note['seed']}), each with the places of its material points in px, whether "
                       "they are seen, and a mask; the object's symmetries are permutations of these points. "
                       f"{CARD} says how they were made and what they lack.",
        "license": LICENCE,
        "url": CARD,
        "creator": {"@type": "sc:Organization", "name": "mmgsd contributors"},
        "datePublished": PUBLISHED,
        "version": "1.0.0",
        "distribution": _list_files(archive, note),
        "recordSet": [_describe_records()],
    }  # fmt: skip


def _list_files(archive: str, note: Mapping[str, Any]) -> list[dict[str, Any]]:
    inside = {"containedIn": {"@id": "archive"}}
    return [
        {"@type": "cr:FileObject", "@id": "archive", "name": archive, "contentUrl": archive,
         "contentSize": f"{note['bytes']} B", "encodingFormat": "application/zip", "sha256": note["sha256"]},
        {"@type": "cr:FileObject", "@id": "labels", "name": "labels.parquet", "contentUrl": "labels.parquet",
         "encodingFormat": "application/x-parquet", **inside},
        {"@type": "cr:FileSet", "@id": "images", "name": "images", "includes": "images/*.webp",
         "encodingFormat": "image/webp", **inside},
        {"@type": "cr:FileSet", "@id": "masks", "name": "masks", "includes": "masks/*.png",
         "encodingFormat": "image/png", **inside},
    ]  # fmt: skip


def _describe_records() -> dict[str, Any]:
    fields = [
        {
            "@type": "cr:Field", "@id": f"views/{column}", "name": column, "description": said, "dataType": kind,
            **({"repeated": True} if many else {}),
            "source": {"fileObject": {"@id": "labels"}, "extract": {"column": column}},
        }
        for column, kind, many, said in FIELDS
    ]  # fmt: skip
    return {"@type": "cr:RecordSet", "@id": "views", "name": "views", "description": "A row an image.", "field": fields}
