"""Which of the like modes belong together: those that one motion of the plane takes the demonstration's pixels to.

Each query alone has as many answers as the object's symmetry has members, and nothing says which pick goes with
which place. Of an object that lies about as in the demonstration, a motion says it for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

RADIUS = 0.08  # of the queries' extent: as near as a mode is to where the motion takes its pixel, where both agree
ROUNDS = 8  # in which queries take their nearest modes, and the motion is fitted again
MAX_SCALE = 1.25  # of two queries' distance, by which it may grow or shrink where the scale is known
ALIKE = 0.98  # of the best motion's weight: others that have so much are as good, and differ by their scale alone
MAX_FREE_SCALE = 3.0  # and where it is not: by more, a picture is from elsewhere, or all queries took one place


@dataclass(frozen=True, eq=False)
class Motion:
    """z ↦ ``factor`` z + ``shift`` of points x + iy: a turn and a shift, and a scale where the factor is no unit."""

    factor: complex
    shift: complex

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Where points (…, 2) come to lie."""
        return to_points(self.factor * to_complex(points) + self.shift)


def to_complex(points: np.ndarray) -> np.ndarray:
    """Points (…, 2) as numbers (…)."""
    points = np.asarray(points, float)
    return points[..., 0] + 1j * points[..., 1]


def to_points(numbers: np.ndarray) -> np.ndarray:
    """Numbers (…) as points (…, 2)."""
    return np.stack([np.real(numbers), np.imag(numbers)], -1)


def find_consensus(
    queries: np.ndarray, modes: np.ndarray, weights: np.ndarray, *, free_scale: bool = False
) -> tuple[Motion, float] | None:
    """The motion that most modes (S, n, 2) with weights (S, n) agree with, and the share of the queries that do.

    ``queries`` (S, 2) and modes are in one unit; None where no two are at a possible distance.
    Every two queries and their modes propose a motion, with their distance's scale where ``free_scale``; the one
    whose modes near by weigh most is fitted again to these. Of those that weigh alike it is the one with the scale
    nearest to one, so that the unit should be about the same on both sides: like corners answer for each other, and fit
    a square's diagonals, or a point, as well. NaN modes do not count. ValueError for fewer than two queries, or all
    at one place.
    """
    source, target = to_complex(queries), to_complex(modes)  # (S,), (S, n)
    extent = find_extent(queries)
    if len(source) < 2 or not extent > 0:
        raise ValueError(f"picks and anchors must be at two places or more, got {np.asarray(queries).tolist()}")
    weights = np.where(np.isfinite(target), weights, 0.0)
    motions = _propose(source, target, free_scale)  # (M, 2)
    if not len(motions):
        return None

    def weigh(motion: np.ndarray) -> np.ndarray:
        """(S, n): the modes' weights by how near the motion comes to them."""
        return _weigh(motion, source, target, weights, 2 * RADIUS * extent * (abs(motion[0]) if free_scale else 1))

    scores = np.array([weigh(motion).max(1).sum() for motion in motions])
    stretch = np.array([_stretch(motion) for motion in motions]) if free_scale else np.ones(len(motions))
    alike = scores >= (ALIKE if free_scale else 1) * scores.max()
    motion = motions[int(np.argmin(np.where(alike, stretch, np.inf)))]
    for _ in range(3):
        motion = _fit(source, target, weigh(motion), motion, free_scale)
    near = weigh(motion)
    return Motion(*map(complex, motion)), float(np.mean(near.max(1) > 0))


def _propose(source: np.ndarray, target: np.ndarray, free_scale: bool) -> np.ndarray:
    """Motions (M, 2), factor and shift each, of every two queries and their modes."""
    motions = []
    for i, j in combinations(range(len(source)), 2):
        if source[i] == source[j]:
            continue
        factor = (target[j][None] - target[i][:, None]) / (source[j] - source[i])  # (n, n)
        scale = np.abs(factor)
        with np.errstate(invalid="ignore", divide="ignore"):
            most = MAX_FREE_SCALE if free_scale else MAX_SCALE
            allowed = np.isfinite(factor) & (scale < most) & (scale > 1 / most)
            factor = factor if free_scale else factor / scale
        middle = (target[i][:, None] + target[j][None]) / 2
        shift = middle - factor * (source[i] + source[j]) / 2
        motions.append(np.stack([factor[allowed], shift[allowed]], 1))
    return np.concatenate(motions) if motions else np.zeros((0, 2), complex)


def _stretch(motion: np.ndarray) -> float:
    """By how much a motion changes lengths, either way; 1 of one that keeps them."""
    scale = abs(motion[0])
    return max(scale, 1 / scale)


