"""The public ``Matcher``: trained weights that describe images, and answer questions about pairs of them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from torch import Tensor

from mmgsd.checks import check, renamed
from mmgsd.config import CONTRASTIVE, OBJECTS, TrainConfig
from mmgsd.images import check_aspect, check_mask, check_pixels, to_rgb
from mmgsd.match.em import ModeReadout
from mmgsd.match.heatmap import check_scales, compute_heatmap
from mmgsd.match.match import Match
from mmgsd.match.mixture import check_modes
from mmgsd.match.pair import Pair
from mmgsd.match.places import Flat, Place, lay_flat, locate, shrink_sources
from mmgsd.model.calibration import Calibration
from mmgsd.model.heads import Outputs, weigh_cells
from mmgsd.model.network import compute_squared_distances, find_device, fit_input_size, sample_descriptors
from mmgsd.model.weights import read_weights
from mmgsd.numerics import own_numerics
from mmgsd.paths import find_shipped

if TYPE_CHECKING:
    from mmgsd.match.track import Track, Tracked

QUARTERS = 4  # turns of an image whose descriptors are averaged: what noise they have differs
SIZES_PX = (16, 65536)  # of the images that a model was taught with


class Matcher:
    """Finds all matches of pixels between two images of an object, with trained weights.

    ``modes`` of its symmetry, and the ``size`` (width, height) px of the images it was taught with. ValueError for what
    cannot be.
    """

    def __init__(
        self, network: torch.nn.Module, config: TrainConfig, *, modes: int, size: tuple[int, int], device: str = "",
        bandwidth: float | None = None, temperature: float = 1.0, power: float = 1.0, sharpness: float = 1.0,
        calibration: Calibration | None = None, places: Tensor | None = None, shrinkage: float = 0.0,
    ) -> None:  # fmt: skip
        check_scales(bandwidth=bandwidth, temperature=temperature)
        check("shrinkage", shrinkage, "a number from 0 to 1", 0 <= shrinkage <= 1)
        check_modes(modes)
        _check_size(size)
        self.device = torch.device(find_device(device))
        self.network = network.eval().to(self.device, memory_format=torch.channels_last)
        self.config, self.num_modes, self.size = config, modes, size
        self.object = config.object  # "" where a file of weights does not say
        self.temperature, self.calibration = temperature, calibration
        self.readout = ModeReadout(config.roundness, power, sharpness)
        self.turns = QUARTERS if config.rotate else 1  # what was trained upright knows only upright images
        self.bandwidth = config.margin / 4 if bandwidth is None and config.method in CONTRASTIVE else bandwidth
        self.places = places  # (P, D) what the object's material points are described as, None where that is not known
        self.shrinkage = shrinkage  # of what pixels are asked about with, towards the places that they look like

    modes = renamed("modes", "num_modes")
    reading = renamed("reading", "readout")

    @classmethod
    @own_numerics(gradients=True)
    def load(cls, path: Path | str, *, device: str = "") -> Matcher:
        """Weights from a safetensors file; FileNotFoundError, or ValueError for one that is damaged or not ours."""
        find_device(device)  # what is wrong with it is not the file's fault
        network, config, settings, object = read_weights(path)
        try:
            matcher = cls(network, config, device=device, **settings)
        except ValueError as error:
            raise ValueError(f"{path}: of its metadata, {error}: get the file anew") from error
        matcher.object = object
        return matcher

    @own_numerics()
    def describe(self, images: list[np.ndarray]) -> list[Outputs]:
        """What the network says of each of the images (H, W, 3) uint8 of any sizes, the mean over quarter turns.

        An `Outputs` each, without the batch's axis: ``descriptors`` (C, h, w), where C is D, or 2 D where an image is
        described in both roles (as a source first, then as a target), and what the heads say where there are any. The
        grid follows the image's own aspect (`fit_input_size`); images of one grid are described at once.
        """
        sizes = [self.compute_input_size(image) for image in images]
        described = {}
        for size in dict.fromkeys(sizes):
            chosen = [index for index, other in enumerate(sizes) if other == size]
            small = [cv2.resize(images[index], size, interpolation=cv2.INTER_AREA) for index in chosen]
            batch = torch.from_numpy(np.stack(small)).to(self.device).permute(0, 3, 1, 2).float() / 255
            described |= zip(chosen, self._compute_outputs(batch).split(), strict=True)
        return [described[index] for index in range(len(images))]

    def compute_input_size(self, image: np.ndarray, name: str = "image") -> tuple[int, int]:
        """(width, height) px that an image (H, W, 3) is given to the network with; ValueError for a narrow strip."""
        size = (image.shape[1], image.shape[0])
        if size[0] * self.size[1] != size[1] * self.size[0]:  # what the model was taught with may be a strip
            check_aspect(size, name)
        return fit_input_size(size, self.size, self.config.input_px, least_px=self.least_px)

    @property
    def least_px(self) -> int:
        """Of the shorter side of what the network is given.

        Where a level is less than 3 cells across, bfloat16's strided convolution on a CPU reads memory at random.
        """
        return 12 * self.network.stride

    def describe_inputs(self, batch: Tensor) -> Tensor:
        """Descriptors (B, C, h, w) of images (B, 3, H, W) in [0, 1] of the network's input size."""
        return self._compute_outputs(batch).descriptors

    def _compute_outputs(self, batch: Tensor) -> Outputs:
        """The mean of what the network says of images after each quarter turn, turned back."""
        turns = (batch.rot90(k, (2, 3)).contiguous(memory_format=torch.channels_last) for k in range(self.turns))
        outputs = [self.network.describe(turned).turn(-k) for k, turned in enumerate(turns)]
        return Outputs.mean(outputs)

    @own_numerics()
    def compute_heatmaps(
        self, outputs0: Outputs, outputs1: Outputs, xy: Tensor, size: tuple[int, int], *, mask1: Tensor | None = None
    ) -> Tensor:
        """Heatmaps (S, h, w) of source px ``xy`` (S, 2) of an image of ``size``, from what `describe` made of each.

        They are weighted by where the second image shows the object: by ``mask1`` (H1, W1) bool, or else by the
        network's own mask, if it has one.
        """
        source = self.sample_sources(outputs0, xy, size)  # (1, S, D)
        target = outputs1.descriptors[-self.config.descriptor_dim :]
        squared = compute_squared_distances(source, target.flatten(1).T[None])[0]  # (S, h * w)
        heatmap = compute_heatmap(squared, bandwidth=self.bandwidth, temperature=self.temperature)
        heatmap = heatmap.view(len(xy), *target.shape[1:])
        weight = weigh_cells(outputs1, target.shape[1:], mask1)
        if weight is None:
            return heatmap
        weighted = heatmap * weight
        total = weighted.sum((1, 2), keepdim=True)
        return torch.where(total > 1e-12, weighted / total.clamp(min=1e-12), heatmap)

    @own_numerics()
    def compute_visible(
        self, outputs0: Outputs, outputs1: Outputs, xy: Tensor, modes: Tensor, sizes: tuple[tuple[int, int], ...]
    ) -> Tensor | None:
        """Probability (S, n) that what lies at ``xy`` (S, 2) px is seen at each of the ``modes`` (S, n, 2) px.

        ``sizes`` are the two images' (width, height). 0 for modes that are NaN; None of a network without heads.
        """
        if outputs1.surface is None:
            return None
        there = torch.cat([outputs1.descriptors, outputs1.surface])[None]
        places = modes.to(self.device).float().nan_to_num(-0.5)
        there = sample_descriptors(there, places.flatten(0, 1)[None], sizes[1])[0].unflatten(0, modes.shape[:2])
        channels = len(outputs1.descriptors)
        source = self.sample_sources(outputs0, xy, sizes[0])[0][:, None]  # (S, 1, D)
        logits = self.network.heads.visibility(source, there[..., :channels], there[..., channels:])
        return torch.sigmoid(logits) * modes.isfinite().all(-1).to(logits.device)

    def segment(self, image: Any) -> np.ndarray:
        """Where an image shows the object: (H, W) float32 in [0, 1]; ValueError of weights that learnt no mask."""
        image, _ = take_image(self, image)
        mask = self.describe([image])[0].mask
        if mask is None:
            raise ValueError(f"these weights of {self.config.name} learnt no mask: load others, like 'cloth' or 'rope'")
        return self.resize_mask(mask, image.shape[1::-1])

    def resize_mask(self, logits: Tensor, size: tuple[int, int]) -> np.ndarray:
        """(H, W) float32 in [0, 1] of an image of ``size`` (width, height), from an `Outputs.mask` (h, w)."""
        return cv2.resize(logits.sigmoid().cpu().numpy(), size, interpolation=cv2.INTER_LINEAR)

    def sample_sources(self, outputs0: Outputs, xy: Tensor, size: tuple[int, int], *, shrink: bool = True) -> Tensor:
        """(1, S, D) what pixels ``xy`` (S, 2) of an image of ``size`` are asked about with.

        That is each one's descriptor; of weights with a ``shrinkage`` drawn towards the mean descriptors of the
        places of the object that it looks like (`mmgsd.match.places.shrink_sources`), unless ``shrink`` is false.
        """
        sources = outputs0.descriptors[None, : self.config.descriptor_dim]
        sampled = sample_descriptors(sources, xy[None].to(self.device).float(), size)
        if not shrink or self.places is None or not self.shrinkage:
            return sampled
        return shrink_sources(sampled, self.places.to(sampled), self.shrinkage, bandwidth=self.bandwidth)

    def locate(self, outputs0: Outputs, xy: Tensor, size: tuple[int, int]) -> np.ndarray | None:
        """(G, S, 2) in [0, 1], where each member of the symmetry takes pixels ``xy`` (S, 2) on the object laid flat.

        As `mmgsd.match.places.locate`; of an image of ``size`` (width, height). None of weights that do not know their
        places, and of objects of which is not known how these lie beside each other.
        """
        if self.places is None or self.object not in OBJECTS:
            return None
        sources = self.sample_sources(outputs0, xy, size)[0]
        return locate(sources, self.places.to(sources), self.object, self.config.group, bandwidth=self.bandwidth)

    def match(
        self, image0: Any, image1: Any, xy: Any, *, n: Any = None, mask0: Any = None, mask1: Any = None,
        joint: bool = False,
    ) -> Match:  # fmt: skip
        """All matches in ``image1`` of the pixels ``xy`` (S, 2), or of the one pixel (2,), of ``image0``.

        Images are RGB, not OpenCV's BGR, of any size and each of its own, paths or of any kind that
        `mmgsd.images.to_rgb` takes; they are copied.
        ``n`` modes are returned, one number for all or (S,), by default as many as the symmetry group has members;
        "auto" finds their number. The group's number is fitted even where fewer are asked for: of these the most
        probable are the answer, and their weights are divided by their sum. ``mask0`` and ``mask1``, (H, W) bool each,
        say where the images show the object, from any segmenter of yours: the network's own masks then do not count.
        With ``joint``, all pixels are answered under the same member of the symmetry: ``modes[:, g]`` belong together,
        the g-th of the consistent answers, and ``joint`` (n,) of the `Match` says how much each weighs. That asks about
        places all over the object besides (`mmgsd.match.joint`), so where it lies in image0 must be known: from weights
        that learnt a mask, or ``mask0``.
        ValueError for other images or masks, for ``xy`` outside image0, for ``n`` that is not from 1 to `MAX_MODES`, or
        with ``joint`` from 1 to the group's number, and for ``joint`` without a mask.
        """
        return self.prepare(image0, image1, mask0=mask0, mask1=mask1).match(xy, n=n, joint=joint)

    def prepare(self, image0: Any, image1: Any, *, mask0: Any = None, mask1: Any = None) -> Pair:
        """Describe two images once, to ask about them many times; arguments and errors are those of `match`.

        Without ``image0`` the `Pair` is asked about places, as by `find`.
        """
        return self._prepare(image0, image1, self.describe, mask0=mask0, mask1=mask1)

    def find(self, image: Any, places: Any, *, n: Any = None, mask: Any = None, joint: bool = False) -> Match:
        """Places of the object in ``image`` by name, without a first picture: "corners", "ends", "centre".

        ``places`` is one or a list of them, a query each: of a cloth "corners", "edges" (their middles), "centre" or
        (u, v) in [0, 1]; of a rope "ends", "middle" or a fraction of its length; of any object the number of a material
        point; or what `average` learnt from pictures. The modes of a query are that place and those that look like it,
        by default as many as there are. The `Match` has a drawing of the object laid flat for ``image0``. ``mask`` is
        where the image shows the object; ``n`` and ``joint`` are those of `match`, and so are errors. ValueError of
        weights that do not know their places (`python -m mmgsd calibrate` adds them), and for others than these.
        """
        return self.prepare(None, image, mask1=mask).match(places, n=n, joint=joint)

    @own_numerics()
    def average(self, pictures: Iterable[tuple[Any, Any]]) -> Place:
        """A place from several pictures (image, (x, y)) of it or of those that look like it, for `find`.

        ValueError where there is none, and for an image or a pixel that `match` refuses.
        """
        sampled = []
        for image, xy in pictures:
            image, _ = take_image(self, image)
            size = image.shape[1::-1]
            points = torch.from_numpy(check_pixels(xy, size, image="image"))
            sampled.append(self.sample_sources(self.describe([image])[0], points, size, shrink=False)[0])
        if not sampled:
            raise ValueError("pictures must be (image, (x, y)), one or more, got none")
        return Place(torch.cat(sampled).mean(0, keepdim=True))

    def lay_flat(self) -> Flat:
        """The object laid flat, as its places are asked for; ValueError of weights that do not know them."""
        if self.places is None:
            raise ValueError(f"these weights of {self.config.name} do not know the object's places: give a first "
                             "image instead, or add them by python -m mmgsd calibrate")  # fmt: skip
        return lay_flat(self.places.to(self.device), self.object, self.config.group)

    def look_up_places(self, places: Any, *, joint: bool) -> tuple[Flat, np.ndarray, np.ndarray | None]:
        """The object laid flat, the pixels (S, 2) of places there and how many like places (S,) each has.

        ValueError is as of `find`.
        """
        learnt = isinstance(places, Place)
        flat = lay_flat(places.descriptors, "", "") if learnt else self.lay_flat()
        if joint and flat.object not in OBJECTS:
            of = "pictures" if learnt else repr(flat.object)
            raise ValueError(f"joint must be False for places of {of}: how they lie beside each other is not known")
        return flat, *flat.look_up(list(range(len(places.descriptors))) if learnt else places)

    def track(self, frames: Any, xy: Any = None, *, find: Any = None, mask0: Any = None) -> Track:
        """Where pixels ``xy`` (S, 2) of the first of the ``frames`` are in all of them, each as itself.

        Of its like matches a pixel's own one is chosen once and kept, while the object is turned, folded and hidden.
        ``frames`` are images of one size that `match` takes, one after the other, or the path of a video or of a folder
        of images. Instead of ``xy``, ``find`` names places as `find` takes them: all like ones are followed. ``mask0``
        is as `match` has it. ValueError for frames of several sizes, none, or a first one without the object, for
        ``xy`` outside it, and as ``joint`` has it.
        """
        from mmgsd.match.track import Track

        return Track.collect(self.follow(frames, xy, find=find, mask0=mask0))

    def follow(self, frames: Any, xy: Any = None, *, find: Any = None, mask0: Any = None) -> Iterator[Tracked]:
        """As `track`, each frame's answer when it is asked for, so in little memory: for cameras and long videos."""
        from mmgsd.match.track import follow

        return follow(self, frames, xy, find=find, mask0=mask0)

    def match_many(
        self, questions: Iterable[tuple[Any, ...]], *, n: Any = None, joint: bool = False
    ) -> Iterator[Match]:
        """The answers to many questions, each when it is asked for, so in little memory.

        A question is (image0, image1, xy), or (image0, image1, xy, mask0, mask1) with None for a mask that there is
        not; (None, image1, places) asks what `find` does. An image that comes again soon, by its pixels, is described
        once: a reference before many frames. ``n``, ``joint`` and errors are those of `match`; after an error there is
        no further answer.
        """
        recent = _Recent(self.describe)
        for image0, image1, xy, mask0, mask1 in map(fill_question, questions):
            pair = self._prepare(image0, image1, recent.describe, mask0=mask0, mask1=mask1)
            yield pair.match(xy, n=n, joint=joint)

    def _prepare(
        self, image0: Any, image1: Any, describe: Callable[[list[np.ndarray]], list[Outputs]], *, mask0: Any = None,
        mask1: Any = None,
    ) -> Pair:  # fmt: skip
        if image0 is None:
            check("mask0", mask0, "None where there is no image0", mask0 is None)
            image1, mask1 = take_image(self, image1, mask1, "image1", "mask1")
            return Pair(self, None, image1, (None, *describe([image1])), None, mask1)
        image0, mask0 = take_image(self, image0, mask0, "image0", "mask0")
        image1, mask1 = take_image(self, image1, mask1, "image1", "mask1")
        return Pair(self, image0, image1, tuple(describe([image0, image1])), mask0, mask1)


