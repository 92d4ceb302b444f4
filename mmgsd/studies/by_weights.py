"""What studies of finished weights share: one model is asked about a preset's images and the cluttered ones beside."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mmgsd.config import load_preset
from mmgsd.dataset import Dataset, load_dataset
from mmgsd.match.matcher import Matcher, load
from mmgsd.measure.evaluation import read_results, write_results
from mmgsd.paths import Paths
from mmgsd.studies.registry import Results


def measure_weights(
    paths: Paths, results: str, weights: str, split: str, measure: Callable[[Matcher, Dataset], Results]
) -> Path:
    """Add what ``measure`` gives with weights to {weights: {preset: measured}}, a file beside the presets' folders."""
    matcher, file = load(weights), paths.results.parent / results
    for preset in (paths.preset, load_preset(paths.preset).cluttered):
        measured = measure(matcher, load_dataset(Paths(paths.root, preset).dataset(matcher.object), split))
        rows = read_results(file, depth=3)
        rows.setdefault(weights, {})[preset] = measured
        write_results(rows, file)
    return file


def list_parts(results: Results) -> dict[str, Any]:
    """{"cloth, round2": its values} of such a file."""
    return {f"{weights}, {images}": values for weights, every in results.items() for images, values in every.items()}


def list_rows(results: Results, labels: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """{label: {part: what it has}} of the keys that some part has."""
    parts = list_parts(results)
    rows = {label: {part: each[key] for part, each in parts.items() if key in each} for key, label in labels.items()}
    return {label: row for label, row in rows.items() if row}
