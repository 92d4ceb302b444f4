"""One frozen dataclass for each stage, and the presets, ``smoke``, ``quick``, ``paper`` and others.

A configuration is everything that decides a result. How it is computed (workers, scheduler address, overwrite) is
an argument of the stage, never part of its configuration.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from typing import Any, TypeVar

from mmgsd.checks import check, check_choice, check_types

OBJECTS = ("cloth", "rope")
SCENES = ("plain", "workspace")  # a patterned floor alone, or a robotics lab's table and what lies about on it
METHODS = ("pcl", "spcl", "unimodal", "mmgsd")
CONTRASTIVE = ("pcl", "spcl")  # the others are distributional
MATCHES_OF_ONE = ("pcl", "unimodal")  # methods that are taught the identity only
IMAGE_SIZE = {"cloth": (485, 485), "rope": (640, 480)}  # (width, height) px, paper section "Quantitative Results"
DEFAULT_GROUP = {"cloth": "c4", "rope": "c2"}
OWN_GROUP = "own"  # of any other object: what its file says
# names of no object: a preset keeps other things in folders of these names, beside its data sets
RESERVED = ("experiments", "models", "notebooks", "pose_range", "queries", "sample",
            *(f"{name}-broken" for name in OBJECTS),
            *(f"{name}-{method}" for name in OBJECTS for method in METHODS))  # fmt: skip
CONTRASTIVE_REVISION = "r2"  # of PCL's and SPCL's training, to be raised with it: no older model passes for a new one
PASSES = {"lite0": 1, "lite0x2": 2, "lite0x2fine": 2, "dinov2s": 2}  # over the feature pyramid
DETAILED = ("lite0x2fine", "dinov2s")  # whose trunk sees coarsely, and a light branch the image as it is
FROZEN = ("dinov2s",)  # whose trunk is one for all models: no training changes it, no model's file holds it
NETWORKS = (*PASSES, "resnet34")  # the last is the contrastive papers' reference
ROUNDNESS = 0.2  # heatmap mass by which modes are a priori round and equally wide
MAX_MODES = 64  # that can be asked for: more than any symmetry of the objects has, and few enough to fit in a moment
OPTIMISERS = ("adamw", "muon")
N_POINTS = 625  # material points of the cloth and the rope

Config = TypeVar("Config", bound="RenderConfig | TrainConfig | EvaluateConfig")


def _check_object(name: str) -> None:
    """The cloth, the rope, or a name that an object of the user's own may have, whether its file is there yet or not.

    Where it is needed and missing, `mmgsd.scene.objects.planar_object.load_planar_object` gives the nearest name.
    """
    accepted = (f"{', '.join(map(repr, OBJECTS))} or the name of a file in data/objects: up to 60 letters, digits, "
                "- and _, a letter first")  # fmt: skip
    check("object", name, accepted, name in OBJECTS or re.fullmatch("[A-Za-z][A-Za-z0-9_-]{0,59}", name) is not None)
    taken = name not in OBJECTS and name.lower() in (*OBJECTS, *RESERVED)  # not every disk tells Cloth from cloth
    check("object", name, f"another name than {', '.join(map(repr, (*OBJECTS, *RESERVED)))}, which are taken: "
           f"{name + '2'!r}, for example", not taken)  # fmt: skip


def _later(default: Any) -> Any:
    """A field that came when data sets and models had names: it is not in them at its default."""
    return dataclasses.field(default=default, metadata={"later": True})


_set_frozen = object.__setattr__  # a field named ``object`` hides the builtin inside a class body


@dataclasses.dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """What a rendered data set holds.

    ``scene`` says what is seen around the object: "plain", a floor; "workspace", tables, boards, mats, tools and hands
    under hard light, seen obliquely, with prints, hems and stickers on the object, or without it (`mmgsd.scene`).
    """

    object: str = "cloth"  # or "rope", or the name of a file in data/objects (see `mmgsd.scene.objects.planar_object`)
    train_images: int = 60
    test_images: int = 20
    views: int = 10  # images of one simulation, each with its own camera, light and material
    samples: int = 1  # Cycles samples a pixel, denoised
    rotation_deg: float = 180.0  # the object is turned by an angle from ± this; 45 is prior work's fix (cloth)
    ball: bool = False  # a ball at the rope's first end: prior work's way to break its symmetry
    scene: str = _later("plain")  # or "workspace"
    seed: int = 0

    def __post_init__(self) -> None:
        check_types(self)
        _check_object(self.object)
        for name in ("train_images", "test_images", "views", "samples"):
            check(name, getattr(self, name), "at least 1", getattr(self, name) >= 1)
        check("rotation_deg", self.rotation_deg, "in (0, 180]", 0 < self.rotation_deg <= 180)
        check("ball", self.ball, "False for a cloth", not self.ball or self.object == "rope")
        check_choice("scene", self.scene, SCENES)
        check("seed", self.seed, "at least 0", self.seed >= 0)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of an image of the cloth or the rope in px."""
        return IMAGE_SIZE[self.object]


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How one model is trained. Pixels are those of the full image, whatever the network's input size."""

    object: str = "cloth"
    method: str = "mmgsd"
    group: str = ""  # symmetry group the matches come from; "" is the object's own (c4, c2, or its file's)
    network: str = "lite0"  # or another of `NETWORKS`
    # what to start from: for those of `PASSES` a file, or the name of a model trained beside it or in data/weights, of
    # as many parts or fewer ("": ImageNet); for resnet34 torchvision's ImageNet weights as safetensors ("": random)
    trunk_weights: str = ""
    descriptor_dim: int = 32
    roles: int = 1  # 2: a pixel that is asked about and one that answers have descriptors of their own
    input_px: int = 128  # the longer side of the network's input
    steps: int = 600
    batch: int = 16  # images a step
    groups: int = 1  # parts of a batch normalised and paired each by itself; as many processes can share a step
    pairs: int = 60  # ordered pairs of images a step
    queries: int = 64  # source points a pair
    optimiser: str = _later("adamw")  # or "muon": the convolutions' steps are made orthogonal
    learning_rate: float = 1.5e-3
    schedule: str = "cosine"  # or "step": times 0.9 every 250 steps, the reference of the contrastive losses
    weight_decay: float = 0.02
    sigma_px: float = 1.0  # std of a target mode at the end of training
    sigma_start_px: float = 48.0  # std at its start; annealed geometrically over the first two thirds
    prototype_weight: float = -1.0  # of the dense supervision by single images; -1: 0 for pcl and spcl, 1 for others
    margin: float = 0.5  # contrastive losses only
    non_matches: int = 150  # a match, half of them on the object (contrastive losses only)
    hidden_matches: bool = _later(False)  # contrastive losses also learn matches that are hidden in the target
    augment: bool = True
    bend: float = 0.0  # augmentation stretches and squeezes images along random waves, by up to this share
    rotate: bool = True  # augmentation turns images by any angle; off where the rotation limit is the experiment
    roundness: float = _later(ROUNDNESS)  # of the modes read from heatmaps, a priori (`mmgsd.match.mixture.fit_modes`)
    heads: bool = _later(False)  # it also learns where the object is, what is seen, whether it is there (`learn.heads`)
    clutter: bool = _later(False)  # augmentation changes backgrounds and puts things in front (`learn.compositing`)
    strong: bool = _later(False)  # augmentation also gives the object other textures, zooms and shifts further
    also: str = _later("")  # preset whose images of the object are trained on besides the data set's own, or ""
    seed: int = 0

    def __post_init__(self) -> None:
        check_types(self)
        _check_object(self.object)
        check_choice("method", self.method, METHODS)
        check_choice("network", self.network, NETWORKS)
        check_choice("optimiser", self.optimiser, OPTIMISERS)
        check_choice("schedule", self.schedule, ("cosine", "step"))
        _set_frozen(self, "group", self.group or DEFAULT_GROUP.get(self.object, OWN_GROUP))
        weight = self.prototype_weight
        check("prototype_weight", weight, "at least 0, or -1 for the method's own", weight >= 0 or weight == -1)
        for name in ("descriptor_dim", "steps", "pairs", "queries"):
            check(name, getattr(self, name), "at least 1", getattr(self, name) >= 1)
        check("roles", self.roles, "1 or 2", self.roles in (1, 2))
        check("non_matches", self.non_matches, "at least 2 (on and off the object)", self.non_matches >= 2)
        for name in ("learning_rate", "sigma_px", "sigma_start_px", "margin", "roundness"):
            check(name, getattr(self, name), "greater than 0", getattr(self, name) > 0)
        check("batch", self.batch, "at least 2 (a pair)", self.batch >= 2)
        each = f"a divisor of batch and pairs that leaves at least 2 of {self.batch} images and a pair in each"
        divides = self.groups >= 1 and self.batch % self.groups == 0 == self.pairs % self.groups
        check("groups", self.groups, each, divides and self.batch // self.groups >= 2)
        least = 128 if self.network in DETAILED else 64  # px, of which the trunk sees 64
        check("input_px", self.input_px, f"at least {least} for {self.network!r}", self.input_px >= least)
        check("bend", self.bend, "in [0, 0.5]", 0 <= self.bend <= 0.5)
        for name in ("weight_decay", "seed"):
            check(name, getattr(self, name), "at least 0", getattr(self, name) >= 0)
        check("heads", self.heads, f"False for {self.network!r}", not self.heads or self.network in PASSES)
        allowed = not self.hidden_matches or self.method in CONTRASTIVE
        check("hidden_matches", self.hidden_matches, f"False for {self.method!r}, which always learns them", allowed)
        if self.strong:
            accepted = "False for an object of your own, or without augment"
            check("strong", self.strong, accepted, self.object in OBJECTS and self.augment)
        if self.also:
            check_choice("also", self.also, tuple(PRESETS))

    @property
    def dense_weight(self) -> float:
        """Weight of the dense supervision that the method gets."""
        return float(self.method not in CONTRASTIVE) if self.prototype_weight < 0 else self.prototype_weight

    @property
    def name(self) -> str:
        """Folder name: what a reader looks for, and a digest of everything else."""
        kind = CONTRASTIVE_REVISION if self.method in CONTRASTIVE else f"sigma{self.sigma_px:g}"
        return f"{self.object}-{self.method}-{self.group}-{kind}-{digest(self)}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Which questions an evaluation asks (paper section "Quantitative Results")."""

    pairs: int = 500  # pairs of test images
    points: int = 625  # source material points a pair, an evenly spread subset where fewer
    seed: int = 0

    def __post_init__(self) -> None:
        check_types(self)
        check("pairs", self.pairs, "at least 1", self.pairs >= 1)
        check("points", self.points, f"between 1 and {N_POINTS}", 1 <= self.points <= N_POINTS)
        check("seed", self.seed, "at least 0", self.seed >= 0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Preset:
    """One size of the whole experiment; every size runs the same stages."""

    name: str
    render: dict[str, RenderConfig]
    train: dict[str, TrainConfig]  # of MMGSD, one an object
    evaluate: EvaluateConfig
    ablation: dict[str, TrainConfig]  # the equal, smaller budget of the studies
    sigmas_px: tuple[float, ...]
    cluttered: str = "workspace"  # preset of the cluttered images that go with these, where a model learns from both


def _preset(
    name: str, *, views: dict, train: dict, rope: dict, ablation: dict, evaluate: dict, sigmas: tuple,
    cluttered: str = "workspace", **render: Any,
) -> Preset:  # fmt: skip
    cloth_train = TrainConfig(object="cloth", **train)
    rope_train = TrainConfig(object="rope", **{**train, **rope})
    return Preset(
        name=name,
        render={o: RenderConfig(object=o, views=views[o], **render) for o in OBJECTS},
        train={"cloth": cloth_train, "rope": rope_train},
        evaluate=EvaluateConfig(**evaluate),
        ablation={t.object: dataclasses.replace(t, **ablation) for t in (cloth_train, rope_train)},
        sigmas_px=sigmas,
        cluttered=cluttered,
    )


def load_preset(name: str) -> Preset:
    """The preset of a name of `PRESETS`; ValueError, which names them, for any other."""
    check_choice("preset", name, tuple(PRESETS))
    return PRESETS[name]


PAPER = dict(
    train_images=3500, test_images=500, views={"cloth": 5, "rope": 10},
    train={"steps": 4000, "bend": 0.5, "roles": 2}, rope={"input_px": 160},
    ablation={"steps": 1000}, sigmas=(1.0, 2.0, 4.0, 8.0, 16.0),
    evaluate={"pairs": 500, "points": 625},
)  # fmt: skip
QUICK = dict(
    train_images=300, test_images=50, views={"cloth": 5, "rope": 5},
    train={"network": "lite0x2", "optimiser": "muon", "steps": 225, "input_px": 96, "pairs": 40, "queries": 32},
    rope={"input_px": 128, "steps": 270}, ablation={"steps": 60}, sigmas=(1.0, 4.0, 16.0),
    evaluate={"pairs": 30, "points": 625}, cluttered="workspace_quick",
)  # fmt: skip
ROUNDS = {"cloth": 5, "rope": 7}  # stretches of the shipped models' training, each on new images
UNSEEN_SEED = 6  # no round's
ROUND = {**PAPER, "train_images": 600, "test_images": 10}
PRESETS = {
    "smoke": _preset(
        "smoke",
        train_images=4, test_images=4, views={"cloth": 2, "rope": 2},
        train={"steps": 6, "batch": 4, "pairs": 6, "queries": 16, "input_px": 64}, rope={},
        ablation={"steps": 4}, sigmas=(1.0, 16.0),
        evaluate={"pairs": 4, "points": 25},
    ),
    "quick": _preset("quick", **QUICK),
    "paper": _preset("paper", **PAPER),
    "workspace": _preset("workspace", **PAPER, scene="workspace"),
    "workspace_quick": _preset("workspace_quick", **QUICK, scene="workspace"),
}  # fmt: skip
for _number in range(1, max(ROUNDS.values()) + 1):
    _clean, _cluttered = f"round{_number}", f"round{_number}_workspace"
    # a round's own images have less error than new ones: later rounds draw more simulations, and fewer views of each
    _seed = _number if _number < UNSEEN_SEED else _number + 1
    _round = {**ROUND, "seed": _seed, "views": {"cloth": 5 if _number < 4 else 2, "rope": 10 if _number < 3 else 1}}
    PRESETS[_clean] = _preset(_clean, **_round, cluttered=_cluttered)
    PRESETS[_cluttered] = _preset(_cluttered, **_round, scene="workspace")
# images that no round has seen, by which what is shipped is chosen and calibrated: its test images alone
_unseen = {**_round, "test_images": 150, "seed": UNSEEN_SEED}
PRESETS["unseen"] = _preset("unseen", **_unseen, cluttered="unseen_workspace")
PRESETS["unseen_workspace"] = _preset("unseen_workspace", **_unseen, scene="workspace")


def digest(config: Config) -> str:
    """Eight hexadecimal digits that differ where any field of the configuration differs."""
    text = json.dumps(to_dict(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def list_later(kind: type[Config]) -> dict[str, Any]:
    """{name: default} of the fields that what is stored lacks where they have their default."""
    return {field.name: field.default for field in dataclasses.fields(kind) if "later" in field.metadata}


def to_dict(config: Config) -> dict[str, Any]:
    """What is stored of a configuration: its fields but those of `list_later` that have their default."""
    later = list_later(type(config)).items()
    return {name: value for name, value in dataclasses.asdict(config).items() if (name, value) not in later}


def from_dict(kind: type[Config], values: dict[str, Any]) -> Config:
    """Build a configuration from stored values; an unknown key is a ValueError that names the accepted ones."""
    names = [field.name for field in dataclasses.fields(kind)]
    for key in values:
        check_choice(f"a key of {kind.__name__}", key, tuple(names))
    return kind(**values)
