"""The answer to queries, the ``Match``, and what it offers; NumPy alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from mmgsd.checks import renamed
from mmgsd.model.calibration import Calibration, Gaussian, Modes, compute_share
from mmgsd.numerics import numpy_defaults

RADIUS_PX = 20.0  # of a training image, within which a robot's grasp still holds, unless the caller says otherwise
LIKELY = 0.5  # from here on something is said to be so
# fields of all queries; of others the first axis counts queries
SHARED = ("image0", "image1", "scale", "calibration", "joint_weights")


@dataclass(frozen=True)
class Best:
    """The one mode of each of S queries for a single pick.

    ``xy`` (S, 2) px in image1, NaN where the answer is not sure enough; ``spread_px`` (S,) its std, root mean square
    over directions; ``confidence`` (S,) in [0, 1], as `Match.confidence`.
    """

    xy: np.ndarray
    spread_px: np.ndarray
    confidence: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Match:
    """The answer to S queries; pixels are those of the caller's images.

    ``len`` counts the queries; an index, negative ones too, a slice, an array of indices or a boolean mask takes some
    of them, and a loop goes through them one by one: each gives a `Match`. Its fields:

    ``image0``, ``image1``  (H, W, 3) uint8 RGB each.
    ``xy``  (S, 2) px in image0.
    ``modes``  (S, n, 2) px in image1, most probable first, or as ``joint_weights`` says; NaN for absent ones.
    ``weights``  (S, n), sum to 1 over the modes that are here, also where fewer were kept than fitted.
    ``covariances``  (S, n, 2, 2) px².
    ``entropy``  (S,) nats, of the density over px of a training image, whatever the size of image1.
    ``outlier_mass``  (S,) in [0, 1], heatmap mass outside the 95 % ellipses of all modes that were fitted.
    ``cells``  (S, h, w), the heatmap on the descriptors' grid; each sums to 1.
    ``visible``  (S, n) in [0, 1], whether each mode's match is seen there, or hidden.
    ``on_object``  (S,) in [0, 1], whether the pixel asked about shows the object.
    ``absent``  (S,) in [0, 1], whether image1 does not show the object at all.
    ``joint_weights``  (n,) of a joint answer: modes[:, g] are of one member of the symmetry, and weigh so much over the
    whole object, on average; the heaviest first. None: each query has an order of its own.
    ``scale``  px of image1 by px of an image of the size that the model was taught with.
    ``calibration``  what ellipses, radii and confidences promise; None: what a Gaussian would.

    ``visible``, ``on_object`` and ``absent`` are None where what answered does not know them: weights that learnt no
    mask, hand-made descriptors.
    """

    image0: np.ndarray
    image1: np.ndarray
    xy: np.ndarray
    modes: np.ndarray
    weights: np.ndarray
    covariances: np.ndarray
    entropy: np.ndarray
    outlier_mass: np.ndarray
    cells: np.ndarray
    visible: np.ndarray | None = None
    on_object: np.ndarray | None = None
    absent: np.ndarray | None = None
    joint_weights: np.ndarray | None = None
    scale: float = 1.0
    calibration: Calibration | None = None

    outside = renamed("outside", "outlier_mass")
    joint = renamed("joint", "joint_weights")

    @cached_property
    def heatmap(self) -> np.ndarray:
        """(S, H1, W1) float32, the heatmaps over image1's pixels; each sums to 1. Of one: `compute_heatmap`."""
        full = np.empty((len(self), *self.image1.shape[:2]), np.float32)
        for index in range(len(self)):
            full[index] = self.compute_heatmap(index)
        return full

    @numpy_defaults()
    def compute_heatmap(self, index: int = 0) -> np.ndarray:
        """(H1, W1) float32, the heatmap of one query over image1's pixels; sums to 1."""
        size = (self.image1.shape[1], self.image1.shape[0])
        pixels = cv2.resize(self.cells[index], size, interpolation=cv2.INTER_LINEAR)
        return pixels / pixels.sum()

    @property
    def spread_px(self) -> np.ndarray:
        """(S, n) std of each mode, root mean square over directions; NaN for absent modes."""
        return np.sqrt(np.trace(self.covariances, axis1=-2, axis2=-1) / 2)

    @numpy_defaults()
    def confidence(self, *, radius_px: float | None = None) -> np.ndarray:
        """(S, n) in [0, 1], probability that a true match lies within ``radius_px`` px of image1 of each mode.

        By default the radius is 20 px of an image of the size that the model was taught with, `RADIUS_PX` times
        ``scale``: the same place of the picture in few pixels or many. Calibrated where ``calibration`` is known: of
        all modes with 0.7, a match is near 7 in 10, on images like those of the training. Else that of a round
        Gaussian as wide as the mode, less what the mode's weight lacks of an equal share. Times the probability that
        the pixel asked about and image1 show the object, where that is known.
        """
        radius = RADIUS_PX if radius_px is None else radius_px / self.scale
        if not radius > 0:
            raise ValueError(f"radius_px must be greater than 0 px, got {radius_px!r}")
        presence = 1.0 if self.on_object is None else self.on_object[:, None]
        presence = presence if self.absent is None else presence * (1 - self.absent[:, None])
        return self._promise.compute_confidence(radius, self._measured) * presence

    @numpy_defaults()
    def radius_px(self, *, level: float = 0.9) -> np.ndarray:
        """(S, n) px of image1: a true match lies within it of each mode with at least probability ``level``.

        Split conformal prediction over pairs of images: the promise holds, whatever the network, for queries of a pair
        that is exchangeable with the pairs of the calibration, and on average over such queries, not for each kind of
        query. It does not cross domains: of renders it says nothing about photographs. inf where too few pairs were
        asked to promise so much; without ``calibration`` that of a Gaussian, which guarantees nothing.
        """
        return self.scale * self._promise.compute_radius(level, self._measured)

    @numpy_defaults()
    def ellipses(self, *, level: float = 0.9) -> np.ndarray:
        """(S, n, 2, 2) px²: matrices A of the ellipses (x - mode)ᵀ A⁻¹ (x - mode) <= 1 that promise ``level``.

        So large a share of true matches lies within the ellipse of the mode paired with them, on images like those of
        the training where ``calibration`` is known; without it where the modes' errors are Gaussian.
        """
        return self.covariances * self._promise.compute_distance2(level, self._measured)[..., None, None]

    @property
    def _measured(self) -> Modes:
        """In px of a training image."""
        effective_size_px = np.exp(self.entropy.astype(float) / 2)[:, None]
        return Modes(self.spread_px / self.scale, compute_share(self.weights), effective_size_px)

    @property
    def _promise(self) -> Gaussian:
        return self.calibration or Gaussian()

    def best(self, *, min_confidence: float = 0.0, radius_px: float | None = None) -> Best:
        """The mode with the least spread of each query: which of the like places to grasp (paper introduction).

        For one pick. Picks and places that belong together may take modes of different members of the symmetry: ask
        for them with ``joint``, or use `mmgsd.fold.moves.answer_picture`.
        One that is seen is preferred to one that is hidden, where that is known. Abstains, with NaN for ``xy``, where a
        true match lies within ``radius_px`` (as in `confidence`) with less than ``min_confidence``, where the pixel
        asked about is more likely background, and where the object is more likely not in image1.
        """
        if not 0 <= min_confidence <= 1:
            raise ValueError(f"min_confidence must be in [0, 1], got {min_confidence!r}")
        rows = np.arange(len(self.modes))
        spread = np.nan_to_num(self.spread_px, nan=np.inf)
        hidden = np.zeros(spread.shape, bool) if self.visible is None else self.visible < 0.5
        if self.joint_weights is not None and len(self):
            spread, hidden = (np.broadcast_to(values.mean(0), spread.shape) for values in (spread, hidden))
        chosen = np.lexsort((spread, hidden), axis=1)[:, 0]
        confidence = self.confidence(radius_px=radius_px)[rows, chosen]
        able = (confidence >= min_confidence) & self.answerable
        xy = np.where(able[:, None], self.modes[rows, chosen], np.nan)
        return Best(xy, self.spread_px[rows, chosen], confidence)

    def seen_first(self) -> Match:
        """The same answer, each query's modes ordered by ``visible``, those most probably seen first.

        Of what does not know what is seen it is the answer itself. ValueError for a joint answer, whose columns belong
        together.
        """
        if self.joint_weights is not None:
            raise ValueError("a joint answer's modes must stay in its order: ask without joint, or sort match.modes")
        if self.visible is None:
            return self
        missing = np.isnan(self.modes).any(-1)
        order = np.argsort(np.where(missing, np.inf, -self.visible), axis=1, kind="stable")
        return dataclasses.replace(self, **_take_modes(self, order))

    @property
    def answerable(self) -> np.ndarray:
        """(S,) bool, whether the pixel asked about and image1 both show the object, as far as that is known."""
        able = np.ones(len(self), bool)
        if self.on_object is not None:
            able &= self.on_object >= 0.5
        return able if self.absent is None else able & (self.absent <= 0.5)

    def say_presence(self, query: int = 0) -> str:
        """Why a query has no answer: image1 lacks the object, or the pixel is background; "" where it has one."""
        if self.absent is not None and self.absent[query] > LIKELY:
            return f"absent: image1 does not show the object ({self.absent[query]:.0%} sure)"
        if self.on_object is not None and self.on_object[query] < LIKELY:
            return f"background: the pixel is not on the object ({1 - self.on_object[query]:.0%} sure)"
        return ""

    def find_hidden(self, query: int = 0) -> np.ndarray:
        """(n,) bool, which modes' matches are likely there but hidden by something, as far as that is known."""
        if self.visible is None:
            return np.zeros(self.modes.shape[1], bool)
        return self.visible[query] < LIKELY

    def __len__(self) -> int:
        return len(self.xy)

    def __iter__(self) -> Iterator[Match]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: Any) -> Match:
        """The answer to some queries alone; IndexError for one that there is not, or what is no index."""
        if isinstance(index, bool | np.bool_) or index is None:
            raise IndexError(f"index must be an integer, a slice, an array of indices or a mask, got {index!r}")
        nothing = np.size(index) == 0 and np.asarray(index).dtype != bool
        rows = np.atleast_1d(np.arange(len(self))[[] if nothing else index])
        if rows.ndim > 1:
            raise IndexError(f"index must have one axis, got shape {np.shape(index)}")
        names = {field.name for field in dataclasses.fields(self)} - {*SHARED}
        arrays = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return dataclasses.replace(self, **{name: value[rows] for name, value in arrays.items()})

    def __repr__(self) -> str:
        sizes = (f"{image.shape[1]} x {image.shape[0]} px" for image in (self.image0, self.image1))
        queries = "1 query" if len(self) == 1 else f"{len(self)} queries"
        note = "" if self.calibration else ", not calibrated"
        return f"Match({queries}, up to {self.modes.shape[1]} modes each, images of {' and '.join(sizes)}{note})"

    def plot(self, index: int = 0):  # noqa: ANN201 (matplotlib is imported only where a plot is asked for)
        """Figure of source pixel, heatmap and modes with their 1-std ellipses, for one query.

        ValueError where ``index`` is not in [0, S).
        """
        from mmgsd.figures.plots import plot_match

        return plot_match(self, index)


def sort_modes(match: Match, order: np.ndarray, joint: np.ndarray) -> Match:
    """The same answer with the modes in an ``order`` (S, k) of indices, that of ``joint`` (k,)."""
    taken = _take_modes(match, order)
    weights = taken["weights"]
    total = weights.sum(1, keepdims=True)
    taken["weights"] = np.divide(weights, total, out=weights, where=total > 0)
    return dataclasses.replace(match, **taken, joint_weights=joint / joint.sum())


def _take_modes(match: Match, order: np.ndarray) -> dict[str, np.ndarray | None]:
    """What a `Match` says of its modes, in an ``order`` (S, k) of indices."""
    return {
        "modes": np.take_along_axis(match.modes, order[..., None], 1),
        "weights": np.take_along_axis(match.weights, order, 1),
        "covariances": np.take_along_axis(match.covariances, order[..., None, None], 1),
        "visible": None if match.visible is None else np.take_along_axis(match.visible, order, 1),
    }
