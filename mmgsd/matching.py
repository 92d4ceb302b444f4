"""From descriptors to heatmaps, their modes and entropy; the public ``Matcher`` and its answer, the ``Match``."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mmgsd.config import CONTRASTIVE, ROUNDNESS, TrainConfig, find_root, from_dict
from mmgsd.losses import compute_squared_distances
from mmgsd.mixture import Mixture, fit_modes
from mmgsd.network import (
    build_network,
    compute_cell_centres,
    compute_input_size,
    find_device,
    sample_descriptors,
)

QUARTERS = 4  # turns of an image whose descriptors are averaged: what noise they have differs
RADIUS_PX = 20.0  # within which a robot's grasp still holds, unless the caller says otherwise


def compute_heatmap(squared_distances: Tensor, *, bandwidth: float | None = None, temperature: float = 1.0) -> Tensor:
    """Distributions over cells (..., C) from squared descriptor distances (..., C).

    softmax(-d²) as in training (paper section "Symmetric Distributional Loss"); or, for descriptors of a contrastive
    loss, which have no scale of their own, a Gaussian of ``bandwidth`` in the descriptor norm differences, normalised.
    Either is raised to the power 1 / ``temperature``.
    """
    scale = 1.0 if bandwidth is None else 1 / (2 * bandwidth**2)
    return torch.softmax(-scale / temperature * squared_distances, -1)


def compute_entropy(heatmap: Tensor, cell_area: float) -> Tensor:
    """Differential entropy in nats of the density over px: (S, C) to (S,); ln of the area it spreads over."""
    return torch.special.entr(heatmap).sum(-1) + float(np.log(cell_area))


@dataclass(frozen=True)
class Best:
    """The one mode of each of S queries to act on; NaN where the answer is not sure enough."""

    xy: np.ndarray  # (S, 2) px in image1
    spread_px: np.ndarray  # (S,) std of the mode, root mean square over directions
    confidence: np.ndarray  # (S,) in [0, 1]


@dataclass(frozen=True)
class Match:
    """The answer to S queries; pixels are those of the caller's images."""

    image0: np.ndarray  # (H0, W0, 3) uint8
    image1: np.ndarray  # (H1, W1, 3) uint8
    xy: np.ndarray  # (S, 2) px in image0
    modes: np.ndarray  # (S, n, 2) px in image1, most probable first
    weights: np.ndarray  # (S, n), sum to 1
    covariances: np.ndarray  # (S, n, 2, 2) px²
    entropy: np.ndarray  # (S,) nats, of the density over px
    outside: np.ndarray  # (S,) heatmap mass outside every mode's 95 % ellipse, in [0, 1]
    cells: np.ndarray  # (S, h, w) heatmap on the descriptors' grid, sums to 1

    @cached_property
    def heatmap(self) -> np.ndarray:
        """(S, H1, W1) float32, the heatmap over image1's pixels; sums to 1."""
        size = (self.image1.shape[1], self.image1.shape[0])
        full = np.empty((len(self.cells), *self.image1.shape[:2]), np.float32)
        for cells, pixels in zip(self.cells, full, strict=True):
            cv2.resize(cells, size, dst=pixels, interpolation=cv2.INTER_LINEAR)
        return full / full.sum((1, 2), keepdims=True)

    @property
    def spread_px(self) -> np.ndarray:
        """(S, n) std of each mode, root mean square over directions; NaN for absent modes."""
        return np.sqrt(np.trace(self.covariances, axis1=-2, axis2=-1) / 2)

    def confidence(self, *, radius_px: float = RADIUS_PX) -> np.ndarray:
        """(S, n) in [0, 1], probability that a true match lies within ``radius_px`` of each mode.

        That of a round Gaussian as wide as the mode, less what the mode's weight lacks of an equal share.
        """
        if not radius_px > 0:
            raise ValueError(f"radius_px must be greater than 0 px, got {radius_px!r}")
        present = (self.weights > 0).sum(1, keepdims=True)
        near = -np.expm1(-0.5 * np.square(radius_px / self.spread_px))
        return np.minimum(1, present * self.weights) * np.nan_to_num(near)

    def best(self, *, min_confidence: float = 0.0, radius_px: float = RADIUS_PX) -> Best:
        """The mode with the least spread of each query: which of the like places to grasp (paper introduction).

        Abstains, with NaN for ``xy``, where a true match lies within ``radius_px`` with less than ``min_confidence``.
        """
        if not 0 <= min_confidence <= 1:
            raise ValueError(f"min_confidence must be in [0, 1], got {min_confidence!r}")
        rows = np.arange(len(self.modes))
        chosen = np.nan_to_num(self.spread_px, nan=np.inf).argmin(1)
        confidence = self.confidence(radius_px=radius_px)[rows, chosen]
        xy = np.where((confidence >= min_confidence)[:, None], self.modes[rows, chosen], np.nan)
        return Best(xy, self.spread_px[rows, chosen], confidence)

    def __getitem__(self, index: int) -> Match:
        """The answer to one query alone."""
        names = ("xy", "modes", "weights", "covariances", "entropy", "outside", "cells")
        return dataclasses.replace(self, **{name: getattr(self, name)[index][None] for name in names})

    def plot(self, index: int = 0):  # noqa: ANN201 (matplotlib is imported only where a plot is asked for)
        """Figure of source pixel, heatmap and modes with their 1-std ellipses, for one query."""
        from mmgsd.plots import plot_match

        return plot_match(self, index)


