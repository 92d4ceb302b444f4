"""Places of an object asked for by name, without a first picture: how its material points are described on average.

A model's file keeps the mean descriptor of each material point over renders, and of a point and its like places
together. Laid out flat they take the part of a first image: `Flat` is that image, its descriptors and its mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from mmgsd.config import N_POINTS, OBJECTS
from mmgsd.model.heads import Outputs
from mmgsd.symmetry import load_group, locate_points

SIDE = round(N_POINTS**0.5)
NAMES = {  # of a place and all that look like it: one of its material points
    "cloth": {"corners": 0, "edges": SIDE // 2, "centre": N_POINTS // 2},
    "rope": {"ends": 0, "middle": N_POINTS // 2},
}
CLOTH_CELL_PX, LINE_PX = 16, 16  # of a flat picture: a cell of a cloth's; the height of any other's
PLACE_TEMPERATURE = 0.1  # of the heatmap over places, so low that mostly one counts
BESIDE = 0.05  # on an object laid flat: places that a pixel may lie between
GROUND, OBJECT, EDGE = 235, 170, 90  # grey levels


@dataclass(frozen=True, eq=False)
class Place:
    """What some places are described as, the mean over pictures (`Matcher.average`): `Matcher.find` takes it."""

    descriptors: Tensor  # (S, D)


@dataclass(frozen=True, eq=False)
class Flat:
    """An object laid flat, to be asked about like an image: a cloth's points row by row, any others' along a line."""

    image: np.ndarray  # (H, W, 3) uint8
    mask: np.ndarray  # (H, W) bool
    outputs: Outputs  # descriptors (D, h, w), a cell a material point
    object: str
    group: str

    def look_up(self, places: Any) -> tuple[np.ndarray, np.ndarray | None]:
        """Pixels (S, 2) of places, and how many like places (S,) each has, None where that is not known.

        A place is a name of `NAMES`, the number of a material point, or where it lies from 0 to 1: (u, v) along a
        cloth's columns and rows, a number with a fraction along a rope. ValueError for anything else.
        """
        several = isinstance(places, list) or (isinstance(places, np.ndarray) and places.ndim > 1)
        at = np.array([self._find(place) for place in (places if several else [places])]).reshape(-1, 2)
        if self.object not in OBJECTS:
            return self._to_pixels(at), None
        column, row = at.round().astype(int).T
        number = row * self.outputs.descriptors.shape[2] + column
        return self._to_pixels(at), load_group(self.object, self.group).count_modes(number)

    @property
    def xy(self) -> np.ndarray:
        """Pixels (P, 2) of the material points."""
        height, width = self.outputs.descriptors.shape[1:]
        row, column = np.divmod(np.arange(height * width), width)
        return self._to_pixels(np.stack([column, row], 1))

    def _to_pixels(self, at: np.ndarray) -> np.ndarray:
        """Pixels (S, 2) of columns and rows."""
        height, width = self.outputs.descriptors.shape[1:]
        cell = np.array([self.image.shape[1] / width, self.image.shape[0] / height])
        return ((at + 0.5) * cell - 0.5).astype(np.float32)

    def _find(self, place: Any) -> tuple[float, float]:
        """Column and row, with fractions, of a place."""
        height, width = self.outputs.descriptors.shape[1:]
        number = NAMES.get(self.object, {}).get(place) if isinstance(place, str) else place
        if isinstance(number, int | np.integer) and not isinstance(number, bool) and 0 <= number < height * width:
            return float(number % width), float(number // width)
        line = height == 1 and isinstance(number, float | np.floating)
        along = (number, 0.0) if line and self.object in OBJECTS else number
        if self.object in OBJECTS and isinstance(along, tuple | np.ndarray) and np.shape(along) == (2,):
            u, v = map(float, along)
            if 0 <= u <= 1 and 0 <= v <= 1:
                return u * (width - 1), v * (height - 1)
        accepted = [*map(repr, NAMES.get(self.object, {})), f"a point's number below {height * width}"]
        accepted += {"cloth": ["(u, v) in [0, 1]"], "rope": ["a fraction of its length"]}.get(self.object, [])
        raise ValueError(f"places must be {', '.join(accepted)}, or a list of these, got {place!r:.80}")


def shrink_sources(sources: Tensor, places: Tensor, shrinkage: float, *, bandwidth: float | None = None) -> Tensor:
    """Descriptors (…, S, D) moved towards the object's places (P, D) that they are likest to, by a share of the way.

    One picture shows a pixel of an object in one way, which the mean over many does not have. Towards one place, or
    between some that are about as near: to their mean by a heatmap over the places at `PLACE_TEMPERATURE`. The
    ``shrinkage``, 0 to 1, is chosen on renders (`mmgsd.measure.calibration.choose_shrinkage`).
    """
    return torch.lerp(sources, torch.softmax(_score_places(sources, places, bandwidth), -1) @ places, shrinkage)


def locate(
    sources: Tensor, places: Tensor, object: str, group: str, *, bandwidth: float | None = None
) -> np.ndarray:  # fmt: skip
    """(G, S, 2) in [0, 1], where each member of a cloth's or rope's symmetry takes pixels described so (S, D).

    On the object laid flat (`locate_points`): what ``places`` (P, D) are described as says where each pixel lies, up to
    the symmetry. That is the place which is the likeliest, and those beside it as far as they are likely, too.
    """
    points, scores = locate_points(object), _score_places(sources, places, bandwidth)
    at = torch.from_numpy(points).to(scores)
    beside = torch.cdist(at, at)[scores.argmax(-1)] < BESIDE
    like = torch.softmax(scores.masked_fill(~beside, -torch.inf), -1).cpu().numpy()
    return like @ points[load_group(object, group).permutations]


def _score_places(sources: Tensor, places: Tensor, bandwidth: float | None) -> Tensor:
    """(..., S, P) logits of descriptors (..., S, D) over the object's places (P, D)."""
    return -(torch.cdist(sources, places) ** 2) / (PLACE_TEMPERATURE * (1 if bandwidth is None else 2 * bandwidth**2))


def lay_flat(descriptors: Tensor, object: str, group: str) -> Flat:
    """The object whose material points (P, D) are described so; ValueError for a cloth or rope of another P."""
    if object in OBJECTS and len(descriptors) != N_POINTS:
        raise ValueError(f"places of a {object} must be {N_POINTS}, got {len(descriptors)}")
    if object == "cloth":
        rows, side = SIDE, SIDE * CLOTH_CELL_PX
        image, mask = np.full((side, side, 3), OBJECT, np.uint8), np.ones((side, side), bool)
        cv2.rectangle(image, (0, 0), (side - 1, side - 1), (EDGE,) * 3, thickness=3)
    else:
        rows, mask = 1, np.zeros((LINE_PX, len(descriptors)), bool)
        mask[LINE_PX // 2 - 1 : LINE_PX // 2 + 1] = True
        image = np.repeat(np.where(mask, EDGE, GROUND).astype(np.uint8)[..., None], 3, 2)
    return Flat(image, mask, Outputs(descriptors.T.unflatten(1, (rows, -1)).contiguous()), object, group)
