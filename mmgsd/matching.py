"""From descriptors to heatmaps, modes with weights and covariances, and entropy; the public ``Matcher``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional as F

from mmgsd.config import TrainConfig, from_dict
from mmgsd.losses import CONTRASTIVE, compute_squared_distances
from mmgsd.network import (
    build_network,
    compute_cell_centres,
    compute_input_size,
    find_device,
    sample_descriptors,
)

CELLS = 256  # the strongest cells of a heatmap, which the mixture is fitted to
ITERATIONS = 15  # of expectation-maximisation
KERNEL_CELLS = 3.0  # std of the kernel that finds the initial peaks, in cells
PRIOR_MASS = 0.05  # mass that each component holds a priori: symmetric modes are equally likely
MIN_STD_CELLS = 0.4  # a component is never narrower: half a cell's own extent


@dataclass(frozen=True)
class Mixture:
    """n-modal Gaussian fits of S heatmaps, most probable mode first; absent modes have weight 0 and NaN elsewhere."""

    modes: Tensor  # (S, N, 2) px
    weights: Tensor  # (S, N), sum to 1
    covariances: Tensor  # (S, N, 2, 2) px²


def compute_heatmap(squared_distances: Tensor, *, bandwidth: float | None = None) -> Tensor:
    """Distributions over cells (..., C) from squared descriptor distances (..., C).

    softmax(-d²) as in training (paper section "Symmetric Distributional Loss"); or, for descriptors of a contrastive
    loss, which have no scale of their own, a Gaussian of ``bandwidth`` in the descriptor norm differences, normalised.
    """
    scale = 1.0 if bandwidth is None else 1 / (2 * bandwidth**2)
    return torch.softmax(-scale * squared_distances, -1)


def compute_entropy(heatmap: Tensor, cell_area: float) -> Tensor:
    """Differential entropy in nats of the density over px: (S, C) to (S,); ln of the area it spreads over."""
    return torch.special.entr(heatmap).sum(-1) + float(np.log(cell_area))


def fit_modes(heatmap: Tensor, n: int | Tensor, xs: Tensor, ys: Tensor, *, iterations: int = ITERATIONS) -> Mixture:
    """Fit an n-modal Gaussian mixture to each heatmap by weighted expectation-maximisation.

    ``heatmap`` (S, h, w) not negative, ``n`` modes for all or (S,), ``xs`` (w,) and ``ys`` (h,) cell centres in px.
    Starts from separated peaks that each account for 1 / n of the mass. ValueError for other shapes or n < 1.
    """
    if heatmap.ndim != 3 or heatmap.shape[1:] != (len(ys), len(xs)):
        raise ValueError(f"heatmap must have shape (S, {len(ys)}, {len(xs)}), got {tuple(heatmap.shape)}")
    n = torch.as_tensor(n, device=heatmap.device)
    if n.ndim and n.shape != heatmap.shape[:1]:
        raise ValueError(f"n must be one number or of shape ({len(heatmap)},), got shape {tuple(n.shape)}")
    if n.numel() and int(n.min()) < 1:
        raise ValueError(f"n must be at least 1, got {int(n.min())}")
    n_max = int(n.max()) if n.numel() else 1
    n, heatmap = n.expand(len(heatmap)), heatmap.float()
    step = torch.stack([xs[1] - xs[0], ys[1] - ys[0]])  # px a cell
    total = heatmap.flatten(1).sum(-1, keepdim=True)
    uniform = torch.full_like(heatmap.flatten(1), 1 / heatmap[0].numel()) if len(n) else heatmap.flatten(1)
    mass = torch.where(total > 0, heatmap.flatten(1) / total.clamp(min=1e-30), uniform)
    present = torch.arange(n_max, device=n.device) < n[:, None]  # (S, N)
    start = _find_peaks(mass.view_as(heatmap), n, n_max)  # (S, N, 2) cells
    # in units of cells all through, so that one regularisation suits every image size
    mass, cell = mass.topk(min(CELLS, mass.shape[1]), dim=-1)
    mass = mass / mass.sum(-1, keepdim=True)
    position = torch.stack([cell % len(xs), cell // len(xs)], -1).float()  # (S, C, 2)
    means, weights, covariances = _run_em(mass, position, start, present, iterations)
    order = weights.argsort(-1, descending=True)
    means = means.gather(1, order[..., None].expand_as(means))
    covariances = covariances.gather(1, order[..., None, None].expand_as(covariances))
    absent = ~present.gather(1, order)
    modes = (means * step + torch.stack([xs[0], ys[0]])).masked_fill(absent[..., None], torch.nan)
    covariances = (covariances * step[:, None] * step).masked_fill(absent[..., None, None], torch.nan)
    return Mixture(modes, weights.gather(1, order), covariances)


def _find_peaks(mass: Tensor, n: Tensor, n_max: int) -> Tensor:
    """Cells (S, N, 2) of peaks found one after another, each taking up to 1 / n of the mass around it away."""
    size = len(mass), *mass.shape[1:]
    reach = torch.arange(-int(3 * KERNEL_CELLS), int(3 * KERNEL_CELLS) + 1, device=mass.device)
    kernel = torch.exp(-0.5 * (reach / KERNEL_CELLS) ** 2)
    rows, columns = (torch.arange(k, device=mass.device) for k in size[1:])
    peaks, rest = [], mass
    for _ in range(n_max):
        local = F.conv2d(rest[:, None], kernel.view(1, 1, 1, -1), padding=(0, len(reach) // 2))
        local = F.conv2d(local, kernel.view(1, 1, -1, 1), padding=(len(reach) // 2, 0))[:, 0]
        # the blurred mass finds the region, the mass itself the peak inside it
        share, index = (local * (rest + 1e-3 * local)).flatten(1).max(-1)
        share = local.flatten(1).gather(1, index[:, None])
        row, column = index // size[2], index % size[2]
        near = torch.exp(-0.5 * ((rows - row[:, None]) / KERNEL_CELLS) ** 2)[:, :, None] * torch.exp(
            -0.5 * ((columns - column[:, None]) / KERNEL_CELLS) ** 2
        ).unsqueeze(1)
        taken = (1 / (n[:, None] * share.clamp(min=1e-12))).clamp(max=1)  # (S, 1)
        rest = rest * (1 - taken[..., None] * near)
        peaks.append(torch.stack([column, row], -1))
    return torch.stack(peaks, 1).float()


def _run_em(
    mass: Tensor, position: Tensor, means: Tensor, present: Tensor, iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """EM on (S, C) mass at (S, C, 2) positions; returns means (S, N, 2), weights (S, N), covariances (S, N, 2, 2)."""
    floor = MIN_STD_CELLS**2
    weights = present / present.sum(-1, keepdim=True)
    a = c = torch.full_like(weights, KERNEL_CELLS**2)  # covariance [[a, b], [b, c]]
    b = torch.zeros_like(a)
    x, y = position[..., 0, None], position[..., 1, None]  # (S, C, 1)
    for _ in range(iterations):
        dx, dy = x - means[:, None, :, 0], y - means[:, None, :, 1]  # (S, C, N)
        determinant = a * c - b * b
        log_scale = weights.clamp(min=1e-12).log() - 0.5 * determinant.log()
        quadratic = (c / determinant)[:, None] * dx * dx + (a / determinant)[:, None] * dy * dy
        quadratic = quadratic - 2 * (b / determinant)[:, None] * dx * dy
        score = (log_scale[:, None] - 0.5 * quadratic).masked_fill(~present[:, None], -torch.inf)
        share = torch.softmax(score, -1) * mass[..., None]  # (S, C, N)
        count = share.sum(1)  # (S, N)
        safe = count.clamp(min=1e-9)
        update = torch.stack([(share * x).sum(1), (share * y).sum(1)], -1) / safe[..., None]
        means = torch.where(count[..., None] > 1e-9, update, means)
        dx, dy = x - means[:, None, :, 0], y - means[:, None, :, 1]
        a = (share * dx * dx).sum(1) / safe + floor
        c = (share * dy * dy).sum(1) / safe + floor
        b = (share * dx * dy).sum(1) / safe
        weights = (count + PRIOR_MASS) * present
        weights = weights / weights.sum(-1, keepdim=True)
    covariances = torch.stack([torch.stack([a, b], -1), torch.stack([b, c], -1)], -2)
    return means, weights, covariances


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
    cells: np.ndarray  # (S, h, w) heatmap on the descriptors' grid, sums to 1

    @cached_property
    def heatmap(self) -> np.ndarray:
        """(S, H1, W1) float32, the heatmap over image1's pixels; sums to 1."""
        size = (self.image1.shape[1], self.image1.shape[0])
        full = np.empty((len(self.cells), *self.image1.shape[:2]), np.float32)
        for cells, pixels in zip(self.cells, full, strict=True):
            cv2.resize(cells, size, dst=pixels, interpolation=cv2.INTER_LINEAR)
        return full / full.sum((1, 2), keepdims=True)

    def plot(self, index: int = 0):  # noqa: ANN201 (matplotlib is imported only where a plot is asked for)
        """Figure of source pixel, heatmap and modes with their 1-std ellipses, for one query."""
        from mmgsd.plots import plot_match

        return plot_match(self, index)


