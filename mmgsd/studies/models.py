"""The experiment's models, a row each: what it is called and starts from, what differs, which studies it is part of.

The order of the rows is that of every table. A result is found by the digest of the configuration that a row comes to,
so another value in a row asks for another training.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mmgsd.checks import check_choice
from mmgsd.config import OBJECTS, ROUNDS, Preset, TrainConfig

CHANCE_STYLES = {"centre": "--", "random": ":"}
ABOVE = {"unimodal": (0, (4, 2)), "pcl": (0, (4, 2))}  # dashed, on the lines that they lie on: MMGSD's, SPCL's
PAPER = {"cloth": 32.4, "rope": 31.3}  # px, MMGSD's RMSE as the paper reports it
PRESET = "preset"  # what a row starts from that starts from no other: the preset's training
GREY = "0.5"  # of what has no colour of its own


@dataclass(frozen=True)
class Rule:
    """A field's value that depends on the model it starts from."""

    text: str  # as a reader is told
    apply: Callable[[TrainConfig, str], Any]  # of the configuration that the row starts from, and the field's name


def times(factor: float) -> Rule:
    """The start's value times ``factor``: a float, or a whole number from 1 on."""

    def apply(start: TrainConfig, name: str) -> float:
        """The field's value, from that of ``start``."""
        value = factor * getattr(start, name)
        return value if isinstance(getattr(start, name), float) else max(1, int(value))

    return Rule(f"× {factor:g}", apply)


def by_object(**values: float) -> Rule:
    """Another value for each object."""
    text = ", ".join(f"{value} ({name})" for name, value in values.items())
    return Rule(text, lambda start, _: values[start.object])


ITS_OWN = Rule("the weights of what it starts from", lambda start, _: start.name)
LAST_ROUND = Rule("the weights of the round before", lambda start, _: f"{start.object}-round{start.seed}")


@dataclass(frozen=True)
class Model:
    """One row: a model of each object, or a method that nothing is trained for."""

    name: str  # under which results have it
    label: str  # in tables, as Markdown
    start: str  # name of the row that it starts from, or `PRESET`; "": there is nothing to train
    changes: Mapping[str, Any] = field(default_factory=dict)  # fields of TrainConfig that differ; values or rules
    studies: tuple[str, ...] = ("main", "budget")
    short: str = ""  # label in figures, where the table's is too long
    colour: str = GREY  # in figures
    objects: tuple[str, ...] = OBJECTS
    scene: Mapping[str, Any] = field(default_factory=dict)  # fields of RenderConfig that differ from the preset's

    @property
    def difference(self) -> str:
        """What it differs in from what it starts from, in words."""
        changes = {name: value.text if isinstance(value, Rule) else value for name, value in self.changes.items()}
        return ", ".join(f"{name} {value}" for name, value in {**changes, **self.scene}.items())


