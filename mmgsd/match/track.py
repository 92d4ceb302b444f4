"""Points of one picture through many others: which of the like matches a point's own is, is chosen once and kept.

Each frame is matched with the first one, so no error adds up. A joint answer (`mmgsd.match.joint`) sorts the modes of
the points, and of places all over the object, into n maps, one a member of the symmetry; which of them is the object as
it lay in the first frame no single frame can tell. It is the one that moved least: a Viterbi filter over frames, whose
states are a frame's maps and whose steps are how all maps move together (Student's t, so parts may jump). A step may
leave frames out, where their answers fit those before and after badly, at the price of a match anywhere. From frame to
frame optical flow is exacter than any match: it carries the points, and the matches keep it from drifting.
"""

from __future__ import annotations

import os
import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from mmgsd.images import check_pixels, to_rgb
from mmgsd.match.heatmap import compute_scale
from mmgsd.match.match import LIKELY, Match
from mmgsd.match.matcher import Matcher, take_image
from mmgsd.match.pair import Pair
from mmgsd.video import open_video

MEMORY = 8  # frames that a step may start from
PACES, FARTHEST = (0.03, 0.1, 0.3), 1.0  # by the object's extent: stds of a step from frame to frame, of the longest
TAIL = 3.0  # exponent of the steps' density in the plane: Student's t with four degrees of freedom
EVIDENCE = 10.0  # places that are worth as much as all, which move together
ANYWHERE = -np.log(np.pi)  # log-density of a place anywhere within the object's extent
DRIFT_PX = 0.5  # of flow in a frame, std, of an image as the model was taught with
RETURN_PX = 1.0  # as near as flow there and back must come, of such an image
ALIKE = 4.0  # neighbouring frames' modes err alike: so many count as one
GATE = 3.0  # stds from a mode, beyond which flow and mode contradict each other
DOUBT = 4.0  # by which flow's variance grows in a frame where they do
PATIENCE = 6  # frames in which flow may be near another than the point's own mode


@dataclass(frozen=True, eq=False)
class Tracked:
    """Where S points are in one frame; fields are as a `Track` has them, without the axis of frames."""

    xy: np.ndarray  # (S, 2) px
    visible: np.ndarray  # (S,)
    confidence: np.ndarray  # (S,)
    absent: float


@dataclass(frozen=True, eq=False)
class Track:
    """Where S points are in T frames.

    ``xy`` (T, S, 2) px, NaN where the object is not seen at all; of a point that is hidden, where it is below what
    hides it. ``visible`` (T, S) in [0, 1], whether it is seen; NaN of weights that do not know. ``confidence`` (T, S)
    in [0, 1], that it lies within `RADIUS_PX` (as `Match.confidence` has it) and is no other of its like points.
    ``absent`` (T,) in [0, 1], whether the frame does not show the object.
    """

    xy: np.ndarray
    visible: np.ndarray
    confidence: np.ndarray
    absent: np.ndarray

    @classmethod
    def collect(cls, frames: Iterable[Tracked]) -> Track:
        """All frames' answers; ValueError of none."""
        answers = list(frames)
        if not answers:
            raise ValueError("frames must be images, one or more, got none")
        return cls(*(np.stack([getattr(one, name) for one in answers]) for name in cls.__annotations__))

    def __len__(self) -> int:
        return len(self.xy)


