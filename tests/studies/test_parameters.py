"""A wrong parameter stops a notebook in its first cells, by name; a right one may be spelled as papermill spells it."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from papermill.translators import PythonTranslator
from PIL import Image

from mmgsd.config import TrainConfig
from mmgsd.learn.training import train_model
from mmgsd.paths import Paths
from mmgsd.studies import parameters
from mmgsd.studies.parameters import (
    among,
    check_images,
    check_made,
    listed,
    number,
    one_of,
    optional,
    read_device,
    read_file,
    read_flag,
    read_parameters,
    read_pixels,
    read_scheduler,
    whole,
)

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CHECKED = [path for path in NOTEBOOKS if "read_parameters(globals()" in path.read_text()]
PRESETS = "'smoke', 'quick', 'paper'"


@pytest.fixture
def empty_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository where nothing is rendered or trained yet."""
    root = tmp_path / "root"
    (root / "data").mkdir(parents=True)
    for name in ("objects", "weights", "sample"):
        (root / "data" / name).symlink_to(ROOT / "data" / name)
    monkeypatch.setenv("MMGSD_ROOT", str(root))
    monkeypatch.chdir(tmp_path)
    return root


def run_first_cells(notebook: str, **injected: Any) -> dict[str, Any]:
    """Run a notebook's imports, its parameters, those injected after them as papermill does, and the cell after."""
    cells = [cell for cell in nbformat.read(ROOT / "notebooks" / f"{notebook}.ipynb", 4).cells if cell.source]
    code = [cell for cell in cells if cell.cell_type == "code"][:3]
    assert "parameters" in code[1].metadata.tags
    sources = [cell.source for cell in code]
    if injected:
        sources.insert(2, PythonTranslator.codify(injected))
    namespace: dict[str, Any] = {"In": [""]}
    for source in sources:
        plain = "\n".join(line for line in source.splitlines() if not line.startswith("%"))
        namespace["In"].append(plain)
        exec(compile(plain, notebook, "exec"), namespace)
    return namespace


def run_until_it_lacks_data(notebook: str, **injected: Any) -> dict[str, Any]:
    """What a notebook makes of parameters: it goes on until it says what has to be run first, if anything."""
    read: dict[str, Any] = {}
    keep, original = read.update, parameters.read_parameters

    def read_and_keep(namespace: dict, **readers: parameters.Reader) -> None:
        original(namespace, **readers)
        keep({name: namespace[name] for name in readers})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parameters, "read_parameters", read_and_keep)
        try:
            run_first_cells(notebook, **injected)
        except ValueError as error:
            assert "there is no data/" in str(error) or "there is no figures/" in str(error)
    return read


def list_assigned(source: str) -> list[str]:
    return [statement.targets[0].id for statement in ast.parse(source).body]