# In "budget" are the models of "main" with equally many steps, which are then the smaller budget's. With the
# contrastive papers' margin of 0.5, this network's descriptors collapse before they learn; sharper heatmaps have the
# least error, held out, with less roundness.
COMPARED = ("main", "budget", "seeds")  # studies of what is compared by seeds, at both budgets
MODELS = (
    Model("mmgsd", "**MMGSD** (ours)", PRESET, {}, ("first", "robustness", *COMPARED), "MMGSD", "#D55E00"),
    Model("mmgsd_deep", "MMGSD, deeper network", "mmgsd", {"network": "lite0x2"},
          short="MMGSD, deeper", colour="#B22222"),
    Model("mmgsd_long", "MMGSD, 3 × the steps", "mmgsd", {"steps": times(3)}, ("main",), "MMGSD, longer", "#8A3500"),
    Model("mmgsd_muon", "MMGSD, Muon, detail branch", "mmgsd_long",
          {"network": "lite0x2fine", "optimiser": "muon", "input_px": times(2), "roundness": 0.05}, ("main",),
          "MMGSD, Muon", "#FF3D00"),
    Model("mmgsd_plain", "MMGSD, own loss alone", "mmgsd", {"prototype_weight": 0.0}, COMPARED,
          "MMGSD, plain", "#F0A070"),
    Model("spcl_deep", "SPCL, dense, deeper network", "spcl_dense", {"network": "lite0x2"},
          short="SPCL, deeper", colour="#4477CC"),
    Model("spcl_dense", "SPCL, dense supervision", "spcl", {"prototype_weight": 1.0}, COMPARED,
          "SPCL, dense", "#88CCEE"),
    Model("spcl", "SPCL", PRESET, {"method": "spcl", "margin": 4.0}, ("first", *COMPARED), colour="#0072B2"),
    Model("spcl_hidden", "SPCL, hidden matches too", "spcl", {"hidden_matches": True}, ("main", "seeds"),
          "SPCL, hidden", "#3399DD"),
    # as Dense Object Nets are trained (Florence et al. 2018): 3,500 steps of a pair of images as they are
    Model("spcl_reference", "SPCL, reference setting", PRESET,
          {"method": "spcl", "network": "resnet34", "input_px": times(2), "steps": times(7 / 8), "descriptor_dim": 3,
           "roles": 1, "batch": 2, "pairs": 1, "queries": 625, "margin": 0.5, "learning_rate": 1e-4, "schedule": "step",
           "weight_decay": 1e-4, "bend": 0.0, "augment": False}, ("main",), "SPCL, reference", "#001F4D"),
    Model("unimodal", "Unimodal", PRESET, {"method": "unimodal"}, COMPARED, colour="#009E73"),
    Model("pcl", "PCL", PRESET, {"method": "pcl", "margin": 4.0}, COMPARED, colour="#56B4E9"),
    # what the symmetry group decides
    Model("v4", "`v4`, the flips", "mmgsd", {"group": "v4"}, ("symmetry",), "", "#9A78C7", ("cloth",)),
    Model("c4", "`c4`, the rotations", "mmgsd", {"group": "c4"}, ("symmetry",), "", "#6F42A6", ("cloth",)),
    Model("d4", "`d4`, all eight", "mmgsd", {"group": "d4"}, ("symmetry",), "", "#3E1C6B", ("cloth",)),
    # prior work's ways to break the symmetry, each after the images without it
    Model("any rotation", "cloth, any rotation", "pcl", {"group": "identity"}, ("fixes",), objects=("cloth",)),
    Model("±45° only", "cloth, ±45° only", "any rotation", {"rotate": False}, ("fixes",), objects=("cloth",),
          scene={"rotation_deg": 45.0}),
    Model("plain", "rope, plain", "pcl", {"group": "identity"}, ("fixes",), objects=("rope",)),
    Model("ball at one end", "rope, ball at one end", "plain", {}, ("fixes",), objects=("rope",), scene={"ball": True}),
    # which trunk the shipped models have: everything else of their training alike
    Model("light", "EfficientNet-Lite0, trained", "mmgsd",
          {"network": "lite0x2fine", "optimiser": "muon", "input_px": times(2), "roundness": 0.05, "heads": True,
           "clutter": True, "also": "workspace"}, ("backbones",), "EfficientNet-Lite0"),
    Model("dinov2s", "DINOv2 ViT-S/14, frozen", "light", {"network": "dinov2s"}, ("backbones",), "DINOv2 ViT-S"),
    # the shipped models' training: stretches of new images each, the first from the backbone's weights
    Model("round1", "MMGSD, round 1", "light", {"seed": 1, "steps": by_object(cloth=4000, rope=3000)}, ("rounds",)),
    *(Model(f"round{n}", f"MMGSD, round {n}", f"round{n - 1}",
            {"seed": n, "trunk_weights": LAST_ROUND, "learning_rate": 1e-3, "sigma_start_px": 8.0,
             "strong": by_object(cloth=n > 2, rope=True)}, ("rounds",),
            "MMGSD, shipped" * (n == ROUNDS["cloth"]), "#A6761D",
            tuple(object for object in OBJECTS if n <= ROUNDS[object]))
      for n in range(2, max(ROUNDS.values()) + 1)),
    # images grow to about their own size, cells shrink from 15 px; half a batch, for the memory that this takes
    Model("mmgsd_larger", "then cells of 8 px", "mmgsd",
          {"trunk_weights": ITS_OWN, "input_px": times(2), "steps": times(0.25), "batch": times(0.5),
           "pairs": times(0.5), "learning_rate": times(0.5), "sigma_px": 8.0, "sigma_start_px": 8.0,
           "prototype_weight": 0.0}, ("cells",)),
    Model("mmgsd_largest", "then cells of 4 px", "mmgsd_larger",
          {"trunk_weights": ITS_OWN, "input_px": by_object(cloth=480, rope=640)}, ("cells",)),
    # what each part of the shipped models' training brings, one after another
    Model("mmgsd_workspace", "MMGSD, workspace renders too", "mmgsd", {"also": "workspace"}, ("robustness",),
          "+ workspace"),
    Model("mmgsd_clutter", "the same, with clutter pasted in", "mmgsd_workspace", {"clutter": True}, ("robustness",),
          "+ clutter"),
    Model("mmgsd_heads", "the same, with heads", "mmgsd_clutter", {"heads": True}, ("robustness",), "+ heads"),
)  # fmt: skip
UNTRAINED = (
    Model("sift", "SIFT", "", studies=("hand_made",), colour="#CC79A7"),
    Model("orb", "ORB", "", studies=("hand_made",), colour="#999933"),
    Model("imagenet", "ImageNet features", "", studies=("hand_made",), colour="#117733"),
    Model("dinov2", "DINOv2 features", "", studies=("optional",), colour="#44AA99"),
    Model("random", "random points", "", studies=("chance",), short="Random points", colour="#9A9A9A"),
    Model("centre", "object's centre", "", studies=("chance",), short="Object centre", colour="#404040"),
)
ROWS = {row.name: row for row in (*MODELS, *UNTRAINED)}
# row: what the names of its files in data/weights end with
SHIPPED = {f"round{ROUNDS['cloth']}": "", "mmgsd": "-paper", "spcl": "-spcl"}
SMALL = ("symmetry", "budget", "sigma", "fixes", "robustness", "backbones")  # studies of the equal, smaller budget
RUN = ("first", "symmetry", "budget", "sigma", "main")  # studies that are run unless one is named, in this order
# on a preset's own images and one seed: not "fixes" and "seeds"
STUDIES = (*RUN, "backbones")


