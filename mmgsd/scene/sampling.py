"""Draws that every sampler of a scene needs, from an explicit ``rng``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def choose(rng: np.random.Generator, shares: Mapping[str, float]) -> str:
    """One of the names, each with the probability that ``shares`` gives it; they must sum to 1."""
    return str(rng.choice(list(shares), p=list(shares.values())))


def log_uniform(rng: np.random.Generator, low: float, high: float, size: int | None = None) -> np.ndarray | float:
    """A number, or ``size`` of them, from ``low`` to ``high``: each doubling is as likely as any other."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))