class Matcher:
    """Finds all matches of pixels between two images of an object, with trained weights."""

    def __init__(
        self, network: torch.nn.Module, config: TrainConfig, *, modes: int, size: tuple[int, int], device: str = "",
        bandwidth: float | None = None, temperature: float = 1.0,
    ) -> None:  # fmt: skip
        self.device = torch.device(device or find_device())
        self.network = network.eval().to(self.device, memory_format=torch.channels_last)
        self.config, self.modes, self.size = config, modes, size
        self.temperature = temperature
        self.turns = QUARTERS if config.rotate else 1  # what was trained upright knows only upright images
        self.bandwidth = config.margin / 4 if bandwidth is None and config.method in CONTRASTIVE else bandwidth

    @classmethod
    def load(cls, path: Path | str, *, device: str = "") -> Matcher:
        """Weights from a safetensors file; FileNotFoundError, or ValueError for one that is damaged or not ours."""
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path} does not exist: train a model, or give the path of its weights")
        try:
            with safe_open(path, "pt") as file:
                metadata = file.metadata() or {}
                state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError) as error:
            raise ValueError(f"{path} is truncated or no safetensors file: {error}") from error
        if metadata.get("format") != "mmgsd-1":
            raise ValueError(f"{path} holds no mmgsd weights: its metadata says format {metadata.get('format')!r}")
        config = from_dict(TrainConfig, json.loads(metadata["config"]))
        network = build_network(
            config.network, config.descriptor_dim, roles=config.roles, heads=config.heads, pretrained=False
        )
        try:
            network.load_state_dict({name: value.float() for name, value in state.items()})
        except RuntimeError as error:
            raise ValueError(f"{path} does not fit the network {config.network!r}: {error}") from error
        size = tuple(json.loads(metadata["size"]))
        scales = {name: float(metadata[name]) for name in ("bandwidth", "temperature") if name in metadata}
        return cls(network, config, modes=int(metadata["modes"]), size=size, device=device, **scales)

    @torch.inference_mode()
    def describe(self, images: list[np.ndarray]) -> Tensor:
        """Descriptors (B, C, h, w) of B images (H, W, 3) uint8 of any sizes, the mean over quarter turns.

        C is D, or 2 D where an image is described in both roles: as a source first, then as a target.
        """
        size = compute_input_size(self.size, self.config.input_px)
        small = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])
        batch = torch.from_numpy(small).to(self.device).permute(0, 3, 1, 2).float() / 255
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
    def match(
        self, image0: np.ndarray, image1: np.ndarray, xy: np.ndarray | list, *, n: int | str | None = None
    ) -> Match:
        """All matches in ``image1`` of the pixels ``xy`` (S, 2) of ``image0``.

        Images are (H, W, 3), (H, W, 4) or (H, W), uint8 or float in [0, 1]. ``n`` modes are fitted, by default as many
        as the symmetry group has members; "auto" finds their number. ValueError for other images, or for ``xy``
        outside image0.
        """
        return self.prepare(image0, image1).match(xy, n=n)

    def prepare(self, image0: np.ndarray, image1: np.ndarray) -> Pair:
        """Describe two images once, to ask about them many times; ValueError for other images than `match` takes."""
        image0, image1 = to_rgb(image0, "image0"), to_rgb(image1, "image1")
        return Pair(self, image0, image1, self.describe([image0, image1]))