def _weigh(motion: np.ndarray, source: np.ndarray, target: np.ndarray, weights: np.ndarray, reach: float) -> np.ndarray:
    """(S, n): the modes' weights, less the farther they are from where the motion takes the query, 0 from reach."""
    distance = np.abs(target - (motion[0] * source + motion[1])[:, None])
    return np.nan_to_num(weights * np.clip(1 - (distance / reach) ** 2, 0, None))


def _fit(source: np.ndarray, target: np.ndarray, near: np.ndarray, motion: np.ndarray, free_scale: bool) -> np.ndarray:
    """The motion that takes queries to their modes with the least squared error, each by its weight (S, n)."""
    rows, best = np.arange(len(source)), near.argmax(1)
    weight, aim = near[rows, best], target[rows, best]
    if np.count_nonzero(weight) < 2:
        return motion
    source, aim, weight = source[weight > 0], aim[weight > 0], weight[weight > 0]
    middle, goal = (np.average(values, weights=weight) for values in (source, aim))
    product = np.sum(weight * (aim - goal) * np.conj(source - middle))
    size = np.sum(weight * np.abs(source - middle) ** 2) if free_scale else np.abs(product)
    if not size > 0:
        return motion
    return np.array([product / size, goal - product / size * middle])


def fit_motion_to(source: np.ndarray, target: np.ndarray, *, free_scale: bool = False) -> Motion:
    """The motion that takes points (N, 2) to others with the least squared error; ValueError of fewer than two."""
    if len(source) < 2 or np.shape(source) != np.shape(target):
        raise ValueError(f"source and target must be as many points, two or more, got {len(source)} and {len(target)}")
    ones, start = np.ones((len(source), 1)), np.array([1.0, 0.0], complex)
    return Motion(*map(complex, _fit(to_complex(source), to_complex(target)[:, None], ones, start, free_scale)))


def find_extent(points: np.ndarray) -> float:
    """The distance of the farthest of points (N, 2) from their mean; 0 of none."""
    points = np.asarray(points, float)
    return float(np.linalg.norm(points - points.mean(0), axis=1).max()) if len(points) else 0.0


def refine_motion(queries: np.ndarray, modes: np.ndarray, motion: Motion, *, free_scale: bool = False) -> Motion:
    """The motion that best takes each query of (S, 2) to the nearest of its modes (S, n, 2), found from another one.

    For an object that is bent otherwise than shown: all queries count, not those alone that agree. Besl and McKay, "A
    method for registration of 3-D shapes" (1992). Questions without a mode do not count; of fewer than two, the same.
    """
    for _ in range(ROUNDS):
        nearest = modes[np.arange(len(modes)), _find_gaps(motion.apply(queries), modes).argmin(1)]
        finite = np.isfinite(nearest).all(1)
        if finite.sum() < 2:
            return motion
        motion = fit_motion_to(queries[finite], nearest[finite], free_scale=free_scale)
    return motion


def _find_gaps(wanted: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Distances (S, n) of each place of (S, 2) to its modes (S, n, 2), infinite to none."""
    return np.nan_to_num(np.linalg.norm(modes - wanted[:, None], axis=-1), nan=np.inf)


def assign_grasps(queries: np.ndarray, modes: np.ndarray, motion: Motion, *, min_distance: float) -> np.ndarray:
    """(S, 2): the mode of (S, n, 2) that each query of (S, 2) takes, near to where the motion takes it.

    No two take places less than ``min_distance`` from each other, unless the motion takes them there: whose second
    choice is worst chooses first, and what is taken is no choice of the others; none (NaN) where nothing is left.
    """
    wanted, taken = motion.apply(queries), np.full((len(queries), 2), np.nan)
    distance = _find_gaps(wanted, modes)
    allowed = np.minimum(min_distance, np.linalg.norm(wanted[:, None] - wanted, axis=-1) / 2)  # (S, S)
    left = set(range(len(queries)))
    while left := {k for k in left if np.isfinite(distance[k]).any()}:
        k = max(sorted(left), key=lambda k: _find_regret(distance[k]))
        taken[k] = modes[k, distance[k].argmin()]
        distance[np.linalg.norm(modes - taken[k], axis=-1) < allowed[k][:, None]] = np.inf
        left.remove(k)
    return taken


def _find_regret(distance: np.ndarray) -> float:
    """How much farther the second choice is than the first; infinite where there is none."""
    first, second = np.sort(np.append(distance, np.inf))[:2]
    return float(second - first)
