"""A descriptor for every material point itself: dense supervision from each single image.

The pairwise losses start slowly, for both descriptors of a pair are unknown. Here the second image is the object: each
visible point is classified among all material points by the distance to their prototypes, which symmetric points share
(continuous surface embeddings, Neverova et al. 2020). Matching never uses the prototypes.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from mmgsd.model.network import compute_squared_distances

IMAGES = 100  # images that the initial prototypes are computed from
SPREAD = 24.0  # mean squared distance of two initial prototypes: exp(-24) is no match
REACH = 0.12  # of the image's diagonal: points nearer than this in the mean are neighbours


def make_prototypes(xy: np.ndarray, permutations: np.ndarray, dim: int, diagonal: float) -> Tensor:
    """Initial prototypes (P, dim): a kernel PCA of how near the points lie to one another in images.

    ``xy`` (N, P, 2) px, ``permutations`` (G, P), ``diagonal`` of the image in px. Symmetric points get equal rows.
    """
    kernel = np.zeros((xy.shape[1],) * 2)
    for points in xy[np.linspace(0, len(xy) - 1, min(IMAGES, len(xy))).astype(int)].astype(float):
        squared = np.square(points[:, None] - points[None]).sum(-1)
        kernel += np.exp(-squared / (2 * (REACH * diagonal) ** 2))
    kernel = np.mean([kernel[:, g] for g in permutations], axis=0)
    kernel = np.mean([kernel[g] for g in permutations], axis=0)
    kernel -= kernel.mean(0) + kernel.mean(1)[:, None] - kernel.mean()
    values, vectors = np.linalg.eigh((kernel + kernel.T) / 2)
    features = np.zeros((len(kernel), dim))
    kept = min(dim, len(kernel))
    features[:, :kept] = (vectors * np.sqrt(values.clip(min=0)))[:, ::-1][:, :kept]
    features *= np.sqrt(SPREAD / (2 * np.square(features).sum(1).mean() + 1e-12))
    return torch.from_numpy(features.astype(np.float32))


def compute_prototype_loss(descriptors: Tensor, askable: Tensor, prototypes: Tensor, permutations: Tensor) -> Tensor:
    """Cross-entropy of the visible points' descriptors with their own orbit among all material points.

    ``descriptors`` (B, P, D) at the projected points, ``askable`` (B, P) bool, ``prototypes`` (P, D) of which symmetric
    points share the mean, ``permutations`` (G, P).
    """
    if descriptors.shape[1:] != prototypes.shape:
        raise ValueError(f"prototypes must be {tuple(descriptors.shape[1:])}, got {tuple(prototypes.shape)}")
    tied = prototypes[permutations].mean(0)  # (P, D)
    image, point = askable.nonzero(as_tuple=True)
    squared = compute_squared_distances(descriptors[image, point][None], tied[None])[0]  # (n, P)
    log_share = torch.log_softmax(-squared, -1)
    own = permutations[:, point].T  # (n, G)
    distinct = torch.stack([(own[:, : i + 1] == own[:, i, None]).sum(1) == 1 for i in range(own.shape[1])], 1)
    log_own = log_share.gather(1, own).masked_fill(~distinct, -torch.inf).logsumexp(1)  # a fixed point counts once
    return -log_own.sum() / max(1, len(point))
