"""Whose modes are whose, told by how far apart places lie on the object: of a cloth or a rope, whose shape is known.

A pixel's descriptor says where on the object it lies, up to the symmetry. So of two pixels it is known how far apart
they are on the object, for each member of the symmetry that may take one's place to where the other's is looked for.
Neither cloth nor rope stretches: in an image two places are as far apart as on the object where it is flat between
them, nearer where it is bent or folded, never further. Which member it is two pixels' distance in image0 says, and
that of two modes in image1 likewise; where the modes belong to one map, it is the same one. Each pair of pixels so has
a log-odds for each pair of their modes to be of one map, and all pairs together give modes to maps by graduated
assignment (Gold and Rangarajan, PAMI 1996), a case of permutation synchronisation (Pachauri, Kondor and Singh,
NeurIPS 2013). Distances are by the object's length or side, 1 of it in px being chosen in each image as its distances
are the likeliest.
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

STRETCH, NOISE = 0.1, 0.01  # std of the distance of two places that are flat: by it, and besides
FOLDED, ANYWHERE = 0.25, 0.02  # share of pairs that are nearer, evenly often at each distance; that lie anywhere
REACH, SPREAD = 1.1, 0.4  # by the distance on the object, how far apart at most; std where anywhere
NEAR, RELIABLE = 0.15, 0.15  # on the object: pairs that the length in px is told by; e-fold of a pair's say
LENGTHS = np.geomspace(1.5, 16, 25)  # that are tried, by the root mean square of places from their middle
LENGTH_PAIRS = 400  # at most, that they are tried on
DOUBT = 1e-3  # that a pair's modes are of one map, or of two, at least


def compute_odds(xy: np.ndarray, modes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(S n, S n) log-odds that two modes are of one map rather than of two; 0 of a pixel's own, and of NaN ones.

    Of ``modes`` (S, n, 2) px in image1 of pixels ``xy`` (S, 2) in image0; ``places`` (n, S, 2) are where each member
    takes a pixel's place on the object, the first as it is.
    """
    count, n, _ = modes.shape
    valid = np.isfinite(modes).all(-1)
    values = np.where(valid[..., None], modes, 0.0)
    one, other = np.triu_indices(count, 1)
    between = np.linalg.norm(places[0][one] - places[:, other], axis=-1)  # (n, E) on the object, by the member
    least = between.min(0)
    near = np.flatnonzero(least < NEAR) if (least < NEAR).any() else np.arange(len(one))
    near = near[:: -(-len(near) // LENGTH_PAIRS)]
    between = between[..., None, None]
    likely = []
    for points, apart in (
        (xy, np.linalg.norm(xy[one] - xy[other], axis=-1)[:, None, None]),
        (modes[valid], np.linalg.norm(values[one][:, :, None] - values[other][:, None], axis=-1)),  # (E, n, n)
    ):
        length = _choose_length(apart[near], between[:, near], measure_extent(points))
        density = _compute_density(apart / length, between)
        likely.append(density / density.sum(0))  # (n, E, ...) of each member to be the one between the pair
    same = np.sum(likely[0] * likely[1], 0)  # (E, n, n)
    odds = np.log(same + DOUBT) - np.log((1 - same) / max(n - 1, 1) + DOUBT)
    odds *= np.exp(-least / RELIABLE)[:, None, None] * (valid[one][:, :, None] & valid[other][:, None])
    table = np.zeros((count, n, count, n))
    table[one, :, other], table[other, :, one] = odds, odds.transpose(0, 2, 1)
    return table.reshape(count * n, count * n)


def measure_extent(points: np.ndarray) -> float:
    """Root mean square (px) of points (K, 2) from their middle."""
    return max(float(np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, -1)))), 1e-6)


def _choose_length(apart: np.ndarray, between: np.ndarray, extent: float) -> float:
    """How many px the object is long in an image where pairs are ``apart`` (E, ...) px, the likeliest of `LENGTHS`.

    By the mean over the members, of which each says how far they are ``between`` (n, E, 1, 1) on the object.
    """
    lengths = extent * LENGTHS
    fit = [np.log(_compute_density(apart / length, between).mean(0) / length).mean() for length in lengths]
    return float(lengths[int(np.argmax(fit))])


def _compute_density(apart: np.ndarray, between: np.ndarray) -> np.ndarray:
    """Of the distance in an image of places that are so far apart on the object, both by its length."""
    std = STRETCH * between + NOISE
    flat = np.exp(-0.5 * ((apart - between) / std) ** 2) / (std * np.sqrt(2 * np.pi))
    reach = REACH * between
    folded = expit((reach - apart) / NOISE) / (reach + NOISE)
    anywhere = np.exp(-0.5 * (apart / SPREAD) ** 2) / (SPREAD * np.sqrt(np.pi / 2))
    return (1 - FOLDED - ANYWHERE) * flat + FOLDED * folded + ANYWHERE * anywhere + 1e-12