OF_NO_PRESET = ("your_images", "12_other_pictures")  # the latter shows what was measured on the images of two
STAGES = [path.stem for path in NOTEBOOKS if path.stem[0].isdigit() and path.stem not in OF_NO_PRESET]
SMOKE = {"preset": "smoke", "run": True}
FLAGS = {
    "01_render_data": ("run", "overwrite", "only_test"), "02_inspect_data": ("run",), "03_train": ("run", "overwrite"),
    "04_evaluate": ("run", "overwrite"), "05_sigma_ablation": ("run", "overwrite"),
    "06_uncertainty": ("run", "overwrite"), "07_figures": ("run",), "08_symmetry_study": ("run", "overwrite"),
    "09_error_analysis": ("run",), "10_fold_by_demonstration": ("run",), "11_broken_symmetry": ("run", "overwrite"),
    "run_all": ("overwrite",), "your_object": ("overwrite",),
}  # fmt: skip
WRONG = [  # notebook, parameter, what it was given, a word of what the error says besides the parameter's name
    *((path.stem, "preset", "papr", PRESETS) for path in CHECKED if path.stem not in OF_NO_PRESET),
    *((notebook, flag, "flase", "true or false") for notebook, flags in FLAGS.items() for flag in flags),
    ("01_render_data", "workers", -1, "from 0 to 1024"), ("01_render_data", "scheduler", "localhost", "host:port"),
    ("02_inspect_data", "images", 0, "from 1 on"), ("02_inspect_data", "points", [0, 1, 2, 3, 4], "from 1 to 4"),
    ("02_inspect_data", "points", [625], "from 0 to 624"), ("03_train", "device", "gpu", "'cpu'"),
    ("04_evaluate", "drawn", ["sfit"], "did you mean 'sift'?"), ("04_evaluate", "points", [0, 104, 208], "length 4"),
    ("04_evaluate", "points", [0, 104, 208, 9999], "from 0 to 624"),
    ("05_sigma_ablation", "sigmas_px", [1.0, -4.0], "greater than 0"), ("05_sigma_ablation", "steps", -1, "from 0 on"),
    ("06_uncertainty", "classical", ["surff"], "'sift'"), ("08_symmetry_study", "groups", [], "from 1 on"),
    ("08_symmetry_study", "groups", ["c5"], "'c4'"), ("10_fold_by_demonstration", "task", "ends", "'edge'"),
    ("10_fold_by_demonstration", "target", 8, "from 0 to 7"), ("11_broken_symmetry", "images", "quik", '"" for none'),
    ("09_error_analysis", "method", "mmgsdd", "'mmgsd'"), ("09_error_analysis", "objects", "cloth towel", "'rope'"),
    ("09_error_analysis", "objects", "", "from 1 on"), ("09_error_analysis", "worst", 0, "from 1 on"),
    ("your_images", "image0", "nowhere.jpg", "nowhere.jpg"), ("your_images", "image1", "data/sample", "no file"),
    ("your_images", "xy", [[485, 0]], "485 x 485 px"), ("your_images", "xy", [1, 2, 3], "(S, 2) px"),
    ("your_images", "weights", "cloht", "'cloth'"), ("your_images", "min_confidence", 1.5, "from 0 to 1"),
    ("your_object", "name", "t-shirt", "'tshirt'"), ("your_object", "start", "clotg", "'cloth'"),
    ("your_object", "start", 1, '"" for none'),
]  # fmt: skip


def name_case(value: Any) -> str | None:
    return value if isinstance(value, str) and len(value) < 30 else repr(value)[:30]


@pytest.mark.parametrize(("notebook", "parameter", "given", "said"), WRONG, ids=name_case)
def test_a_wrong_parameter_is_refused_before_anything_is_touched(empty_root, notebook, parameter, given, said):
    with pytest.raises(ValueError) as refused:
        run_first_cells(notebook, **{parameter: given})
    assert parameter in str(refused.value) and said in str(refused.value)
    assert {path.name for path in (empty_root / "data").iterdir()} == {"objects", "weights", "sample"}


def test_every_notebook_checks_its_parameters():
    assert {path.stem for path in NOTEBOOKS} - {path.stem for path in CHECKED} == set()


@pytest.mark.parametrize("notebook", [path.stem for path in CHECKED])
def test_a_mistyped_name_stops_every_notebook(empty_root, notebook):
    with pytest.raises(ValueError, match="presett is no"):
        run_first_cells(notebook, presett="quick")


@pytest.mark.parametrize("notebook", [path.stem for path in CHECKED])
def test_a_notebook_reads_all_of_its_parameters(empty_root, notebook):
    cells = nbformat.read(ROOT / "notebooks" / f"{notebook}.ipynb", 4).cells
    (tagged,) = (cell.source for cell in cells if "parameters" in cell.metadata.get("tags", ()))
    assert sorted(run_until_it_lacks_data(notebook)) == sorted(list_assigned(tagged))


PAPER = "data/results/paper/"
MISSING = [  # notebook, what it is told, the file that it lacks and what makes it
    ("02_inspect_data", SMOKE, "data/generated/smoke/cloth/dataset.json", "01_render_data"),
    ("02_inspect_data", {}, "figures/data/paper_variety.png", "02_inspect_data"),
    ("03_train", SMOKE, "data/generated/smoke/cloth/dataset.json", "01_render_data"),
    ("03_train", {}, PAPER + "runs.json", "04_evaluate"),
    ("04_evaluate", {}, PAPER + "rmse.json", "04_evaluate"),
    ("05_sigma_ablation", {"steps": 4000}, PAPER + "sigma_4000.json", "05_sigma_ablation"),
    ("06_uncertainty", {}, PAPER + "uncertainty.json", "06_uncertainty"),
    ("07_figures", {"preset": "quick"}, "data/results/quick/figures_cloth.safetensors", "04_evaluate"),
    ("08_symmetry_study", {}, PAPER + "symmetry.json", "08_symmetry_study"),
    ("09_error_analysis", {**SMOKE, "objects": "rope"}, "data/generated/smoke/rope/dataset.json", "01_render_data"),
    ("09_error_analysis", {"method": "spcl"}, PAPER + "errors_spcl.json", "09_error_analysis"),
    ("10_fold_by_demonstration", {}, PAPER + "folding.json", "10_fold_by_demonstration"),
    ("11_broken_symmetry", {}, PAPER + "broken_symmetry.json", "11_broken_symmetry"),
]


