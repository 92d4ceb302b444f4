"""An object of one's own, defined in data/objects: its scenes and its training, and how well it is matched.

`notebooks/your_object.ipynb` leads through it.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pandas as pd

from mmgsd.config import RenderConfig, TrainConfig, load_preset
from mmgsd.figures.stored import show_stored
from mmgsd.figures.style import save_figure
from mmgsd.files import write_json
from mmgsd.learn.training import check_start
from mmgsd.match.match import Match
from mmgsd.measure.evaluation import evaluate_model, read_results, summarise
from mmgsd.paths import Paths

RESULTS = "your_object.json"
SHOWN = ["rmse_mean", "median", "pck@20px", "queries"]


def configure(paths: Paths, name: str, start: str) -> tuple[RenderConfig, TrainConfig]:
    """Scenes drawn as a preset's cloths are, and a training twice as long as theirs from the weights ``start``.

    "" starts from ImageNet's. ValueError for weights of another network.
    """
    preset = load_preset(paths.preset)
    scene, cloth = dataclasses.replace(preset.render["cloth"], object=name), preset.train["cloth"]
    # The roles are the shipped network's; the group comes with the data set.
    changes = {"object": name, "group": "", "roles": 2, "trunk_weights": start, "steps": 2 * cloth.steps}
    model = dataclasses.replace(cloth, **changes)
    check_start(model, paths.generated / "models")
    return scene, model


def save_answer(match: Match, paths: Paths, name: str) -> Any:
    """Draw an answer into the preset's figures and show it; of `smoke`, which learns nothing, what `quick` stored."""
    (picture,) = save_figure(match.plot(), paths.figures / f"your_object_{name}", ["jpg"])
    return show_stored(find_shown(paths, name).figures / picture.name)


def measure(weights: Path, images: Path, paths: Paths, name: str, **how: Any) -> pd.DataFrame:
    """Ask a preset's questions about test images and store the errors; those of the preset that is shown, in a column.

    ``how`` is as `mmgsd.measure.evaluation.evaluate_model` has it.
    """
    queries = paths.queries(weights.parent.name)
    table = evaluate_model(weights, images, load_preset(paths.preset).evaluate, queries, **how)
    file = paths.results / RESULTS
    write_json(file, read_results(file) | {name: summarise({"mmgsd": table})["mmgsd"]})
    source = find_shown(paths, name)
    errors = read_results(source.results / RESULTS)[name]
    return pd.Series(errors, name=f"{name}, {source.preset}")[SHOWN].round(2).to_frame()


def find_shown(paths: Paths, name: str) -> Paths:
    """The preset whose answers are shown: `quick` instead of `smoke`, where it has a picture and errors of it."""
    quick = Paths(paths.root, "quick")
    stored = (quick.figures / f"your_object_{name}.jpg").is_file() and name in read_results(quick.results / RESULTS)
    return quick if paths.preset == "smoke" and stored else paths
