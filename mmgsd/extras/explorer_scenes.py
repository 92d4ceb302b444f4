"""What the explorer opens: pairs of images with what is known of them, and the methods that answer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.checks import check, check_choice
from mmgsd.config import OBJECTS, PRESETS, load_preset
from mmgsd.dataset import Dataset, load_dataset, sample_pairs
from mmgsd.images import read_image, to_rgb
from mmgsd.match.baselines import BASELINES, BaselineMatcher
from mmgsd.match.matcher import load
from mmgsd.match.places import Flat
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import SHIPPED, configure_study, get_label
from mmgsd.studies.sample import load_sample

SNAP_PX = 12.0  # a click so near to a material point shows that point's true matches
SAMPLE = "sample"  # the preset of the images in data/sample


@dataclass(frozen=True)
class Scene:
    """A pair of images and, where they are known, the labels of the first and the matches in the second."""

    image0: np.ndarray  # (H0, W0, 3) uint8
    image1: np.ndarray  # (H1, W1, 3) uint8
    name0: str = "your image"
    name1: str = "your image"
    mask1: np.ndarray | None = None  # (H1, W1) bool, which hand-made descriptors need
    xy0: np.ndarray | None = None  # (P, 2) px of the material points
    orbits: list[np.ndarray] | None = None  # true matches (n, 2) px of each
    flat: bool = False  # the first is the object laid flat: what is asked about are places

    def find_truth(self, xy: np.ndarray) -> np.ndarray:
        """True matches (n, 2) px of the material point nearest to a pixel (2,); none where it is far or unknown."""
        if self.xy0 is None:
            return np.empty((0, 2))
        distance = np.linalg.norm(self.xy0 - xy, axis=1)
        return self.orbits[int(distance.argmin())] if distance.min() <= SNAP_PX else np.empty((0, 2))

    def replace_image(self, side: int, image: np.ndarray, name: str) -> Scene:
        """The pair with another first (0) or second (1) image, of any kind that `Matcher.match` takes.

        Nothing is known of its matches any more.
        """
        other = {f"image{side}": to_rgb(image, f"image{side}"), f"name{side}": name, "xy0": None, "orbits": None}
        fields = {"mask1": self.mask1} if side == 0 else {"mask1": None, "flat": self.flat}
        return dataclasses.replace(self, **{"flat": False, **other, **fields})

    def lay_flat(self, flat: Flat) -> Scene:
        """The second image beside the object laid flat; where its matches are known, they stay known."""
        labels = {"xy0": None if self.orbits is None else flat.xy}
        return dataclasses.replace(self, image0=flat.image, name0=f"{flat.object}, laid flat", flat=True, **labels)


def make_scenes(data: Dataset, *, pairs: int = 50, seed: int = 0) -> list[Callable[[], Scene]]:
    """Pairs of images of a data set's split, read when they are looked at."""
    group = data.group()

    def make(first: int, second: int) -> Scene:
        """The scene of two images, by their indices."""
        orbits = [data.xy[second][group.distinct_modes(point)] for point in range(group.n_points)]
        names = (Path(data.labels.file.iloc[index]).name for index in (first, second))
        images = data.load_image(first), data.load_image(second)
        seen = np.where(data.visible[first][:, None], data.xy[first], np.inf)
        return Scene(*images, *names, data.load_mask(second), seen, orbits)

    chosen = sample_pairs(data.episode, pairs, np.random.default_rng(seed), present=data.present)
    return [lambda a=int(a), b=int(b): make(a, b) for a, b in chosen]


def choose_scenes(name: str, preset: str = SAMPLE, own_images: Sequence[Path | str] = ()) -> list:
    """The pairs to open for an object: two image files where ``own_images`` are these, else test images of a data set.

    ``preset``: "sample" for the images that come with the repository, or a preset whose data set has been rendered.
    ValueError names the argument that is wrong.
    """
    check_choice("name", name, OBJECTS)
    check_choice("preset", preset, (SAMPLE, *PRESETS))
    check("own_images", own_images, "[] or a list of two image files", len(own_images) in (0, 2))
    if own_images:
        return [Scene(*map(read_image, own_images), *(Path(path).name for path in own_images))]
    if preset == SAMPLE:
        return make_scenes(load_sample(find_root(), name))
    return make_scenes(load_dataset(Paths(find_root(), preset).dataset(name), "test"))


def load_matchers(name: str, preset: str = SAMPLE) -> dict[str, Any]:
    """{label: matcher} for an object: the shipped models, those trained here with a preset, hand-made descriptors.

    With the preset "sample", the ones that are trained with "quick".
    """
    trained = Paths(find_root(), "quick" if preset == SAMPLE else preset)
    matchers = {get_label(method, short=True): load(f"{name}{ending}") for method, ending in SHIPPED.items()}
    for method, config in configure_study(load_preset(trained.preset), name, "main").items():
        path = trained.model(config) / WEIGHTS
        if path.is_file():
            matchers[f"{get_label(method, short=True)} ({trained.preset})"] = load(path)
    return matchers | {get_label(method, short=True): BaselineMatcher(method) for method in BASELINES}
