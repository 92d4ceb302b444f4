"""What a mode's ellipse, radius and confidence promise: by its own Gaussian, or as held-out pairs showed; NumPy alone.

A `Calibration` is a few dozen numbers in the weights' metadata, fitted by `mmgsd.measure.calibration`.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

LEVELS = (*(round(0.05 * i, 2) for i in range(1, 20)), 0.99)  # that a calibration's tables know
KEYS = {"ellipse": len(LEVELS), "radius": len(LEVELS), "powers": 3}  # lists of numbers, of so many each
LEAST = 1e-6  # of a share: a mode without any weight has one all the same


class Modes(NamedTuple):
    """What tells how far modes are off; pixels are those of images of the training's size."""

    spread: np.ndarray  # (…) px, std
    share: np.ndarray  # (…) weight by that of an equal one of the query's modes, in [0, 1]
    effective_size_px: np.ndarray  # (…) px, exp(entropy / 2): side of the square that the whole heatmap spreads over


class Gaussian:
    """What the modes' own Gaussians promise: all that can be said of weights that were not calibrated."""

    def compute_distance2(self, level: float, modes: Modes) -> np.ndarray:
        """Squared Mahalanobis distances (…) from modes that their true matches are within at a share of ``level``."""
        check_level(level)
        return np.full(np.shape(modes.spread), -2 * math.log1p(-level))

    def compute_radius(self, level: float, modes: Modes) -> np.ndarray:
        """Radii (…) px around modes within which a true match lies with probability ``level``; inf where none does."""
        check_level(level)
        inside = np.clip(1 - level / np.maximum(modes.share, LEAST), 0, 1)
        with np.errstate(divide="ignore"):
            return modes.spread * np.sqrt(-2 * np.log(inside))

    def compute_confidence(self, radius: float, modes: Modes) -> np.ndarray:
        """Probabilities (…) that a true match lies within ``radius`` px of modes; 0 of NaN spreads."""
        return modes.share * np.nan_to_num(-np.expm1(-0.5 * np.square(radius / modes.spread)))


@dataclass(frozen=True)
class Calibration(Gaussian):
    """What pairs of simulations that were held out from training showed, at the levels `LEVELS`; inf: too few told.

    Errors are heavy-tailed and grow faster than the spread: they are measured by `compute_unit`. ``ellipse``:
    Mahalanobis distances, times the spread, of true matches from the modes they are paired with; ``radius``: distances
    of modes from the nearest true match. ValueError, which names it, for a value that is neither.
    """

    ellipse: tuple[float, ...]  # (20,) ascending
    radius: tuple[float, ...]  # (20,) ascending
    powers: tuple[float, ...]  # (3,) of spread, share and effective size in `compute_unit`
    pairs: int  # that the tables were read from
    ece_ellipse: float = math.nan  # expected calibration error on pairs that the tables were not read from
    ece_confidence: float = math.nan

    def __post_init__(self) -> None:
        for name, count in KEYS.items():
            values = getattr(self, name)
            if len(values) != count or not all(map(_is_number, values)):
                raise ValueError(f"{name} must hold {count} numbers, got {values!r:.80}")
        for name in ("ellipse", "radius"):
            values = getattr(self, name)
            if not 0 <= values[0] < math.inf or list(values) != sorted(values):
                raise ValueError(f"{name} must ascend from a finite number of at least 0, got {values!r:.80}")
        if not all(map(math.isfinite, self.powers)):
            raise ValueError(f"powers must be finite, got {self.powers!r}")

    def compute_distance2(self, level: float, modes: Modes) -> np.ndarray:
        """As of a Gaussian, linear between two of `LEVELS`."""
        check_level(level)
        distance = np.interp(level, (0, *LEVELS), (0, *self.ellipse), right=np.inf)
        return np.square(distance * compute_unit(modes, self.powers) / modes.spread)

    def compute_level(self, distance2: np.ndarray, modes: Modes) -> np.ndarray:
        """The levels (…) at which `compute_distance2` gives ``distance2`` (…): 1 above the table, NaN where it is."""
        distance = np.sqrt(distance2) * modes.spread / compute_unit(modes, self.powers)
        return np.interp(distance, *_know(self.ellipse), right=1)

    def compute_radius(self, level: float, modes: Modes) -> np.ndarray:
        """As of a Gaussian; between two of `LEVELS` the higher one's, so that the promise is kept."""
        check_level(level)
        place = int(np.searchsorted(LEVELS, level - 1e-9))
        return (*self.radius, np.inf)[place] * compute_unit(modes, self.powers)

    def compute_confidence(self, radius: float, modes: Modes) -> np.ndarray:
        """As of a Gaussian, linear between two numbers of the table; at most its highest level."""
        return np.nan_to_num(np.interp(radius / compute_unit(modes, self.powers), *_know(self.radius)))

    def to_json(self) -> str:
        """The metadata that `parse_calibration` reads; what is not finite is null."""
        values = asdict(self)
        for name in KEYS:
            values[name] = [float(f"{v:.6g}") if math.isfinite(v) else None for v in values[name]]
        return json.dumps({name: None if value != value else value for name, value in values.items()})


def parse_calibration(text: str) -> Calibration:
    """What `Calibration.to_json` wrote; ValueError or TypeError for anything else."""
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError("no object")
    for name in KEYS:
        values[name] = tuple(math.inf if v is None else v for v in values.get(name, ()))
    for name in ("ece_ellipse", "ece_confidence"):
        values[name] = math.nan if values.get(name) is None else float(values[name])
    return Calibration(**values)


def compute_unit(modes: Modes, powers: tuple[float, ...]) -> np.ndarray:
    """What distances from modes are measured by (…): spread, share and effective size, each to its power."""
    a, b, c = powers
    return modes.spread**a * np.maximum(modes.share, LEAST) ** b * modes.effective_size_px**c


def compute_share(weights: np.ndarray) -> np.ndarray:
    """Weights (S, n) of modes by that of an equal one of those that are there, at most 1."""
    present = (weights > 0).sum(-1, keepdims=True)
    return np.minimum(1, present * weights)


def check_level(level: float) -> None:
    """ValueError unless a number in (0, 1)."""
    if not (_is_number(level) and 0 < level < 1):
        raise ValueError(f"level must be a number greater than 0 and less than 1, got {level!r}")


def _know(table: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The table's finite numbers and their levels, from 0 on."""
    count = sum(map(math.isfinite, table))
    return (0.0, *table[:count]), (0.0, *LEVELS[:count])


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and value == value
