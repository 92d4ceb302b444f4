"""Two images that are described, to be asked about: the ``Pair``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mmgsd.checks import read_flag
from mmgsd.images import check_pixels
from mmgsd.match.heatmap import compute_scale, make_match
from mmgsd.match.joint import join, spread_places
from mmgsd.match.match import Match, sort_modes
from mmgsd.match.mixture import check_modes
from mmgsd.match.places import Flat
from mmgsd.model.heads import Outputs, look_up
from mmgsd.model.network import compute_cell_centres
from mmgsd.numerics import own_numerics

if TYPE_CHECKING:
    from mmgsd.match.matcher import Matcher


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and what the network says of them: each question takes a few milliseconds."""

    matcher: Matcher
    image0: np.ndarray | None  # (H0, W0, 3) uint8; None: it is asked about places
    image1: np.ndarray  # (H1, W1, 3) uint8
    outputs: tuple[Outputs | None, Outputs]
    mask0: np.ndarray | None = None  # (H0, W0) bool, of the caller's
    mask1: np.ndarray | None = None  # (H1, W1) bool

    @own_numerics()
    def match(self, xy: Any, *, n: Any = None, joint: bool = False) -> Match:
        """As `Matcher.match`, or without ``image0`` as `Matcher.find`, with places for ``xy``."""
        joint = read_flag("joint", joint)
        if self.image0 is None:
            return self._find(xy, n, joint)
        points = check_pixels(xy, self.image0.shape[1::-1])
        if not joint:
            return self._match(points, n)
        most = self.matcher.num_modes
        count = most if n is None else n
        check_modes(count, "n", most, " with joint")
        match, order = self.match_everywhere(points)
        weights = np.take_along_axis(match.weights, order, 1)
        heavy = weights[len(points) if len(match) > len(points) else 0 :].sum(0) + 1e-9
        return sort_modes(match[: len(points)], order[: len(points), :count], heavy[:count])

    @own_numerics()
    def match_everywhere(self, points: np.ndarray) -> tuple[Match, np.ndarray]:
        """The answer to pixels (S, 2) of image0, then to places all over the object, and whose modes are whose.

        That is an order (S + P, n) of each one's modes: its columns are members of the symmetry (`join`). It is told by
        distances on the object where these are known.
        """
        mask = self._find_mask()
        places = spread_places(mask)
        match = self._match(np.concatenate([points, places.astype(points.dtype)]), None, merge=False)
        located = self.matcher.locate(self.outputs[0], torch.from_numpy(match.xy), self.image0.shape[1::-1])
        return match, join(match.xy, mask, match.modes, match.weights, match.spread_px, places=len(places),
                           located=located)  # fmt: skip

    def _find(self, places: Any, n: Any, joint: bool) -> Match:
        flat, xy, counts = self.matcher.look_up_places(places, joint=joint)
        return self.lay_beside(flat).match(xy, n=counts if n is None and not joint else n, joint=joint)

    def lay_beside(self, flat: Flat) -> Pair:
        """The same image1 beside the object laid flat (`Matcher.lay_flat`), to be asked about the latter's pixels."""
        return dataclasses.replace(self, image0=flat.image, outputs=(flat.outputs, self.outputs[1]), mask0=flat.mask)

    def _find_mask(self) -> np.ndarray:
        """(H0, W0) bool, where image0 shows the object."""
        if self.mask0 is not None:
            return self.mask0
        if self.outputs[0].mask is None:
            raise ValueError(f"mask0 must be given for joint answers and tracks: these weights of "
                             f"{self.matcher.config.name} do not know where the object lies")  # fmt: skip
        return self.matcher.resize_mask(self.outputs[0].mask, self.image0.shape[1::-1]) >= 0.5

    def _match(self, points: np.ndarray, n: Any, *, merge: bool = True) -> Match:
        size0, size1 = sizes = tuple((im.shape[1], im.shape[0]) for im in (self.image0, self.image1))
        mask1 = None if self.mask1 is None else torch.from_numpy(self.mask1)
        cells = self.matcher.compute_heatmaps(*self.outputs, torch.from_numpy(points), size0, mask1=mask1)
        centres = compute_cell_centres(size1, cells.shape[-2:])
        fitted, readout = self.matcher.num_modes, self.matcher.readout
        scale = compute_scale(size1, self.matcher.size)
        match = make_match(self.image0, self.image1, points, cells, centres, n, fitted=fitted, readout=readout,
                           scale=scale, merge=merge)  # fmt: skip
        return dataclasses.replace(match, calibration=self.matcher.calibration, **self._look(match, sizes))

    def _look(self, match: Match, sizes: tuple[tuple[int, int], ...]) -> dict[str, np.ndarray]:
        """What is known of the object's presence: ``visible``, ``on_object`` and ``absent`` of a match."""
        presence, xy = {}, torch.from_numpy(match.xy)
        visible = self.matcher.compute_visible(*self.outputs, xy, torch.from_numpy(match.modes), sizes)
        if visible is not None:
            presence["visible"] = visible.cpu().numpy()
        on_object = look_up(self.mask0, self.outputs[0].mask, match.xy, sizes[0])
        if on_object is not None:
            presence["on_object"] = on_object
        if self.mask1 is not None or self.outputs[1].presence is not None:
            absent = 0.0 if self.mask1 is not None else float(1 - self.outputs[1].presence.sigmoid())
            presence["absent"] = np.full(len(match), absent, np.float32)
        return presence
