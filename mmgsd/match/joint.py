"""One answer for a whole question: which of the modes of several pixels belong to the same member of the symmetry.

Each pixel has as many matches as the symmetry has members, in an order that no other pixel shares. Over the whole
object they are n maps from image0 to image1, one a member, and a place's modes are their values, shuffled. `join`
sorts them, together with those of places spread over the object in image0. Of a cloth or a rope by how far apart places
lie on it (`mmgsd.match.isometry`). Of other objects, and by weights that do not know their places, by how smooth maps
are: places are nodes of a graph of what lies side by side; each map is a Gaussian process on that graph (Borovitskiy et
al., "Matérn Gaussian processes on graphs", AISTATS 2021); and modes are given to maps, one to each, as overlapping
mixtures of Gaussian processes are fitted (Lázaro-Gredilla, Van Vaerenbergh and Lawrence, Pattern Recognition 2012):
from one place where they lie clear of each other to its neighbours, and so on. A place whose modes fit several maps
alike says little to others. A map takes no two places far apart to one: that tells which end of a rope is which, as
smoothness hardly does where both maps cross in its middle.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, shortest_path
from scipy.spatial import cKDTree

from mmgsd.match.isometry import compute_odds, measure_extent

PLACES = 64  # spread over the object besides those that are asked about
QUESTIONS = 128  # that are sorted at a time
CANDIDATES = 6000  # pixels that they are chosen from
NEIGHBOURS = 6  # that a place is joined to, where the object lies between
BETWEEN = 0.75  # share of the line between two neighbours that the object covers
RANGE, SMOOTHNESS = 3.0, 3.0  # of the Matérn kernel: length by the object's extent, and ν
STRETCH = 2.0  # of squared distances from image0 to image1, each by its object's extent, a priori
NOISE = 0.05  # std of a mode besides its spread, by the object's extent
REPULSION = 12.0  # log-odds against a mode that the map has given to places far from this one alone
FAR, STEP = 0.35, 0.05  # by the object's extent: where places begin to be far apart, and how gradually
NEAR = 0.1  # by the object's extent: std of what counts as one place of image1
ROUNDS = 15  # of maps from assigned modes and modes assigned by maps
STARTS, APART = 4, 5  # places from which assigning starts, each the fifth clearest; the most likely outcome counts
VOTES, CERTAIN = 10, 50.0  # rounds of graduated assignment; log-odds that a start keeps its modes
BALANCE = 20  # normalisations of rows and columns in a round
UNKNOWN = 1e4  # variance of what a place says that is not sure at all, by the squared extent


def spread_places(mask: np.ndarray, count: int = PLACES) -> np.ndarray:
    """Pixels (at most ``count``, 2) of a mask (H, W) bool, far from each other, the same ones each time."""
    pixels = np.argwhere(mask)[:, ::-1].astype(float)
    step = max(1, len(pixels) // CANDIDATES)
    pixels = pixels[step // 2 :: step]
    if not len(pixels):
        return pixels.reshape(0, 2)
    chosen = [int(np.linalg.norm(pixels - pixels.mean(0), axis=1).argmin())]
    nearest = np.full(len(pixels), np.inf)
    while len(chosen) < min(count, len(pixels)):
        nearest = np.minimum(nearest, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
        chosen.append(int(nearest.argmax()))
    return pixels[chosen]


def join(
    xy: np.ndarray, mask: np.ndarray, modes: np.ndarray, weights: np.ndarray, spread: np.ndarray, *, places: int,
    located: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Sort the modes (S, n, 2) px of pixels ``xy`` (S, 2), which have ``weights`` and ``spread`` (S, n) px.

    The last ``places`` of the pixels are those of `spread_places`: `QUESTIONS` of the others are sorted at a time,
    together with all of these. ``mask`` (H, W) bool says where image0 shows the object. NaN modes fit anywhere.
    ``located`` (n, S, 2) are where each member takes each pixel's place on the object laid flat (`mmgsd.match.places`);
    then modes are sorted by distances instead of by the graph (`mmgsd.match.isometry`). Returns
    which mode of each pixel is whose, (S, n), a permutation a pixel; the map comes first whose modes weigh most at the
    places. Where nothing can be told, of one mode or fewer than three pixels, modes keep their order.
    """
    count = len(xy) - places
    chunks = [np.arange(first, min(first + QUESTIONS, count)) for first in range(0, max(count, 1), QUESTIONS)]
    last, orders, common = np.arange(count, len(xy)), [], None
    for rows in (np.concatenate([part, last]) for part in chunks):
        order = _join(*(values[rows] for values in (xy, modes, weights, spread)), mask,
                      None if located is None else located[:, rows])  # fmt: skip
        if common is None:
            heavy = np.take_along_axis(weights[rows], order, 1)[-places:].sum(0)  # of all, where there are no places
            order = order[:, np.argsort(-heavy, kind="stable")]
            common = order[len(rows) - places :]
        elif places:
            same = np.mean(order[len(rows) - places :, :, None] == common[:, None], 0)  # (n, n), share of the places
            order = order[:, _round(same[None])[0]]
        orders.append(order[: len(rows) - places])
    return np.concatenate([*orders, common])