class Matcher:
    """Finds all matches of pixels between two images of an object, with trained weights."""

    def __init__(
        self, network: torch.nn.Module, config: TrainConfig, *, modes: int, size: tuple[int, int], device: str = "",
        bandwidth: float | None = None,
    ) -> None:  # fmt: skip
        self.device = torch.device(device or find_device())
        self.network = network.eval().to(self.device, memory_format=torch.channels_last)
        self.config, self.modes, self.size = config, modes, size
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
        network = build_network(config.network, config.descriptor_dim, pretrained=False)
        try:
            network.load_state_dict({name: value.float() for name, value in state.items()})
        except RuntimeError as error:
            raise ValueError(f"{path} does not fit the network {config.network!r}: {error}") from error
        size = tuple(json.loads(metadata["size"]))
        bandwidth = float(metadata["bandwidth"]) if "bandwidth" in metadata else None
        return cls(network, config, modes=int(metadata["modes"]), size=size, device=device, bandwidth=bandwidth)

    @torch.inference_mode()
    def describe(self, images: list[np.ndarray]) -> Tensor:
        """Descriptors (B, D, h, w) of B images (H, W, 3) uint8 of any sizes."""
        size = compute_input_size(self.size, self.config.input_px)
        small = np.stack([cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images])
        batch = torch.from_numpy(small).to(self.device).permute(0, 3, 1, 2).float() / 255
        return self.network(batch.contiguous(memory_format=torch.channels_last))

    @torch.inference_mode()
    def compute_heatmaps(self, descriptors0: Tensor, descriptors1: Tensor, xy: Tensor, size: tuple[int, int]) -> Tensor:
        """Heatmaps (S, h, w) of source px ``xy`` (S, 2) of an image of ``size``, from (D, h, w) descriptors."""
        source = sample_descriptors(descriptors0[None], xy[None].to(self.device), size)  # (1, S, D)
        squared = compute_squared_distances(source, descriptors1.flatten(1).T[None])[0]  # (S, C)
        return compute_heatmap(squared, bandwidth=self.bandwidth).view(len(xy), *descriptors1.shape[1:])

    @torch.inference_mode()
    def match(self, image0: np.ndarray, image1: np.ndarray, xy: np.ndarray | list, *, n: int | None = None) -> Match:
        """All matches in ``image1`` of the pixels ``xy`` (S, 2) of ``image0``.

        Images are (H, W, 3), (H, W, 4) or (H, W), uint8 or float in [0, 1]. ``n`` modes are fitted, by default as many
        as the symmetry group has members. ValueError for other images, or for ``xy`` outside image0.
        """
        image0, image1 = to_rgb(image0, "image0"), to_rgb(image1, "image1")
        size0, size1 = ((im.shape[1], im.shape[0]) for im in (image0, image1))
        points = _check_xy(xy, size0)
        descriptors = self.describe([image0, image1])
        cells = self.compute_heatmaps(descriptors[0], descriptors[1], torch.from_numpy(points), size0)
        xs, ys = (c.to(self.device) for c in compute_cell_centres(size1, cells.shape[-2:]))
        fit = fit_modes(cells, self.modes if n is None else n, xs, ys)
        entropy = compute_entropy(cells.flatten(1), float((xs[1] - xs[0]) * (ys[1] - ys[0])))
        arrays = (t.cpu().numpy() for t in (fit.modes, fit.weights, fit.covariances, entropy, cells))
        return Match(image0, image1, points, *arrays)


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


def _check_xy(xy: np.ndarray | list, size: tuple[int, int]) -> np.ndarray:
    points = np.asarray(xy, dtype=np.float32).reshape(-1, 2) if np.size(xy) == 0 else np.asarray(xy, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"xy must be (S, 2) px, got shape {points.shape}")
    inside = np.isfinite(points).all(1) & (points >= -0.5).all(1) & (points <= np.array(size) - 0.5).all(1)
    if not inside.all():
        bad = points[~inside][0]
        raise ValueError(f"xy must be finite and inside image0 of {size[0]} x {size[1]} px, got {tuple(bad.tolist())}")
    return points
