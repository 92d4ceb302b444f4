"""What packing does to the errors: ``python tests/bench/bench_packing.py [preset] [models]``.

The test images of ``preset`` (default paper) are asked as rendered and as `make data-pack` left them, by the MMGSD
models of the preset ``models`` (default quick): the same 100 pairs, 125 points each.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from mmgsd.command import run_command
from mmgsd.config import OBJECTS, EvaluateConfig, load_preset
from mmgsd.extras.packing import unpack_dataset
from mmgsd.measure.evaluation import evaluate_model, load_queries
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import configure_model
from mmgsd.studies.parameters import check_images, check_made

QUESTIONS = EvaluateConfig(pairs=100, points=125)


def main() -> None:
    """Print both errors of each object, and how far single queries differ."""
    preset, models = (sys.argv[1:] + ["paper", "quick"][len(sys.argv) - 1 :])[:2]
    paths, trained = Paths(find_root(), preset), Paths(find_root(), models)
    check_images(paths, OBJECTS)
    for name in OBJECTS:
        archive = paths.root / "data" / "packs" / f"{preset}-{name}.zip"
        weights = trained.model(configure_model(load_preset(models), name, "mmgsd")) / WEIGHTS
        check_made(paths, "make data-pack", [archive])
        check_made(trained, "03_train with run=True", [weights])
        errors = []
        with tempfile.TemporaryDirectory() as folder:
            for data in (paths.dataset(name), unpack_dataset(archive, Path(folder) / name)):
                table = load_queries(
                    evaluate_model(weights, data, QUESTIONS, Path(folder) / "queries.parquet", progress=False)
                )
                errors.append(table.rmse_px[table.visible].to_numpy())
        rendered, packed = (float(e.mean()) for e in errors)
        apart = np.median(np.abs(errors[0] - errors[1]))
        print(f"{name}: {archive.stat().st_size / 1e6:.1f} MB; RMSE {rendered:.2f} px as rendered, "
              f"{packed:.2f} px packed; one query differs by {apart:.2f} px (median)", flush=True)  # fmt: skip


if __name__ == "__main__":
    run_command(main)