class _Recent:
    """What ``describe`` said of the last few images, found again by their pixels: a camera may refill one array."""

    def __init__(self, describe: Callable[[list[np.ndarray]], list[Outputs]], *, most: int = 8) -> None:
        self._describe, self._most, self._outputs = describe, most, {}

    def describe(self, images: list[np.ndarray]) -> list[Outputs]:
        """As `Matcher.describe`."""
        return [self._look_up(image) for image in images]

    def _look_up(self, image: np.ndarray) -> Outputs:
        key = image.shape, hashlib.blake2b(image).digest()
        self._outputs[key] = self._outputs.pop(key) if key in self._outputs else self._describe([image])[0]
        if len(self._outputs) > self._most:
            del self._outputs[next(iter(self._outputs))]
        return self._outputs[key]


def take_image(
    matcher: Matcher, image: Any, mask: Any = None, name: str = "image", mask_name: str = "mask"
) -> tuple[np.ndarray, np.ndarray | None]:
    """An image (H, W, 3) uint8 that can be asked about, and its mask (H, W) bool; ValueError for another of either."""
    image = to_rgb(image, name)
    matcher.compute_input_size(image, name)
    return image, None if mask is None else check_mask(mask, image.shape[:2], mask_name)


def load(weights: Path | str, *, device: str = "") -> Matcher:
    """A `Matcher` with the weights of a file, or of a name of shipped ones: ``"cloth"``, ``"rope-spcl"``.

    FileNotFoundError where there are none; ValueError for a file that is damaged or not ours.
    """
    return Matcher.load(find_weights(weights), device=device)