def list_rows(study: str) -> list[Model]:
    """The rows of a study, or of the untrained "hand_made" and "chance", in the table's order."""
    return [row for row in ROWS.values() if study in row.studies]


def vary_sigma(sigmas_px: Sequence[float]) -> list[Model]:
    """A row for MMGSD with each σ (px), called by it: "4"."""
    values = sorted({float(sigma) for sigma in sigmas_px})
    return [Model(f"{s:g}", f"σ = {s:g} px", "mmgsd", {"sigma_px": s}, ("sigma",)) for s in values]


def vary_seed(seeds: Sequence[int]) -> list[Model]:
    """A row for each model compared by seeds, with each seed: "mmgsd-0", "mmgsd-1", …"""
    return [Model(f"{row.name}-{seed}", row.label, row.name, {"seed": seed}, ("seeds",))
            for row in list_rows("seeds") for seed in sorted(set(seeds))]  # fmt: skip


def configure_model(preset: Preset, object: str, name: str) -> TrainConfig:
    """The training of one model of a preset's main table; ValueError for a name that it does not have."""
    check_choice("method", name, tuple(row.name for row in list_rows("main")))
    return _configure(preset.train[object], ROWS[name])


def configure_study(
    preset: Preset, object: str, study: str, rows: Sequence[Model] | None = None, *, steps: int = 0
) -> dict[str, TrainConfig]:
    """{row's name: training} of a study's models of an object, those of ``rows`` where they are given.

    σ are the preset's where no rows are given; 0 ``steps`` are the study's own. A row whose
    training is that of the row it starts from, which is one of them, is left out: the preset has what it would add.
    """
    if rows is None:
        rows = vary_sigma(preset.sigmas_px) if study == "sigma" else list_rows(study)
    base = (preset.ablation if study in SMALL else preset.train)[object]
    models = {row.name: _configure(base, row) for row in rows if object in row.objects}
    models = {name: dataclasses.replace(model, also=preset.cluttered) if model.also else model
              for name, model in models.items()}  # fmt: skip
    names = [row.name for row in rows
             if row.name in models and (row.scene or models[row.name] != models.get(row.start))]  # fmt: skip
    return {name: dataclasses.replace(models[name], steps=steps or models[name].steps) for name in names}


def _configure(base: TrainConfig, row: Model) -> TrainConfig:
    """The training that a row comes to, step by step from the preset's."""
    start = base if row.start == PRESET else _configure(base, ROWS[row.start])
    changes = {n: value.apply(start, n) if isinstance(value, Rule) else value for n, value in row.changes.items()}
    return dataclasses.replace(start, **changes)


def list_runs(preset: Preset, studies: Sequence[str] = RUN) -> list[TrainConfig]:
    """The models of some studies, the most important first, each once; of the main table, the longer ones last.

    Those of the main table that need images of another preset besides are run in their own study alone.
    """
    all_runs = []
    for study in studies:
        models = {name: configure_study(preset, name, study) for name in OBJECTS}
        names = dict.fromkeys(name for keyed in models.values() for name in keyed)
        late = [n for n in names if study == "main" and "budget" not in ROWS[n].studies]
        ordered = [*(n for n in names if n not in late), *late]
        runs = [models[o][n] for n in ordered for o in OBJECTS if n in models[o]]
        all_runs += [model for model in runs if study != "main" or not model.also]
    return list(dict.fromkeys(all_runs))


def get_label(name: str, *, short: bool = False) -> str:
    """What tables, or figures (``short``), call a row; a name that is no row's stays as it is."""
    row = ROWS.get(name)
    return name if row is None else (row.short or row.label if short else row.label)


def get_colour(name: str) -> str:
    """The colour of a row in every figure."""
    return ROWS[name].colour if name in ROWS else GREY


def get_line_style(method: str) -> dict:
    """Label, colour and stroke of a method's line; chance is broken, MMGSD on top."""
    style = {"label": get_label(method, short=True), "color": get_colour(method)}
    order = 5 if method in ABOVE else 4 if method == "mmgsd" else 2
    return style | {"linestyle": (CHANCE_STYLES | ABOVE).get(method, "-"), "zorder": order}
