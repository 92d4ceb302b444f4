"""Notebooks through papermill, as a user runs them: from another folder, with wrong parameters, all of them watched."""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def run_papermill(folder: Path, *parameters: str) -> subprocess.CompletedProcess:
    source = ROOT / "notebooks" / "run_all.ipynb"
    command = [sys.executable, "-m", "papermill", "--kernel", "python3", str(source), "out.ipynb", *parameters]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=1200)


def test_a_wrong_parameter_stops_at_once(tmp_path: Path) -> None:
    done = run_papermill(tmp_path, "-p", "presett", "quick")
    assert done.returncode != 0
    assert "presett is no parameter of this notebook" in done.stderr + done.stdout


def test_the_smoke_experiment_runs_from_any_folder_draws_every_figure_and_ends_with_a_verdict(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mmgsd", "reproduce", "smoke"]  # runs papermill itself
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    stages = [path.stem for path in sorted((ROOT / "notebooks").glob("0[1-7]*.ipynb"))]
    finished = re.findall(r"^\[\d/7\] (\w+): [\d.]+ min$", done.stdout, re.MULTILINE)
    assert finished == stages
    assert "Nothing is learnt in smoke" in done.stdout and " numbers agree with the stored ones" in done.stdout
    assert list(json.loads((ROOT / "data" / "results" / "smoke" / "stages.json").read_text())) == stages
    drawn = {path.name for path in (ROOT / "figures" / "smoke").iterdir()}
    names = ("teaser", "combined", "rmse_pdf", "spatial_rmse", "sigma_ablation", "sigma_pdf", "risk_coverage",
             "calibration")  # fmt: skip
    assert {f"{name}.{kind}" for name in names for kind in ("pdf", "png")} <= drawn