def find_weights(weights: Path | str) -> Path:
    """The file that `load` reads; FileNotFoundError where there is none."""
    path = Path(weights)
    if path.is_file():  # a folder of a model's name does not hide the model
        return path
    shipped = {file.stem: file for file in sorted(find_shipped().glob("*.safetensors"), key=lambda file: file.stem)}
    if str(weights) not in shipped and not path.exists():
        raise FileNotFoundError(f"{weights} must be a safetensors file or one of {', '.join(map(repr, shipped))}")
    return shipped.get(str(weights), path)


def fill_question(question: Iterable[Any]) -> tuple[Any, Any, Any, Any, Any]:
    """(image0, image1, xy, mask0, mask1) of a question, None for masks that it lacks; ValueError for another length."""
    values = tuple(question)
    if len(values) not in (3, 5):
        raise ValueError("questions must be (image0, image1, xy) or (image0, image1, xy, mask0, mask1) each, "
                         f"got {len(values)} values")  # fmt: skip
    return (*values, None, None)[:5]


def _check_size(size: tuple[int, int]) -> None:
    """ValueError unless two whole numbers of px."""
    low, high = SIZES_PX
    whole = isinstance(size, tuple | list) and len(size) == 2 and all(type(side) is int for side in size)
    accepted = f"(width, height), two whole numbers of {low} to {high} px"
    check("size", size, accepted, whole and all(low <= side <= high for side in size))