class Tracker:
    """Follows pixels ``xy`` (S, 2) of ``image0``, or the ``places`` that `Matcher.find` takes, frame by frame.

    The first frame need not be ``image0``, nor show the object. Of places, each and all that look like it are followed:
    S counts them together, a place's own beside each other, in the order of the first frame that shows them. Memory
    does not grow. A warning names pixels that show background more likely, which count as hidden. ValueError for pixels
    outside image0, an image0 that does not show the object, weights that know neither where it lies (``mask0`` (H, W)
    bool says it) nor, of places, what they look like.
    """

    def __init__(
        self, matcher: Matcher, image0: Any = None, xy: Any = None, *, places: Any = None, mask0: Any = None
    ) -> None:
        if (xy is None) == (places is None):
            raise ValueError("either xy or places must be given, got " + ("none" if xy is None else "both"))
        if places is not None and mask0 is not None:
            raise ValueError("mask0 must be None where places are given, not pixels")
        self._matcher, self._memory, self._frames, self._seen = matcher, deque(maxlen=MEMORY), 0, 0
        self._counts: np.ndarray | None = None  # of places: how many like ones each has, (S,)
        self._columns: list[np.ndarray] = []  # and which members' maps show these
        self._motion: _Motion | None = None
        self._on_object: np.ndarray | None = None  # (S,) of pixels
        if places is None:
            pair = matcher.prepare(image0, image0, mask0=mask0, mask1=mask0)
            self._image0, self._outputs0, self._mask0 = pair.image0, pair.outputs[0], pair.mask0
            self._points = check_pixels(xy, pair.image0.shape[1::-1])
            self._begin(pair)
        else:
            flat, self._points, counts = matcher.look_up_places(places, joint=True)
            self._image0, self._outputs0, self._mask0 = flat.image, flat.outputs, flat.mask
            self._counts = np.full(len(self._points), matcher.num_modes) if counts is None else counts

    def _begin(self, pair: Pair) -> None:
        """Where the points of the first picture lie there is known."""
        match, order = pair.match_everywhere(self._points)
        if match.absent is not None and match.absent[0] > LIKELY or len(match) == len(self._points):
            raise ValueError("image0 must show the object, none is seen in it: begin with another frame, or give mask0")
        if match.on_object is not None:
            self._on_object = match.on_object[: len(self._points)]
            if (off := self._on_object < LIKELY).any():
                warnings.warn(f"these pixels are more likely background: {self._points[off].tolist()}", stacklevel=3)
        lain = np.full((*order.shape, 2), np.nan)
        lain[:, 0] = match.xy  # the member that leaves all as it is
        self._remember(lain, _start(order.shape[1]))
        self._motion = _Motion(match.scale, (pair.image0, self._points))

    def update(self, image: Any, *, mask: Any = None) -> Tracked:
        """The points in the next frame, which is as large as those before; ``mask`` (H, W) bool is where it shows it.

        ValueError for an image or a mask that `Matcher.match` refuses.
        """
        self._frames += 1
        pair = self._prepare(image, mask)
        self._motion = self._motion or _Motion(compute_scale(pair.image1.shape[1::-1], self._matcher.size))
        match, order = pair.match_everywhere(self._points)
        absent = 0.0 if match.absent is None else float(match.absent[0])
        if absent > LIKELY:
            self._motion.forget()
            count = len(self._points) if self._counts is None else int(self._counts.sum())
            return Tracked(np.full((count, 2), np.nan), np.zeros(count), np.zeros(count), absent)
        modes = np.take_along_axis(match.modes, order[..., None], 1).astype(float)
        scores, columns = self._weigh(modes)
        self._seen += 1
        self._remember(modes, (scores, columns))
        chosen = int(scores.argmax())
        sure = 1 / np.exp(scores - scores[chosen]).sum()
        return self._take(match, order[:, columns[chosen]], sure, absent)

    def _prepare(self, image: Any, mask: Any) -> Pair:
        image, mask = take_image(self._matcher, image, mask)
        outputs = self._outputs0, *self._matcher.describe([image])
        return Pair(self._matcher, self._image0, image, outputs, self._mask0, mask)

    def _weigh(self, modes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How likely each of the maps (R, n, 2) is the first frame's, (n,), and whose the others then are, (n, n)."""
        n = modes.shape[1]
        if not self._memory:  # of places, any may be called the first
            return _start(n)
        scores, columns = np.full(n, -np.inf), np.empty((n, n), int)
        for before in self._memory:
            likelihood = compare_maps(before.modes, modes, self._frames - before.frame)  # (n, n)
            left_out = EVIDENCE * ANYWHERE * (self._seen - before.seen)
            for j, k in product(np.flatnonzero(np.isfinite(before.scores)), range(n)):
                whose, mean = assign_others(likelihood, j, k)
                score = before.scores[j] + EVIDENCE * mean + left_out
                if score > scores[k]:
                    scores[k], columns[k] = score, whose[before.columns[j]]
        return scores, columns

    def _remember(self, modes: np.ndarray, hypotheses: tuple[np.ndarray, np.ndarray]) -> None:
        self._memory.append(_Seen(self._frames, self._seen, modes, *hypotheses))

    def _take(self, match: Match, order: np.ndarray, sure: float, absent: float) -> Tracked:
        """The answer that the maps, in the first frame's ``order`` (R, n), give of the points."""
        count, n = len(self._points), order.shape[1]
        xy = np.take_along_axis(match.modes, order[..., None], 1)[:count]
        if self._counts is None:
            rows, columns = np.arange(count), np.zeros(count, int)
        else:
            self._columns = self._columns or [choose_apart(*pair) for pair in zip(xy, self._counts, strict=True)]
            rows, columns = np.repeat(np.arange(count), self._counts), np.concatenate(self._columns)
        own_first = np.argsort(np.arange(n) != columns[:, None], axis=1, kind="stable")
        order, match = np.take_along_axis(order[rows], own_first, 1), match[rows]
        modes, spread = (np.take_along_axis(v, order[..., None], 1) for v in (match.modes, match.spread_px[..., None]))
        places, chosen = self._motion.update(match.image1, modes.astype(float), spread[..., 0])
        taken = np.arange(len(rows)), np.take_along_axis(order, chosen[:, None], 1)[:, 0]
        visible = np.full(len(rows), np.nan) if match.visible is None else match.visible[taken]
        if self._on_object is not None:
            visible = np.where(self._on_object < LIKELY, np.fmin(visible, self._on_object), visible)
        return Tracked(places, visible, match.confidence()[taken] * sure, absent)


class _Motion:
    """Places of K points: by optical flow from the last frame, drawn to the modes that are found in each.

    Modes of one frame err like those of the next, flow adds its errors up: a Kalman filter weighs one by the other.
    Where flow does not come back, or leads away from all modes, and where the point's own mode has been another than
    the one it is near for `PATIENCE` frames, it is put at its own mode.
    """

    def __init__(self, scale: float, start: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        self._scale = scale  # px of a frame by px of an image as the model was taught with
        self._before: np.ndarray | None = None
        if start is not None:
            self._before, self._at = self._shrink(start[0]), start[1].astype(float)
            self._variance, self._strikes = np.zeros(len(self._at)), np.zeros(len(self._at), int)

    def _shrink(self, image: np.ndarray) -> np.ndarray:
        size = [max(32, round(side / max(self._scale, 1))) for side in image.shape[1::-1]]
        return cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)

    def forget(self) -> None:
        """The object is lost."""
        self._before = None

    def update(self, image: np.ndarray, modes: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (K, 2) px and the indices (K,) of the modes (K, n, 2) px, each one's own first, that they are near."""
        rows, grey = np.arange(len(modes)), self._shrink(image)
        if self._before is None:
            self._at, self._variance = np.full((len(modes), 2), np.nan), np.zeros(len(modes))
            self._strikes, self._before = np.zeros(len(modes), int), grey
        factor = np.array(grey.shape[::-1]) / image.shape[1::-1]
        moved, consistent = flow_there_and_back(self._before, grey, (self._at + 0.5) * factor - 0.5)
        moved = (moved + 0.5) / factor - 0.5
        gap = np.nan_to_num(np.linalg.norm(modes - moved[:, None], axis=-1), nan=np.inf)  # (K, n)
        near = gap.argmin(1)
        variance, error = self._variance + (DRIFT_PX * self._scale) ** 2, spread[rows, near] ** 2
        fits = consistent & (gap[rows, near] < GATE * np.sqrt(variance + error))
        self._strikes = np.where(fits & (near > 0), self._strikes + 1, 0)
        gain = np.where(fits, variance / (variance + ALIKE * error), 0.0)
        at = moved + gain[:, None] * np.nan_to_num(modes[rows, near] - moved)
        variance = np.where(fits, (1 - gain) * variance, DOUBT * variance)
        lost = (~consistent | (self._strikes >= PATIENCE)) & np.isfinite(modes[:, 0]).all(1)
        self._at = np.where(lost[:, None], modes[:, 0], at)
        self._variance = np.where(lost, spread[:, 0] ** 2, variance)
        self._before = grey
        return self._at.copy(), np.where(lost | ~fits, 0, near)


def flow_there_and_back(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (K, 2) px of a grey image are in another one, and whether flow takes them back, (K,) bool.

    OpenCV's pyramidal Lucas and Kanade; NaN stays NaN.
    """
    finite = np.isfinite(points).all(1)
    if not finite.any():
        return points.copy(), finite
    start = np.where(finite[:, None], points, 0).astype(np.float32)[:, None]
    moved, there, _ = cv2.calcOpticalFlowPyrLK(before, after, start, None)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None)
    near = np.linalg.norm((back - start)[:, 0], axis=1) < RETURN_PX
    return np.where(finite[:, None], moved[:, 0], np.nan), finite & near & (there & again > 0)[:, 0]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Maps of a frame that a step may start from; ``seen`` counts the frames that showed the object until then."""

    frame: int
    seen: int
    modes: np.ndarray  # (R, n, 2) px
    scores: np.ndarray  # (n,) log-likelihood of the best way to each map as the first frame's
    columns: np.ndarray  # (n, n) the maps of all members, should it be that one, the first frame's first


def _start(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Scores (n,) and columns (n, n) where the first map is the first frame's."""
    return np.where(np.arange(n), -np.inf, 0.0), np.tile(np.arange(n), (n, 1))


def compare_maps(before: np.ndarray, after: np.ndarray, age: int) -> np.ndarray:
    """(n, n) mean log-density that a map of (R, n, 2) px before moved to one after, ``age`` frames later.

    In units of the object's extent; NaN places do not count, and a map without any is as good as any other. How fast
    the object moves is not known: the pace counts that makes all maps together likeliest.
    """
    extent = max(float(np.sqrt(np.nanmean(np.sum((after - np.nanmean(after, (0, 1))) ** 2, -1)))), 1e-6)
    squared = np.sum((after[:, None] - before[:, :, None]) ** 2, -1) / extent**2  # (R, n, n)
    finite, likelihoods = np.isfinite(squared), []
    for pace in PACES:
        scale = min(pace * age, FARTHEST)
        density = -np.log(2 * np.pi * scale**2) - TAIL * np.log1p(squared / (2 * TAIL - 2) / scale**2)
        likelihoods.append(np.where(finite, density, 0.0).sum(0) / np.maximum(finite.sum(0), 1))
    return max(likelihoods, key=lambda likelihood: likelihood[linear_sum_assignment(-likelihood)].sum())


def assign_others(likelihood: np.ndarray, j: int, k: int) -> tuple[np.ndarray, float]:
    """Which map (n,) each one before became, if the j-th became the k-th, and the mean log-density (n, n) of these."""
    n = len(likelihood)
    rows, columns = np.delete(np.arange(n), j), np.delete(np.arange(n), k)
    whose = np.empty(n, int)
    whose[j] = k
    whose[rows] = columns[linear_sum_assignment(-likelihood[np.ix_(rows, columns)])[1]]
    return whose, float(likelihood[np.arange(n), whose].mean())


def choose_apart(xy: np.ndarray, count: int) -> np.ndarray:
    """Indices (count,) of places (n, 2) px far from each other, the first one first."""
    chosen, left = [0], np.linalg.norm(xy - xy[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.nan_to_num(left, nan=-1.0).argmax()))
        left = np.minimum(left, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.sort(chosen)


def follow(
    matcher: Matcher, frames: Iterable[Any], xy: Any = None, *, find: Any = None, mask0: Any = None
) -> Iterator[Tracked]:
    """As `Matcher.follow`."""
    tracker, size = None, None
    frames = open_video(frames) if isinstance(frames, str | os.PathLike) else frames
    for number, frame in enumerate(frames):
        image = to_rgb(frame, f"frame {number}")
        size = size or image.shape
        if image.shape != size:
            raise ValueError(f"frames must be as large as the first one, {size[1]} x {size[0]} px, got "
                             f"{image.shape[1]} x {image.shape[0]} px for frame {number}")  # fmt: skip
        if tracker is None:
            tracker = Tracker(matcher, image, xy, places=find, mask0=mask0)
        yield tracker.update(image)
