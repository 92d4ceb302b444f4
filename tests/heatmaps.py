"""Heatmaps whose modes are known."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mmgsd.match.match import Match
from mmgsd.model.network import compute_cell_centres

SIZE, CELLS = (485, 485), 64
CELL_PX = SIZE[0] / CELLS
XS, YS = compute_cell_centres(SIZE, (CELLS, CELLS))
CORNERS = np.array([[100.3, 100.0], [380.0, 110.9], [375.2, 371.7], [105.5, 383.1]])


def draw_mixture(modes: np.ndarray, std_px: float | np.ndarray, weights: np.ndarray | None = None) -> Tensor:
    """Heatmap (1, 64, 64) of isotropic Gaussians at ``modes`` (N, 2) px."""
    weights = np.ones(len(modes)) if weights is None else weights
    std = np.broadcast_to(std_px, len(modes))
    x, y = XS.numpy()[None, None, :], YS.numpy()[None, :, None]
    squared = (x - modes[:, 0, None, None]) ** 2 + (y - modes[:, 1, None, None]) ** 2
    density = np.exp(-squared / (2 * std[:, None, None] ** 2)) / std[:, None, None] ** 2
    heatmap = (weights[:, None, None] * density).sum(0)
    return torch.from_numpy(heatmap / heatmap.sum())[None].float()


def one_cell(row: int, column: int) -> Tensor:
    heatmap = torch.zeros(1, CELLS, CELLS)
    heatmap[0, row, column] = 1
    return heatmap


def make_match(queries: int = 1, modes: int = 2, *, height: int = 40, width: int = 60) -> Match:
    """An answer about two random images."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (2, height, width, 3), dtype=np.uint8)
    xy = rng.uniform(5, 35, (queries, 2)).astype(np.float32)
    centres = rng.uniform(5, 35, (queries, modes, 2))
    covariances = np.broadcast_to([[9.0, 2.0], [2.0, 4.0]], (queries, modes, 2, 2))
    cells = rng.random((queries, height // 4, width // 4)).astype(np.float32)
    weights = np.full((queries, modes), 1 / modes)
    cells /= cells.sum((1, 2), keepdims=True)
    entropy, outside = np.full(queries, 7.25), np.zeros(queries)
    return Match(*images, xy, centres, weights, covariances, entropy, outside, cells)