def _join(
    xy: np.ndarray, modes: np.ndarray, weights: np.ndarray, spread: np.ndarray, mask: np.ndarray,
    located: np.ndarray | None,
) -> np.ndarray:  # fmt: skip
    """The order (S, n) that is the most likely of the outcomes that start at several pixels."""
    count, n = weights.shape
    valid = np.isfinite(modes).all(-1)
    if n < 2 or count < 3 or not valid.all(1).any():
        return np.tile(np.arange(n), (count, 1))
    values, variance, _, _ = _scale(modes, spread)
    log_weights = np.log(np.clip(np.nan_to_num(weights), 1e-3, None))
    if located is None:
        edges, length = _measure_edges(xy, mask)
        kernel = _make_kernel(edges, length, count)
        ways = shortest_path(coo_matrix((length, edges.T), shape=(count, count)), directed=False)  # by the extent
        assign = partial(_assign, kernel, _find_rivals(ways, values, valid), values, variance, log_weights)
    else:
        assign = partial(_assign_by_odds, compute_odds(xy, modes, located), log_weights)
    outcomes = [assign(start) for start in _choose_starts(values, variance, valid)]
    return max(outcomes, key=lambda outcome: outcome[1])[0]


def predict(xy: np.ndarray, mask: np.ndarray, modes: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Where the maps through sorted modes (S, n, 2) px take each pixel of ``xy``, by what all the others say.

    Arguments are as `join` has them, modes in the order that it returns.
    """
    values, variance, middle, extent = _scale(modes, spread)
    noise = np.where(np.isfinite(modes).all(-1), variance, UNKNOWN)
    return _predict(_make_kernel(*_measure_edges(xy, mask), len(xy)), values, noise)[0] * extent + middle


def _scale(modes: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Modes from their middle, and variances, both by the object's extent; that middle and extent (px)."""
    valid = np.isfinite(modes).all(-1)
    middle = modes[valid].mean(0)
    extent = measure_extent(modes[valid])
    values = np.where(valid[..., None], (modes - middle) / extent, 0.0)
    return values, np.where(valid, (np.nan_to_num(spread) / extent) ** 2 + NOISE**2, 4.0), middle, extent


def _measure_edges(xy: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (E, 2) of near places, and how far apart they lie, by the object's extent."""
    edges = _list_edges(xy, mask)
    length = np.linalg.norm(xy[edges[:, 0]] - xy[edges[:, 1]], axis=1)
    return edges, np.maximum(length, 1e-6) / measure_extent(xy)


def _make_kernel(edges: np.ndarray, length: np.ndarray, count: int) -> np.ndarray:
    """(S, S) covariance of a map's values: Matérn's, with steps as long as those of places, and a constant.

    Of ``count`` places, of which ``edges`` (E, 2) of some ``length`` (E,), by the object's extent, join neighbours.
    """
    unit = float(np.median(length))
    near = coo_matrix((1 / np.maximum(length / unit, 0.25) ** 2, edges.T), shape=(count, count)).toarray()
    near += near.T
    values, vectors = np.linalg.eigh(np.diag(near.sum(0)) - near)
    spectrum = (2 * SMOOTHNESS * (unit / RANGE) ** 2 + np.maximum(values, 0)) ** -SMOOTHNESS
    kernel = (vectors * spectrum) @ vectors.T
    (first, second), own = edges.T, np.diag(kernel)
    step = np.mean(own[first] + own[second] - 2 * kernel[first, second])
    return kernel * (STRETCH * np.mean(length**2) / 2 / step) + 1.0


def _list_edges(xy: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Pairs (E, 2) of near places with the object between them; all places hang together."""
    index = cKDTree(xy).query(xy, k=min(NEIGHBOURS + 1, len(xy)))[1]
    edges = np.stack([np.repeat(np.arange(len(xy)), index.shape[1]), index.ravel()], 1)
    edges = np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], 1), axis=0)
    share = np.linspace(0.2, 0.8, 4)[:, None, None]
    points = np.rint(xy[edges[:, 0]] * (1 - share) + xy[edges[:, 1]] * share).astype(int)  # (4, E, 2)
    column, row = (np.clip(points[..., k], 0, mask.shape[1 - k] - 1) for k in (0, 1))
    return _connect(edges[mask[row, column].mean(0) >= BETWEEN], xy)


def _connect(edges: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Edges, and one more to each part of the graph that hangs by none, where it is nearest to the others."""
    while True:
        graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(xy), len(xy)))
        count, part = connected_components(graph, directed=False)
        if count == 1:
            return edges
        inside, others = np.flatnonzero(part == part[0]), np.flatnonzero(part != part[0])
        distance, nearest = cKDTree(xy[inside]).query(xy[others])
        k = int(distance.argmin())
        edges = np.vstack([edges, np.sort([inside[nearest[k]], others[k]])])


def _find_rivals(ways: np.ndarray, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """(S n, S n): how much a mode lies where those of far places do; rows sum to less than 1."""
    n, flat = values.shape[1], values.reshape(-1, 2)
    far = 1 / (1 + np.exp(np.clip((FAR - ways) / STEP, -50, 50)))
    gap = np.linalg.norm(flat[:, None] - flat, axis=-1)
    close = np.exp(-0.5 * (gap / NEAR) ** 2) * np.kron(far, np.ones((n, n))) * np.outer(valid, valid)
    return close / (close.sum(1, keepdims=True) + 1.0)


def _choose_starts(values: np.ndarray, variance: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Places whose modes lie clear of each other."""
    gaps = np.linalg.norm(values[:, :, None] - values[:, None], axis=-1) + 1e3 * np.eye(values.shape[1])
    clear = gaps.min((1, 2)) / np.sqrt(variance.max(1)) * valid.all(1)
    return np.argsort(-clear)[: STARTS * APART : APART]


def _assign(
    kernel: np.ndarray, rivals: np.ndarray, values: np.ndarray, variance: np.ndarray, log_weights: np.ndarray,
    start: int,
) -> tuple[np.ndarray, float]:  # fmt: skip
    """The order (S, n) found from one place, whose modes are numbered as they come, and its mean log-likelihood."""
    count, n = variance.shape
    observed = np.repeat(values.mean(1, keepdims=True), n, 1)  # (S, map, 2) where each place says that the maps take it
    noise = np.full((count, n), UNKNOWN)
    observed[start], noise[start] = values[start], variance[start]
    sure = np.zeros((count, n))
    share = np.full((count, n, n), 1 / n)  # (S, mode, map)
    for _ in range(ROUNDS):
        mean, others = _predict(kernel, observed, noise)
        mean[start], others[start] = values[start], variance[start]
        total = others[:, None] + variance[..., None]
        error = np.sum((values[:, :, None] - mean[:, None]) ** 2, -1)
        logits = log_weights[..., None] - error / (2 * total) - np.log(total)
        crowd = (rivals @ (share * sure[:, None] ** 2).reshape(-1, n)).reshape(share.shape)
        share = _balance(logits - REPULSION * crowd)
        observed = np.einsum("sag,sad->sgd", share, values)
        scatter = np.sum((values[:, :, None] - observed[:, None]) ** 2, -1) / 2
        sure = (np.sum(share**2, 1) - 1 / n) / (1 - 1 / n)  # 0 where all modes fit alike
        noise = np.einsum("sag,sag->sg", share, variance[..., None] + scatter) / np.maximum(sure, 0.01) ** 2
    return _round(share), float(np.mean(np.sum(share * np.clip(logits, -50, None), (1, 2))))


def _assign_by_odds(odds: np.ndarray, log_weights: np.ndarray, start: int) -> tuple[np.ndarray, float]:
    """The same from the log-odds (S n, S n) of `compute_odds`; instead of a likelihood the sum of them within maps."""
    count, n = log_weights.shape
    share = np.full((count, n, n), 1 / n)  # (S, mode, map)
    share[start] = np.eye(n)
    for _ in range(VOTES):
        sure = (np.sum(share**2, 1, keepdims=True) - 1 / n) / (1 - 1 / n)  # 0 where all modes fit alike
        logits = (odds @ (share * sure).reshape(-1, n)).reshape(share.shape) + log_weights[..., None]
        logits[start] = CERTAIN * (2 * np.eye(n) - 1)
        share = _balance(logits)
    order = _round(share)
    chosen = (order[:, None] == np.arange(n)[:, None]).astype(float).reshape(-1, n)  # (S mode, map)
    return order, float(np.sum(chosen * (odds @ chosen)))


def _predict(kernel: np.ndarray, observed: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (S, n, 2) and variances (S, n) of maps at each place, by what all the others say."""
    middle = observed.mean(0)
    inverse = np.linalg.inv(kernel + noise.T[..., None] * np.eye(len(kernel)))  # (n, S, S)
    pull = inverse @ (observed - middle).transpose(1, 0, 2)
    precision = np.diagonal(inverse, axis1=1, axis2=2)
    mean = observed - (pull / precision[..., None]).transpose(1, 0, 2)
    return mean, np.maximum(1 / precision - noise.T, 1e-6).T


def _balance(logits: np.ndarray) -> np.ndarray:
    """(S, mode, map) shares whose rows and columns sum to 1 (Sinkhorn and Knopp 1967)."""
    for _ in range(BALANCE):
        logits = logits - np.logaddexp.reduce(logits, 1, keepdims=True)
        logits = logits - np.logaddexp.reduce(logits, 2, keepdims=True)
    return np.exp(logits)


def _round(share: np.ndarray) -> np.ndarray:
    """(S, n) mode of each map, each mode once: the largest share first."""
    count, n, _ = share.shape
    left, order, rows = share.copy(), np.zeros((count, n), int), np.arange(count)
    for _ in range(n):
        mode, column = np.divmod(left.reshape(count, -1).argmax(1), n)
        order[rows, column] = mode
        left[rows, mode], left[rows, :, column] = -1, -1
    return order