@pytest.mark.parametrize(("notebook", "told", "file", "by"), MISSING, ids=[case[0] for case in MISSING])
def test_what_has_to_be_run_first_is_said(empty_root, notebook, told, file, by):
    with pytest.raises(ValueError) as refused:
        run_first_cells(notebook, **told)
    assert f"no {file} yet: run {by}" in str(refused.value)


@pytest.mark.parametrize("notebook", STAGES)
def test_what_is_committed_shows_the_papers_size_and_runs_nothing(notebook):
    cells = nbformat.read(ROOT / "notebooks" / f"{notebook}.ipynb", 4).cells
    (tagged,) = (cell.source for cell in cells if "parameters" in cell.metadata.get("tags", ()))
    assert tagged.startswith('preset = "paper"  # ') and "\nrun = False  # True " in tagged


def test_a_point_that_a_small_preset_does_not_ask_about_is_refused(empty_root):
    said = r"points must be one of the points that the preset asks about \(0, 26, 52, … 624\), got 313"
    with pytest.raises(ValueError, match=said):
        run_first_cells("04_evaluate", preset="smoke", points=[0, 104, 208, 313])


def render_nothing(root: Path, *splits: str) -> None:
    """All that the checks look at of a rendered data set."""
    for name in ("cloth", "rope"):
        (root / "data" / "generated" / "smoke" / name).mkdir(parents=True)
        file = root / "data" / "generated" / "smoke" / name / "dataset.json"
        file.write_text(json.dumps({"images": dict.fromkeys(splits, 8)}))


@pytest.mark.parametrize("notebook", ["03_train", "05_sigma_ablation", "08_symmetry_study"])
def test_training_asks_for_the_images_that_were_left_out(empty_root, notebook):
    render_nothing(empty_root, "test")
    with pytest.raises(ValueError, match="no train images in .* for it with run=True, only_test=False first"):
        run_first_cells(notebook, **SMOKE)
    with pytest.raises(ValueError, match="run 01_render_data for it with run=True, only_test=False first"):
        run_first_cells("02_inspect_data", **SMOKE)


@pytest.mark.parametrize(("notebook", "told", "by"), [
    ("04_evaluate", {}, "run 03_train"), ("06_uncertainty", {}, "run 03_train"),
    ("09_error_analysis", {"method": "pcl"}, "method='pcl' there is no .*run models"),
])  # fmt: skip
def test_a_method_that_is_not_trained_is_named(empty_root, notebook, told, by):
    render_nothing(empty_root, "train", "test")
    with pytest.raises(ValueError, match=by):
        run_first_cells(notebook, **SMOKE, **told)


def test_a_start_of_another_network_is_refused_before_rendering(empty_root, cloth_dataset):
    config = TrainConfig(steps=1, batch=2, pairs=2, queries=4, input_px=64)
    train_model(config, cloth_dataset, empty_root / "mine", device="cpu", progress=False)
    with pytest.raises(ValueError, match="trunk_weights .* has roles 1, the training 2"):
        run_first_cells("your_object", start="mine/weights.safetensors")


def test_cells_of_a_persons_own_are_no_parameters():
    cells = ["", "preset = 'smoke'", "mine = 3", "read_parameters(globals(), preset=…)"]
    read_parameters({"In": cells, "preset": "smoke"}, preset=parameters.read_preset)
    cells[2] = "presett = 'quick'\npreset = 'smoke'"
    with pytest.raises(ValueError, match="presett is no"):
        read_parameters({"In": cells, "preset": "smoke"}, preset=parameters.read_preset)