@dataclass(frozen=True)
class Pair:
    """Two images with their descriptors: each question takes a few milliseconds."""

    matcher: Matcher
    image0: np.ndarray  # (H0, W0, 3) uint8
    image1: np.ndarray  # (H1, W1, 3) uint8
    descriptors: Tensor  # (2, C, h, w)

    @torch.inference_mode()
    def match(self, xy: np.ndarray | list, *, n: int | str | None = None) -> Match:
        """As `Matcher.match`."""
        size0, size1 = ((im.shape[1], im.shape[0]) for im in (self.image0, self.image1))
        points = check_pixels(xy, size0)
        cells = self.matcher.compute_heatmaps(*self.descriptors, torch.from_numpy(points), size0)
        centres = compute_cell_centres(size1, cells.shape[-2:])
        n, roundness = self.matcher.modes if n is None else n, self.matcher.config.roundness
        return make_match(self.image0, self.image1, points, cells, centres, n, roundness=roundness)


def load(weights: Path | str, *, device: str = "") -> Matcher:
    """A `Matcher` with the weights of a file, or of a name that ``data/weights`` holds: ``"cloth"``, ``"rope-spcl"``.

    FileNotFoundError where there are none; ValueError for a file that is damaged or not ours.
    """
    if not Path(weights).is_file():
        folder = find_root() / "data" / "weights"
        names = sorted(path.stem for path in folder.glob("*.safetensors"))
        if str(weights) not in names:
            raise FileNotFoundError(f"{weights} must be a safetensors file or one of {', '.join(map(repr, names))}")
        weights = folder / f"{weights}.safetensors"
    return Matcher.load(weights, device=device)


def make_match(
    image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, cells: Tensor, centres: tuple[Tensor, Tensor], n: int | str,
    *, roundness: float = ROUNDNESS,
) -> Match:  # fmt: skip
    """The answer that heatmaps (S, h, w) with cell ``centres`` (w,), (h,) px hold, however they were made."""
    fit, entropy = read_heatmap(cells, n, centres, roundness=roundness)
    arrays = (t.cpu().numpy() for t in (fit.modes, fit.weights, fit.covariances, entropy, fit.outside, cells))
    return Match(image0, image1, xy, *arrays)


def read_heatmap(
    heatmap: Tensor, n: int | str | Tensor, centres: tuple[Tensor, Tensor], *, roundness: float = ROUNDNESS
) -> tuple[Mixture, Tensor]:
    """Mixtures of ``n`` modes and entropies (S,) in nats of heatmaps (S, h, w) with cell ``centres`` (w,), (h,) px."""
    xs, ys = (c.float().to(heatmap.device) for c in centres)
    entropy = compute_entropy(heatmap.flatten(1), float((xs[1] - xs[0]) * (ys[1] - ys[0])))
    return fit_modes(heatmap, n, xs, ys, roundness=roundness), entropy


def check_question(
    image0: np.ndarray, image1: np.ndarray, xy: np.ndarray | list
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both images as (H, W, 3) uint8 and the pixels as (S, 2) float32; ValueError names the argument that is wrong."""
    image0, image1 = to_rgb(image0, "image0"), to_rgb(image1, "image1")
    return image0, image1, check_pixels(xy, (image0.shape[1], image0.shape[0]))


def read_image(path: Path | str) -> np.ndarray:
    """(H, W, 3) uint8 of an image file, upright as its camera noted; ValueError for a file that is no image."""
    try:
        with Image.open(path) as image:
            return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    except UnidentifiedImageError as error:
        raise ValueError(f"{path} is no image that can be read") from error


def to_rgb(image: np.ndarray, name: str = "image") -> np.ndarray:
    """(H, W, 3) uint8 from grey, RGB or RGBA, uint8 or float in [0, 1]; ValueError names the argument otherwise."""
    image = np.asarray(image)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise ValueError(f"{name} must be (H, W), (H, W, 3) or (H, W, 4), got shape {image.shape}")
    if np.issubdtype(image.dtype, np.floating):
        if not np.isfinite(image).all() or image.min() < 0 or image.max() > 1:
            raise ValueError(f"{name} of dtype {image.dtype} must lie in [0, 1], got {image.min()} to {image.max()}")
        image = np.rint(image * 255).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ValueError(f"{name} must be uint8 or float, got {image.dtype}")
    return np.ascontiguousarray(image[..., :3])


def check_pixels(xy: np.ndarray | list, size: tuple[int, int]) -> np.ndarray:
    """Pixels (S, 2) float32 inside image0 of ``size`` (width, height); ValueError otherwise."""
    points = np.asarray(xy, dtype=np.float32).reshape(-1, 2) if np.size(xy) == 0 else np.asarray(xy, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"xy must be (S, 2) px, got shape {points.shape}")
    inside = np.isfinite(points).all(1) & (points >= -0.5).all(1) & (points <= np.array(size) - 0.5).all(1)
    if not inside.all():
        bad = points[~inside][0]
        raise ValueError(f"xy must be finite and inside image0 of {size[0]} x {size[1]} px, got {tuple(bad.tolist())}")
    return points
