"""The whole experiment through papermill, as a user runs it: from another folder, and with a wrong preset."""

import subprocess
import sys
from pathlib import Path

RUN_ALL = Path(__file__).resolve().parents[1] / "notebooks" / "run_all.ipynb"


def run_papermill(folder: Path, *parameters: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "papermill", "--kernel", "python3", str(RUN_ALL), "out.ipynb", *parameters]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=1200)


def test_a_wrong_preset_stops_at_once_with_the_accepted_ones(tmp_path: Path) -> None:
    done = run_papermill(tmp_path, "-p", "preset", "papr")
    assert done.returncode != 0
    assert "'smoke', 'quick', 'paper'" in done.stderr + done.stdout


def test_the_smoke_experiment_runs_from_any_folder_and_draws_every_figure(tmp_path: Path) -> None:
    done = run_papermill(tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    drawn = {path.name for path in (RUN_ALL.parents[1] / "figures" / "smoke").iterdir()}
    names = ("teaser", "combined", "rmse_pdf", "spatial_rmse", "sigma_ablation", "risk_coverage", "calibration")
    assert {f"{name}.{kind}" for name in names for kind in ("pdf", "png")} <= drawn