def test_a_parameter_that_is_not_set_is_named_and_none_is_changed():
    namespace = {"a": "1"}
    with pytest.raises(ValueError, match="b must"):
        read_parameters(namespace, a=whole(), b=whole())
    with pytest.raises(ValueError, match="b must"):
        read_parameters(namespace := {"a": "1", "b": "x"}, a=whole(), b=whole())
    assert namespace == {"a": "1", "b": "x"}


@pytest.mark.parametrize(
    ("reader", "given", "read"),
    [
        *((read_flag, flag, True) for flag in (True, 1, "1", "true", "yes")),
        *((read_flag, flag, False) for flag in (False, 0, "false", "False", " NO ", "off")),
        (whole(), np.int64(3), 3),
        (whole(), 8.0, 8),
        (number(), np.float32(0.5), 0.5),
        (number(), 3, 3.0),
        (listed(whole()), np.arange(3), [0, 1, 2]),
        (listed(whole()), range(2), [0, 1]),
        (listed(whole()), "[0, 60]", [0, 60]),
        (listed(number()), "1, 4", [1.0, 4.0]),
        (listed(number()), "4", [4.0]),
        (listed(whole()), 60, [60]),
        (listed(one_of(["a"])), "('a',)", ["a"]),
        (listed(one_of(["a", "b"])), "a,b", ["a", "b"]),
        (listed(one_of(["a"])), "a", ["a"]),
        (optional(whole()), None, ""),
        (read_pixels, "[[235, 80], [10.5, 20]]", [[235, 80], [10.5, 20]]),
        (read_pixels, "235,80", [235, 80]),
        (read_device, "cpu", "cpu"),
    ],
)
def test_readers_take_what_python_and_a_shell_call_it(reader, given, read):
    got = reader("it", given)
    assert got == read and type(got) is type(read)


NOTHING = (None, "", True, "two", [], {"a": 1}, 1e400, "1e999", float("nan"), 1j, np.bool_(True))


@pytest.mark.parametrize(
    ("reader", "given"),
    [*((reader, value) for reader in (whole(), number(), one_of(["a"]), read_file) for value in NOTHING),
     *((read_scheduler, value) for value in ("tcp://localhost", "tcp:/localhost:8786", 8786)),
     (whole(), 1.5), (whole(), 10**400), (whole(), -1), (number(), "[1]"), (number(above=0), 0), (number(least=1), 0.5),
     (listed(whole()), "[1, 2"), (listed(whole()), "[[1]]"), (listed(whole()), True), (listed(whole()), None),
     (listed(whole()), "a, b"), (listed(whole(), least=1), []), (one_of(["a"]), ["a"]), (one_of({"a": 1}), 3),
     (among([0, 26], "the points"), 25),
     (read_pixels, []), (read_pixels, ""),
     *((read_flag, value) for value in ("maybe", "", 2, None, [], "truefalse"))],
)  # fmt: skip
def test_what_no_reader_takes_is_a_value_error_that_names_it(reader, given):
    with pytest.raises(ValueError, match="it must be "):
        reader("it", given)


def test_a_path_starts_where_one_is_or_at_the_root(empty_root, tmp_path):
    here, there, both = tmp_path / "here.txt", empty_root / "there.txt", "both.txt"
    for path in (here, there, tmp_path / both, empty_root / both):
        path.write_text("")
    assert read_file("it", "here.txt") == here and read_file("it", Path("there.txt")) == there
    assert read_file("it", "both.txt") == tmp_path / both
    assert read_file("it", str(there)) == there
    with pytest.raises(ValueError, match=f"image0 must be .*'none.txt'.* no file {tmp_path}/none.txt or {empty_root}/"):
        read_file("image0", "none.txt")


def test_your_images_are_found_from_either_place(empty_root, tmp_path):
    Image.new("RGB", (300, 200)).save(tmp_path / "mine.png")
    read = run_first_cells("your_images", image0="mine.png")
    assert read["images"][0].shape == (200, 300, 3) and read["images"][1].shape == (485, 485, 3)


def test_what_is_missing_is_told_by_its_place_in_the_repository(tmp_path):
    paths = Paths(tmp_path, "quick")
    check_made(paths, "x", [tmp_path])
    with pytest.raises(ValueError, match="preset='quick', method='pcl' there is no"):
        check_made(paths, "x", [paths.dataset("cloth")], method="pcl")
    check_images(paths, [])
