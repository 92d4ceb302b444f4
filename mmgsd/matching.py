"""From descriptors to heatmaps, their modes and entropy; the public ``Matcher`` and its answer, the ``Match``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from mmgsd.answer import Best as Best
from mmgsd.answer import Match
from mmgsd.config import CONTRASTIVE, ROUNDNESS, TrainConfig, find_root
from mmgsd.images import check_aspect, check_pixels, to_rgb
from mmgsd.images import read_image as read_image
from mmgsd.losses import compute_squared_distances
from mmgsd.mixture import Mixture, check_count, check_modes, fit_modes, keep_most_probable
from mmgsd.network import compute_cell_centres, find_device, fit_input_size, sample_descriptors
from mmgsd.weights import read_weights

QUARTERS = 4  # turns of an image whose descriptors are averaged: what noise they have differs
SIZES_PX = (16, 65536)  # of the images that a model was taught with


def compute_heatmap(squared_distances: Tensor, *, bandwidth: float | None = None, temperature: float = 1.0) -> Tensor:
    """Distributions over cells (..., C) from squared descriptor distances (..., C).

    softmax(-d²) as in training (paper section "Symmetric Distributional Loss"); or, for descriptors of a contrastive
    loss, which have no scale of their own, a Gaussian of ``bandwidth`` in the descriptor norm differences, normalised.
    Either is raised to the power 1 / ``temperature``. ValueError where one of the two is not finite and above 0.
    """
    check_scales(bandwidth=bandwidth, temperature=temperature)
    scale = 1.0 if bandwidth is None else 1 / (2 * bandwidth**2)
    return torch.softmax(-scale / temperature * squared_distances, -1)


def compute_entropy(heatmap: Tensor, cell_area: float) -> Tensor:
    """Differential entropy in nats of the density over px: (S, C) to (S,); ln of the area it spreads over."""
    return torch.special.entr(heatmap).sum(-1) + float(np.log(cell_area))


def check_scales(*, bandwidth: float | None = None, temperature: float = 1.0) -> None:
    """ValueError, which names it, for a ``bandwidth`` or a ``temperature`` that is not finite and greater than 0."""
    for name, value in (("bandwidth", bandwidth), ("temperature", temperature)):
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if value is not None and not (number and math.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be finite and greater than 0, got {value!r}")


class Matcher:
    """Finds all matches of pixels between two images of an object, with trained weights.

    ``modes`` of its symmetry, and the ``size`` (width, height) px of the images it was taught with. ValueError for what
    cannot be.
    """

    def __init__(
        self, network: torch.nn.Module, config: TrainConfig, *, modes: int, size: tuple[int, int], device: str = "",
        bandwidth: float | None = None, temperature: float = 1.0,
    ) -> None:  # fmt: skip
        check_scales(bandwidth=bandwidth, temperature=temperature)
        check_modes(modes)
        _check_size(size)
        self.device = torch.device(device or find_device())
        self.network = network.eval().to(self.device, memory_format=torch.channels_last)
        self.config, self.modes, self.size = config, modes, size
        self.object = config.object  # "" where a file of weights does not say
        self.temperature = temperature
        self.turns = QUARTERS if config.rotate else 1  # what was trained upright knows only upright images
        self.bandwidth = config.margin / 4 if bandwidth is None and config.method in CONTRASTIVE else bandwidth

    @classmethod
    def load(cls, path: Path | str, *, device: str = "") -> Matcher:
        """Weights from a safetensors file; FileNotFoundError, or ValueError for one that is damaged or not ours."""
        weights = read_weights(path)
        try:
            matcher = cls(weights.network, weights.config, device=device, **weights.settings)
        except ValueError as error:
            raise ValueError(f"{path}: of its metadata, {error}: get the file anew") from error
        matcher.object = weights.object
        return matcher

    @torch.inference_mode()
    def describe(self, images: list[np.ndarray]) -> list[Tensor]:
        """Descriptors (C, h, w) of each of the images (H, W, 3) uint8 of any sizes, the mean over quarter turns.

        C is D, or 2 D where an image is described in both roles: as a source first, then as a target. The grid follows
        the image's own aspect (`fit_input_size`); images of one grid are described at once.
        """
        sizes = [self.compute_input_size(image) for image in images]
        described = {}
        for size in dict.fromkeys(sizes):
            chosen = [index for index, other in enumerate(sizes) if other == size]
            small = [cv2.resize(images[index], size, interpolation=cv2.INTER_AREA) for index in chosen]
            batch = torch.from_numpy(np.stack(small)).to(self.device).permute(0, 3, 1, 2).float() / 255
            described |= zip(chosen, self.describe_inputs(batch), strict=True)
        return [described[index] for index in range(len(images))]

    def compute_input_size(self, image: np.ndarray, name: str = "image") -> tuple[int, int]:
        """(width, height) px that an image (H, W, 3) is given to the network with; ValueError for a narrow strip."""
        size = (image.shape[1], image.shape[0])
        if size[0] * self.size[1] != size[1] * self.size[0]:  # what the model was taught with may be a strip
            check_aspect(size, name)
        # px: where a level is less than 3 cells across, bfloat16's strided convolution on a CPU reads memory at random
        least = 12 * self.network.stride
        return fit_input_size(size, self.size, self.config.input_px, least_px=least)

    def describe_inputs(self, batch: Tensor) -> Tensor:
        """Descriptors (B, C, h, w) of images (B, 3, H, W) in [0, 1] of the network's input size."""
        return sum(self._describe_turned(batch, k) for k in range(self.turns)) / self.turns

    def _describe_turned(self, batch: Tensor, quarters: int) -> Tensor:
        """Descriptors of images seen after so many quarter turns, turned back."""
        turned = batch.rot90(quarters, (2, 3)).contiguous(memory_format=torch.channels_last)
        return self.network(turned).rot90(-quarters, (2, 3))

    @torch.inference_mode()
    def compute_heatmaps(self, descriptors0: Tensor, descriptors1: Tensor, xy: Tensor, size: tuple[int, int]) -> Tensor:
        """Heatmaps (S, h, w) of source px ``xy`` (S, 2) of an image of ``size``, from what `describe` made of each."""
        dim = self.config.descriptor_dim
        source = sample_descriptors(descriptors0[None, :dim], xy[None].to(self.device), size)  # (1, S, D)
        squared = compute_squared_distances(source, descriptors1[-dim:].flatten(1).T[None])[0]  # (S, h * w)
        heatmap = compute_heatmap(squared, bandwidth=self.bandwidth, temperature=self.temperature)
        return heatmap.view(len(xy), *descriptors1.shape[1:])

    @torch.inference_mode()
    def match(self, image0: np.ndarray, image1: np.ndarray, xy: Any, *, n: Any = None) -> Match:
        """All matches in ``image1`` of the pixels ``xy`` (S, 2), or of the one pixel (2,), of ``image0``.

        Images are of any size and each of its own, and of any kind that `mmgsd.images.to_rgb` takes; they are copied.
        ``n`` modes are returned, one number for all or (S,), by default as many as the symmetry group has members;
        "auto" finds their number. The group's number is fitted even where fewer are asked for: of these the most
        probable are the answer, and their weights are divided by their sum. ValueError for other images, for ``xy``
        outside image0, or for ``n`` that is not from 1 to `MAX_MODES`.
        """
        return self.prepare(image0, image1).match(xy, n=n)

    def prepare(self, image0: np.ndarray, image1: np.ndarray) -> Pair:
        """Describe two images once, to ask about them many times; ValueError for other images than `match` takes."""
        images = {name: to_rgb(image, name) for name, image in (("image0", image0), ("image1", image1))}
        for name, image in images.items():
            self.compute_input_size(image, name)
        return Pair(self, *images.values(), tuple(self.describe(list(images.values()))))


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images with their descriptors: each question takes a few milliseconds."""

    matcher: Matcher
    image0: np.ndarray  # (H0, W0, 3) uint8
    image1: np.ndarray  # (H1, W1, 3) uint8
    descriptors: tuple[Tensor, Tensor]  # (C, h0, w0), (C, h1, w1)

    @torch.inference_mode()
    def match(self, xy: Any, *, n: Any = None) -> Match:
        """As `Matcher.match`."""
        size0, size1 = ((im.shape[1], im.shape[0]) for im in (self.image0, self.image1))
        points = check_pixels(xy, size0)
        cells = self.matcher.compute_heatmaps(*self.descriptors, torch.from_numpy(points), size0)
        centres = compute_cell_centres(size1, cells.shape[-2:])
        fitted, roundness = self.matcher.modes, self.matcher.config.roundness
        return make_match(self.image0, self.image1, points, cells, centres, n, fitted=fitted, roundness=roundness)


def load(weights: Path | str, *, device: str = "") -> Matcher:
    """A `Matcher` with the weights of a file, or of a name that ``data/weights`` holds: ``"cloth"``, ``"rope-spcl"``.

    FileNotFoundError where there are none; ValueError for a file that is damaged or not ours.
    """
    if not Path(weights).exists():
        folder = find_root() / "data" / "weights"
        names = sorted(path.stem for path in folder.glob("*.safetensors"))
        if str(weights) not in names:
            raise FileNotFoundError(f"{weights} must be a safetensors file or one of {', '.join(map(repr, names))}")
        weights = folder / f"{weights}.safetensors"
    return Matcher.load(weights, device=device)


def make_match(
    image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, cells: Tensor, centres: tuple[Tensor, Tensor], n: Any, *,
    fitted: int = 1, roundness: float = ROUNDNESS,
) -> Match:  # fmt: skip
    """The answer that heatmaps (S, h, w) with cell ``centres`` (w,), (h,) px hold, however they were made.

    At least ``fitted`` modes are fitted, of which the ``n`` most probable are returned; None: as many.
    """
    wanted = check_count(fitted if n is None else n, "n", queries=len(cells))
    fit, entropy = read_heatmap(cells, "auto" if wanted is None else wanted.clamp(min=fitted), centres,
                                roundness=roundness)  # fmt: skip
    fit = fit if wanted is None else keep_most_probable(fit, wanted)
    arrays = (t.cpu().numpy() for t in (fit.modes, fit.weights, fit.covariances, entropy, fit.outside, cells))
    return Match(image0, image1, xy, *arrays)


def read_heatmap(
    heatmap: Tensor, n: int | str | Tensor, centres: tuple[Tensor, Tensor], *, roundness: float = ROUNDNESS
) -> tuple[Mixture, Tensor]:
    """Mixtures of ``n`` modes and entropies (S,) in nats of heatmaps (S, h, w) with cell ``centres`` (w,), (h,) px."""
    xs, ys = (c.float().to(heatmap.device) for c in centres)
    entropy = compute_entropy(heatmap.flatten(1), float((xs[1] - xs[0]) * (ys[1] - ys[0])))
    return fit_modes(heatmap, n, xs, ys, roundness=roundness), entropy


def _check_size(size: tuple[int, int]) -> None:
    """ValueError unless two whole numbers of px."""
    low, high = SIZES_PX
    whole = isinstance(size, tuple | list) and len(size) == 2 and all(type(side) is int for side in size)
    if not whole or not all(low <= side <= high for side in size):
        raise ValueError(f"size must be (width, height), two whole numbers of {low} to {high} px, got {size!r:.80}")
