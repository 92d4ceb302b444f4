"""Colours of the object and of what lies around it, linear for shaders and 8-bit sRGB for images."""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np

from mmgsd.scene import SceneError

Colour = tuple[float, float, float, float]  # linear RGBA
RGB = tuple[int, int, int]
Draw = Callable[[np.random.Generator], RGB]

COLOURS = 1000  # drawn at most for one that is unlike another
TABLE_COLOURS = (
    (196, 154, 108), (160, 110, 66), (222, 188, 140), (110, 72, 46), (240, 240, 238), (225, 225, 228), (200, 200, 200),
    (150, 152, 156), (100, 102, 106), (60, 62, 66), (24, 24, 26), (176, 164, 146), (60, 90, 70), (58, 78, 120),
)  # fmt: skip


def draw_colour(rng: np.random.Generator) -> Colour:
    """Greys, pale and vivid colours, never black: linear RGBA."""
    saturation = rng.choice([rng.uniform(0, 0.12), rng.uniform(0.1, 0.5), rng.uniform(0.5, 1.0)])
    rgb = colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.2, 0.98))
    return (*(float(c) ** 2.2 for c in rgb), 1.0)


def draw_contrasting(rng: np.random.Generator, other: Colour, *, distance: float = 0.25, exempt: float = 0.1) -> Colour:
    """A colour ``distance`` (of display range) from ``other``, but for a share ``exempt`` of draws; or SceneError."""
    for _ in range(COLOURS):
        colour = draw_colour(rng)
        if rng.random() <= exempt or np.linalg.norm(_display(colour) - _display(other)) >= distance:
            return colour
    raise SceneError(f"none of {COLOURS} colours was {distance:g} of the display's range away from {other}")


def _display(colour: Colour) -> np.ndarray:
    return np.array(colour[:3]) ** (1 / 2.2)


def vary_colour(rng: np.random.Generator, colour: Colour, amount: float) -> Colour:
    """A colour near ``colour``."""
    return (*np.clip(np.array(colour[:3]) * _draw_shade(rng, amount), 0.01, 0.95).tolist(), 1.0)


def _draw_shade(rng: np.random.Generator, amount: float) -> np.ndarray:
    """Factors (3,) that make a colour lighter or darker, and change its tint a third as much."""
    return np.exp(rng.normal(scale=amount)) * np.exp(rng.normal(scale=amount / 3, size=3))


def to_srgb(colour: Colour) -> tuple[int, int, int]:
    """sRGB, 0 to 255, of a linear colour."""
    return tuple(int(255 * c) for c in _display(colour))


def draw_rgb(rng: np.random.Generator) -> RGB:
    """A colour as things have them: black, white and grey more often than `draw_colour` gives."""
    kind = rng.random()
    if kind < 0.12:
        return (int(rng.integers(4, 40)),) * 3
    if kind < 0.27:
        return (int(rng.integers(215, 256)),) * 3
    if kind < 0.37:
        return (int(rng.integers(60, 200)),) * 3
    return to_srgb(draw_colour(rng))


def draw_table_rgb(rng: np.random.Generator) -> RGB:
    """A colour as tables and floors have them: wood, white, grey, black, or any."""
    if rng.random() < 0.4:
        return draw_rgb(rng)
    return vary_rgb(rng, TABLE_COLOURS[rng.integers(len(TABLE_COLOURS))], 0.12)


def draw_other_rgb(rng: np.random.Generator, other: RGB, *, distance: float = 60.0, draw: Draw = draw_rgb) -> RGB:
    """A colour at least ``distance`` (of 255) away from another, of a bounded number of draws."""
    for _ in range(20):
        colour = draw(rng)
        if np.linalg.norm(np.subtract(colour, other)) >= distance:
            return colour
    return tuple(255 - c if abs(255 - 2 * c) > 40 else 0 for c in other)


def vary_rgb(rng: np.random.Generator, colour: RGB, amount: float = 0.12) -> RGB:
    """A colour like another."""
    shade = _draw_shade(rng, amount)
    return tuple(int(c) for c in np.clip(np.array(colour) * shade + rng.normal(scale=6), 0, 255))


def to_linear(colour: RGB) -> tuple[float, float, float, float]:
    """The same as linear RGBA."""
    return (*((np.array(colour) / 255) ** 2.2).tolist(), 1.0)
