"""The rope's centre line: a random planar curve, laid over itself and relaxed until nothing cuts through.

Pure numpy, in units of the rope's diameter until the last step. A curve is drawn as curvature over arc length; where
it crosses itself one strand is lifted; then `rope_physics.py` settles it on the table. What still cuts through itself,
pinches or is not in the state asked for is drawn again.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mmgsd.scene import SceneError
from mmgsd.scene.geometry import choose, find_middle, measure_arc
from mmgsd.scene.objects.rope_physics import EXCLUDE, LENGTH, MIN_RADIUS, STEP, relax, resample

USUAL = 50  # diameters that a rope is long; longer ones bend in wider turns
STATES = {"straight": 0.10, "bent": 0.20, "heavily bent": 0.20, "loops": 0.25, "overhand knot": 0.25}  # probabilities
PLANS = 50_000  # curves drawn for one rope at most; one with loops takes some 200 on average
SETTLED = 1000  # of them, suitable ones that are settled on the table at most; one or two will do


@dataclass(frozen=True)
class RopeShape:
    """A settled rope. Heights are above the table, z = 0."""

    centre: np.ndarray  # (N, 3) float64, the centre line in metres, equally spaced along its length
    thickness: float  # diameter in metres
    state: str  # a key of STATES
    crossings: np.ndarray  # (C, 2) int, indices into centre: the part above, the part below
    ball_radius: float  # metres, 0 without a ball; the ball's centre is centre[0]


def own_parts(points: np.ndarray, reach: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Says whether first hits (K, 3) m are within ``reach`` of points ``indices`` (K,), along a rope (N, 3) m."""
    tree, steps = cKDTree(points), reach / np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
    return lambda hits, indices: np.abs(tree.query(hits)[1] - indices) <= steps


def sample_rope(
    rng: np.random.Generator, *, ball: bool = False, state: str | None = None,
    slenderness: tuple[float, float] = (32, 50),
) -> RopeShape:  # fmt: skip
    """Draw a rope in one of `STATES` (None: any) that rests on the table without cutting through itself.

    With a ``ball`` there is room for one at the first end; ``slenderness`` is the range of its length in diameters.
    ValueError for an unknown state, SceneError where no rope of the state comes about.
    """
    if state is not None and state not in STATES:
        raise ValueError(f"state must be one of {', '.join(map(repr, STATES))}, got {state!r}")
    state = state or choose(rng, STATES)
    ball_radius = rng.uniform(1.25, 1.75) * ball  # in diameters
    count = {"loops": int(rng.choice([1, 2, 3], p=[0.4, 0.35, 0.25])), "overhand knot": 3}.get(state, 0)
    # lazily: the next is drawn once one has failed
    plans = (_sample_plan(rng, state, count, slenderness) for _ in range(PLANS))
    for particles, tension, crossings in itertools.islice(filter(None, plans), SETTLED):
        shape = _finish(relax(particles, tension, ball_radius), state, ball_radius)
        if len(shape.crossings) == len(crossings) and is_possible(shape):
            return shape
    raise SceneError(f"no rope in the state {state!r} with {count} crossings and a ball of {ball_radius:.2f} diameters "
                     f"came to lie: {PLANS} curves were drawn, or {SETTLED} suitable ones settled")  # fmt: skip


def find_crossings(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a polyline (N, 2) crosses itself: pairs of segments (C, 2) int, first < second, and angles (C,) rad."""
    step = np.diff(xy, axis=0)
    offset = xy[None, :-1] - xy[:-1, None]  # (i, j): from the start of i to the start of j
    denominator = step[:, None, 0] * step[None, :, 1] - step[:, None, 1] * step[None, :, 0]
    denominator[denominator == 0] = np.inf
    along_i = (offset[..., 0] * step[None, :, 1] - offset[..., 1] * step[None, :, 0]) / denominator
    along_j = (offset[..., 0] * step[:, None, 1] - offset[..., 1] * step[:, None, 0]) / denominator
    hit = (along_i >= 0) & (along_i < 1) & (along_j >= 0) & (along_j < 1)
    pairs = np.argwhere(np.triu(hit, k=2))
    lengths = np.linalg.norm(step, axis=1)
    sine = np.abs(denominator[tuple(pairs.T)]) / (lengths[pairs[:, 0]] * lengths[pairs[:, 1]])
    return pairs, np.arcsin(np.clip(sine, 0, 1))


def min_separation(shape: RopeShape) -> float:
    """Least distance, in diameters, between parts at least EXCLUDE + 1 diameters apart along the rope (inf if none)."""
    spacing = LENGTH / (len(shape.centre) - 1)
    pairs = cKDTree(shape.centre).query_pairs(1.2 * shape.thickness, output_type="ndarray")
    far = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) * spacing > (EXCLUDE + 1) * shape.thickness]
    gaps = np.linalg.norm(shape.centre[far[:, 0]] - shape.centre[far[:, 1]], axis=1)
    return float(gaps.min(initial=np.inf) / shape.thickness)


def min_bend_radius(shape: RopeShape) -> float:
    """Least bend radius in diameters, from the turn over half a diameter."""
    half = max(1, round(0.25 * shape.thickness / (LENGTH / (len(shape.centre) - 1))))
    centre = shape.centre
    first, second = centre[half:-half] - centre[: -2 * half], centre[2 * half :] - centre[half:-half]
    turn = np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), (first * second).sum(1))
    length = (np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1)) / 2
    return float((length / np.maximum(turn, 1e-9)).min() / shape.thickness)


def ball_clearance(shape: RopeShape) -> float:
    """Least distance, in diameters, from the ball to the centre line beyond the end it sits on (inf if none)."""
    if not shape.ball_radius:
        return np.inf
    beyond = round((2 * shape.ball_radius + 2.5 * shape.thickness) / LENGTH * (len(shape.centre) - 1))
    gaps = np.linalg.norm(shape.centre[beyond:] - shape.centre[0], axis=1) - shape.ball_radius
    return float(gaps.min() / shape.thickness)


def max_slope(shape: RopeShape) -> float:
    """Steepest rise of the centre line, metres a metre in the plane."""
    step = np.diff(shape.centre, axis=0)
    return float(np.max(np.abs(step[:, 2]) / np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)))


def is_possible(shape: RopeShape) -> bool:
    """Whether a real rope could lie like this: no part in another or in the table, no pinched bend, no cliff."""
    on_table = shape.centre[:, 2].min() >= 0.49 * shape.thickness
    free = min_separation(shape) >= 0.96 and min_bend_radius(shape) >= 1.15 and max_slope(shape) <= 1.2
    free &= ball_clearance(shape) >= 0.48
    knotted = len(shape.crossings) == 3 and _alternates(shape.crossings)
    return bool(on_table and free and knotted == (shape.state == "overhand knot"))


def _alternates(crossings: np.ndarray) -> bool:
    """Whether one walks over, under, over, ... along the rope: with three crossings, what makes a knot hold."""
    passes = np.concatenate([crossings[:, 0], crossings[:, 1]])
    above = np.repeat([True, False], len(crossings))[np.argsort(passes)]
    return bool((above[1:] != above[:-1]).all())


# --- drawing the curve ------------------------------------------------------------------------------------------------


def _sample_plan(
    rng: np.random.Generator, state: str, count: int, slenderness: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Particles (N, 3) in diameters, their tension (N,) and crossings (count, 2) (above, below); None if unsuitable."""
    total = rng.uniform(*slenderness)  # length over diameter
    if state == "overhand knot":
        curvature, tension = _sample_knot(rng, total)
    else:
        curvature = _sample_bends(rng, state, total, count).clip(-1 / MIN_RADIUS, 1 / MIN_RADIUS)
        tension = np.zeros(len(curvature))
    heading = np.cumsum(curvature * STEP)
    xy = np.cumsum(STEP * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    pairs, angles = find_crossings(xy)
    if len(pairs) != count or not _is_suitable(xy, pairs, angles):
        return None
    above_first = rng.random(len(pairs)) < 0.5
    if state == "overhand knot":  # passes alternate; which one starts above is the knot's handedness
        order = np.argsort(np.argsort(pairs.ravel())).reshape(pairs.shape)
        above_first = order[:, 0] % 2 == int(rng.random() < 0.5)
    crossings = np.where(above_first[:, None], pairs, pairs[:, ::-1])
    points = np.column_stack([xy, _lift(len(xy), crossings)])
    return points, tension, crossings


def _is_suitable(xy: np.ndarray, pairs: np.ndarray, angles: np.ndarray) -> bool:
    """Whether a planar curve's crossings are steep and clear of each other and of the ends."""
    passes = np.sort(np.concatenate([[0, len(xy) - 1], pairs.ravel()]))
    separate = np.diff(passes).min() * STEP >= 2.0
    ends = passes[1] * STEP >= 2.5 and (len(xy) - 1 - passes[-2]) * STEP >= 2.5
    return bool(separate and ends and (angles > np.radians(40)).all() and _clear_enough(xy, pairs))


def _clear_enough(xy: np.ndarray, pairs: np.ndarray) -> bool:
    """Whether parts that do not cross nearby keep a gap: contact would push near misses on top of each other."""
    near = cKDTree(xy).query_pairs(1.1, output_type="ndarray")
    near = near[near[:, 1] - near[:, 0] > 3.2 / STEP]
    if not len(near):
        return True
    if not len(pairs):
        return False
    to_crossing = np.abs(near[:, None, :] - pairs[None]).max(2).min(1)
    return bool((to_crossing * STEP < 3.0).all())


def _turn(count: int, angle: float, place: float, radius: float) -> np.ndarray:
    """Curvature (count,) of one turn by ``angle`` degrees around arc length ``place``, of ``radius`` (diameters)."""
    angle = np.radians(angle)
    width = max(abs(angle) * radius, 0.5)
    arc = np.arange(count) * STEP - place
    return angle * (np.tanh((arc + width / 2) / 1.2) - np.tanh((arc - width / 2) / 1.2)) / (2 * width)


def _wobble(rng: np.random.Generator, count: int, turn: float) -> np.ndarray:
    """Gentle random curvature (count,): slow waves whose turns are of the order of ``turn`` rad."""
    arc = np.linspace(0, 1, count)
    scale = turn * np.pi / (count * STEP)
    return scale * sum(rng.normal() * np.sin(np.pi * k * arc + rng.uniform(0, 2 * np.pi)) for k in range(1, 5))


def _sample_bends(rng: np.random.Generator, state: str, total: float, crossings: int) -> np.ndarray:
    """Curvature (N,) of a rope without a knot: a wobble and, by state, bends or loops."""
    count = round(total / STEP)
    loops = rng.uniform(190, 340, max(1, crossings - rng.integers(0, 2)))
    turns = {
        "straight": np.zeros(0),
        "bent": rng.uniform(25, 100, rng.integers(1, 4)),
        "heavily bent": rng.uniform(70, 215, rng.integers(2, 6)),
        "loops": rng.permutation([*loops, *rng.uniform(30, 120, rng.integers(0, 3))]),
    }[state]
    curvature = _wobble(rng, count, {"straight": 0.12, "bent": 0.4}.get(state, 0.5))
    places = (np.arange(len(turns)) + rng.uniform(0.2, 0.8, len(turns))) / max(1, len(turns)) * total
    radii = rng.uniform(2.0, 4.0 if crossings > 1 else 6.0, len(turns)) * max(1.0, total / USUAL)
    for angle, place, radius in zip(turns * rng.choice([-1, 1], len(turns)), places, radii, strict=True):
        curvature = curvature + _turn(count, angle, place, radius)
    return curvature


def _sample_knot(rng: np.random.Generator, total: float) -> tuple[np.ndarray, np.ndarray]:
    """Curvature (N,) of two tails around an overhand knot, and the tension (N,) that tightens the knot."""
    t = np.linspace(-2.0, 2.0, 4001)
    template = np.stack([t**3 - 3 * t, t**4 - 4 * t**2], axis=1) * rng.uniform(1.3, 2.2)  # Shastri's long trefoil
    template *= np.sqrt(max(1.0, total / USUAL))
    arc = measure_arc(template)
    heading = np.interp(np.arange(0, arc[-1], STEP), arc, np.unwrap(np.arctan2(*np.gradient(template, axis=0).T[::-1])))
    knot = np.diff(heading) / STEP
    tails = np.maximum(10.0, (total - arc[-1]) * np.array([1, 1]) * (0.5 + rng.uniform(-0.3, 0.3) * np.array([1, -1])))
    left, right = (_sample_tail(rng, round(tail / STEP)) for tail in tails)
    tension = np.zeros(len(left) + len(knot) + len(right))
    tension[len(left) - 6 : len(left) + len(knot) + 6] = max(0.0, rng.uniform(-0.3, 1))
    return np.concatenate([left[::-1], knot, right]) * rng.choice([-1, 1]), tension


def _sample_tail(rng: np.random.Generator, count: int) -> np.ndarray:
    """Curvature (count,) of a tail: it turns away from the knot's axis of symmetry first, then wanders."""
    away = _turn(count, rng.uniform(-130, 0), 3.5, 2.0)
    bend = _turn(count, rng.uniform(-150, 150), rng.uniform(0.5, 0.9) * count * STEP, rng.uniform(2, 6))
    return away + bend + _wobble(rng, count, 0.3)


def _lift(count: int, crossings: np.ndarray) -> np.ndarray:
    """Heights (count,) in diameters that put the upper part at least one diameter above the lower at each crossing."""
    height = np.full(count, 0.5)
    index = np.arange(count)
    for _ in range(6):  # lifting a part lifts what lies on it
        for above, below in crossings:
            missing = max(0.0, height[below] + 1.05 - height[above])
            distance = np.minimum(np.abs(index - above) * STEP / 3.0, 1)
            height += missing * np.cos(np.pi / 2 * distance) ** 2
    return height


def _finish(points: np.ndarray, state: str, ball_radius: float) -> RopeShape:
    """Scale settled particles to metres, centre them on the table and read the crossings."""
    centre = resample(points, 625)
    thickness = LENGTH / np.linalg.norm(np.diff(centre, axis=0), axis=1).sum()
    centre = centre * thickness
    centre[:, :2] -= find_middle(centre[:, :2])
    pairs, _ = find_crossings(centre[:, :2])
    first_above = centre[pairs[:, 0], 2] > centre[pairs[:, 1], 2]
    crossings = np.where(first_above[:, None], pairs, pairs[:, ::-1])
    return RopeShape(centre, float(thickness), state, crossings, float(ball_radius * thickness))
