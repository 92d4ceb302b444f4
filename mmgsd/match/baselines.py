"""What one would pick instead, asked the same dense question as a trained network: hand-made descriptors, SIFT and
ORB, and dense features of any network by nearest neighbours, such as ImageNet's or DINOv2's.

A descriptor is computed at each source pixel and at each cell of a regular grid on the target's object; a softmax over
their distances is the heatmap from which :mod:`mmgsd.match.matcher` reads the modes. Every window is 60 to 80 px wide,
several times the spacing of the material points. Descriptors are turned by the image's own orientation, estimated at
each pixel as SIFT and ORB do at their keypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy.ndimage
import torch
from torch import Tensor

from mmgsd.checks import check_choice
from mmgsd.images import check_pixels, check_question
from mmgsd.match.em import AS_IT_IS, ModeReadout
from mmgsd.match.features import Extractor, extract_dinov2, extract_imagenet, sample_features
from mmgsd.match.heatmap import make_match
from mmgsd.match.match import Match
from mmgsd.match.matcher import fill_question
from mmgsd.match.mixture import check_modes
from mmgsd.numerics import own_numerics

EXTRACTORS: dict[str, Extractor] = {"imagenet": extract_imagenet, "dinov2": extract_dinov2}
BASELINES = ("sift", "orb", "imagenet")
OPTIONAL = ("dinov2",)  # whose weights are no part of a clone: `mmgsd.extras.backbones` makes the file
STRIDE_PX = 16  # between the candidates on the object: about a cell of the trained networks
SHARPNESS = 2.0  # logits fall by this where the squared distance grows by its std over the object
PAD_PX = 80  # reflected border: every window lies inside the padded image, so no detector drops a keypoint
ANGLE_BINS, ANGLE_CELL_PX = 36, 4  # SIFT's orientation histogram; its gradients are pooled to cells of 4 px
ORB_RADIUS_PX = 30  # radius of the disc whose centroid gives ORB's orientation


@dataclass(frozen=True)
class Window:
    """Where a method's descriptor window lies in scale: nominal size in px, pyramid octave, scale-space level."""

    size_px: float
    octave: int = 0
    level: int = -1


WINDOWS = {
    "sift": Window(12.8, octave=2),  # std 6.4 = 1.6 * 2**2 px, window 6 sizes
    "orb": Window(62.0, octave=1),  # the 31 px patch at half the resolution
}


class FeatureMatcher:
    """Answers as `match.matcher.Matcher` does, by nearest neighbours among dense features that nothing here trained.

    ``extractor`` makes (D, h, w) numbers, NumPy or torch, of an image (H, W, 3) uint8; their grid covers the whole
    image. What counts is the angle between two places' features. ``modes`` are returned unless a question says others,
    read from the heatmap by ``readout``.
    """

    def __init__(self, extractor: Extractor, *, modes: int = 1, readout: ModeReadout = AS_IT_IS) -> None:
        if not callable(extractor):
            raise ValueError(f"extractor must be a function of an image, got {extractor!r:.80}")
        check_modes(modes)
        self.extractor, self.num_modes, self.readout = extractor, modes, readout

    def describe(self, image: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """Descriptors (S, D) at pixels (S, 2); ValueError for an extractor that makes something else."""
        return sample_features(self.extractor(image), xy, image.shape[1::-1])

    def compute_heatmaps(
        self, image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, mask1: np.ndarray
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Heatmaps (S, h, w) and the centres (w,), (h,) px of their cells."""
        heatmap, grid = compute_described_heatmap(image0, image1, xy, mask1, describe=self.describe)
        return torch.from_numpy(heatmap), (torch.from_numpy(grid[0, :, 0]), torch.from_numpy(grid[:, 0, 1]))

    @own_numerics()
    def match(
        self, image0: np.ndarray, image1: np.ndarray, xy: Any, *, n: Any = None,
        mask1: np.ndarray | None = None,
    ) -> Match:  # fmt: skip
        """As `Matcher.match`; ``mask1`` (H1, W1) bool tells where the object is in ``image1``, else anywhere."""
        image0, image1, points = check_question(image0, image1, xy)
        mask1 = np.ones(image1.shape[:2], bool) if mask1 is None else mask1
        cells, centres = self.compute_heatmaps(image0, image1, points, mask1)
        return make_match(image0, image1, points, cells, centres, n, fitted=self.num_modes, readout=self.readout)

    def match_many(self, questions: Iterable[tuple[Any, ...]], *, n: Any = None) -> Iterator[Match]:
        """As `Matcher.match_many`; what a mask0 says is not needed."""
        return (self.match(*question, n=n, mask1=mask1) for *question, _, mask1 in map(fill_question, questions))


class BaselineMatcher(FeatureMatcher):
    """The same of a method in `BASELINES` or `OPTIONAL`; ValueError for one not at hand."""

    def __init__(self, method: str, *, modes: int = 1, readout: ModeReadout = AS_IT_IS) -> None:
        check_choice("method", method, (*BASELINES, *OPTIONAL))
        super().__init__(EXTRACTORS.get(method, extract_imagenet), modes=modes, readout=readout)
        self.method = method

    def describe(self, image: np.ndarray, xy: np.ndarray) -> np.ndarray:
        """As `compute_descriptors`."""
        return compute_descriptors(image, xy, method=self.method)


def compute_described_heatmap(
    image0: np.ndarray, image1: np.ndarray, xy: np.ndarray, mask1: np.ndarray, *,
    describe: Callable[[np.ndarray, np.ndarray], np.ndarray], stride: int = STRIDE_PX,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Distribution over a grid on image1's object of where each source pixel of image0 matches.

    ``image0``, ``image1`` (H, W, 3) uint8 RGB, ``xy`` (S, 2) px in image0, ``mask1`` (H1, W1) bool; ``describe`` makes
    descriptors (S, K) of an image and pixels (S, 2) in it. Returns the heatmap (S, h, w) float32, which sums to 1 and
    is 0 off the object, and the cells' centres (h, w, 2) px: (i, j) lies at ``(stride - 1) / 2 + stride * (j, i)``.
    The heatmap is softmax(-d² / 2τ²) over the object's cells, d the descriptors' L2 or Hamming distance, 2τ² a query's
    own std of d² divided by SHARPNESS. Raises ValueError for other arguments, or a mask without any cell.
    """
    _check_image("image0", image0)
    _check_image("image1", image1)
    xy = check_pixels(xy, image0.shape[1::-1])
    grid = compute_grid(image1.shape[:2], stride=stride)
    on_object = _sample_mask(mask1, image1, grid)  # (h, w)
    source = describe(image0, xy)  # (S, K)
    target = describe(image1, grid[on_object])  # (N, K)
    heatmap = np.zeros((len(xy), *grid.shape[:2]), np.float32)
    heatmap[:, on_object] = _softmax_distances(compute_distances(source, target))
    return heatmap, grid


def compute_grid(shape: tuple[int, int], *, stride: int = STRIDE_PX) -> np.ndarray:
    """Centres (h, w, 2) px of the cells of ``stride`` px in an image of (H, W) px; ValueError where none fits."""
    if isinstance(stride, bool) or not isinstance(stride, int | np.integer) or not 1 <= stride <= min(shape):
        raise ValueError(f"stride must be an integer from 1 to the image's {min(shape)} px, got {stride!r}")
    rows, columns = (np.arange((stride - 1) / 2, size - 0.5, stride, dtype=np.float32) for size in shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def compute_descriptors(image: np.ndarray, xy: np.ndarray, *, method: str) -> np.ndarray:
    """Descriptors (S, K) float32 at the pixels ``xy`` (S, 2) of ``image`` (H, W, 3) uint8; bits are -1 and 1.

    Raises ValueError for another image, an unknown method, or one that the installed OpenCV lacks.
    """
    check_choice("method", method, (*BASELINES, *OPTIONAL))
    _check_image("image", image)
    xy = check_pixels(xy, image.shape[1::-1], image="the image")
    if method in EXTRACTORS:
        return sample_features(EXTRACTORS[method](image), xy, image.shape[1::-1])
    grey = np.pad(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), PAD_PX, mode="symmetric")
    if not len(xy):
        return np.zeros((0, 1), np.float32)
    return _describe_keypoints(grey, xy + PAD_PX, method)


def compute_distances(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared L2 distances (S, N) of descriptors (S, K) and (N, K), in one matrix product.

    Descriptors of bits as -1 and 1 give four times the Hamming distance.
    """
    if not len(source):
        return np.zeros((0, len(target)), np.float32)
    squared = (source**2).sum(1)[:, None] + (target**2).sum(1) - 2 * source @ target.T
    return np.maximum(squared, 0)


def compute_orientations(grey: np.ndarray, xy: np.ndarray, *, method: str) -> np.ndarray:
    """Orientation (S,) in degrees, from x towards y, at ``xy`` (S, 2) of a grey image (H, W) uint8.

    ``orb``: the direction of the intensity centroid of a disc (Rublee 2011); any other method: the peak of SIFT's
    Gaussian-weighted histogram of gradient directions (Lowe 2004, section 5), one peak a pixel.
    """
    return _orient_by_centroid(grey, xy) if method == "orb" else _orient_by_gradients(grey, xy)


def _softmax_distances(distances: np.ndarray) -> np.ndarray:
    # Contrast differs between methods and images: the scale is each query's own, so all are equally sharp.
    squared = distances - distances.min(axis=1, keepdims=True, initial=np.inf)
    logits = -SHARPNESS * squared / np.maximum(squared.std(axis=1, keepdims=True), 1e-6)
    mass = np.exp(logits)
    return mass / mass.sum(axis=1, keepdims=True)


def _describe_keypoints(grey: np.ndarray, xy: np.ndarray, method: str) -> np.ndarray:
    window = WINDOWS[method]
    angles = compute_orientations(grey, xy, method=method)
    keypoints = [
        cv2.KeyPoint(float(x), float(y), window.size_px, float(angle), 1.0, window.octave, window.level)
        for (x, y), angle in zip(xy, angles, strict=True)
    ]
    orb = method == "orb"
    extractor = cv2.ORB_create(scaleFactor=2.0, nlevels=2, edgeThreshold=0) if orb else cv2.SIFT_create()
    keypoints, descriptors = extractor.compute(grey, keypoints)
    assert len(keypoints) == len(xy), f"{method} dropped {len(xy) - len(keypoints)} keypoints"
    if orb:  # compared by Hamming distance
        bits = np.unpackbits(descriptors, axis=1)
        return 2 * bits.astype(np.float32) - 1
    return descriptors.astype(np.float32)


def _orient_by_centroid(grey: np.ndarray, xy: np.ndarray) -> np.ndarray:
    reach = np.arange(-ORB_RADIUS_PX, ORB_RADIUS_PX + 1, dtype=np.float32)
    dx = np.where(reach**2 + reach[:, None] ** 2 <= ORB_RADIUS_PX**2, reach, 0)  # x inside the disc
    moments = (cv2.filter2D(grey, cv2.CV_32F, kernel) for kernel in (dx, np.ascontiguousarray(dx.T)))
    m10, m01 = (_sample_nearest(moment, xy) for moment in moments)
    return np.degrees(np.arctan2(m01, m10)) % 360


def _orient_by_gradients(grey: np.ndarray, xy: np.ndarray) -> np.ndarray:
    std = WINDOWS["sift"].size_px / 2
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), std)
    dx, dy = cv2.Sobel(smooth, -1, 1, 0), cv2.Sobel(smooth, -1, 0, 1)
    magnitude, angle = cv2.cartToPolar(dx, dy, angleInDegrees=True)
    histograms = _pool_directions(magnitude, angle)  # (h, w, bins)
    spread = 1.5 * std / ANGLE_CELL_PX
    histograms = scipy.ndimage.gaussian_filter(histograms, (spread, spread, 1), mode=("nearest", "nearest", "wrap"))
    local = _sample_nearest(histograms, (xy + 0.5) / ANGLE_CELL_PX - 0.5)  # (S, bins)
    peak = local.argmax(1)
    left, top, right = (np.take_along_axis(local, ((peak + k) % ANGLE_BINS)[:, None], 1)[:, 0] for k in (-1, 0, 1))
    curvature = left - 2 * top + right  # parabola through the peak, as in SIFT
    shift = np.divide(0.5 * (left - right), curvature, out=np.zeros_like(top), where=np.abs(curvature) > 1e-9)
    return (peak + 0.5 + shift) * (360 / ANGLE_BINS) % 360


def _pool_directions(magnitude: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Histograms (h, w, bins) of gradient directions in cells of ANGLE_CELL_PX."""
    rows, columns = (np.arange(size) // ANGLE_CELL_PX for size in magnitude.shape)
    shape = (rows[-1] + 1, columns[-1] + 1, ANGLE_BINS)
    direction = (angle * (ANGLE_BINS / 360)).astype(np.int64) % ANGLE_BINS
    index = (rows[:, None] * shape[1] + columns) * ANGLE_BINS + direction
    counts = np.bincount(index.ravel(), weights=magnitude.ravel(), minlength=int(np.prod(shape)))
    return counts.reshape(shape).astype(np.float32)


def _sample_nearest(values: np.ndarray, xy: np.ndarray) -> np.ndarray:
    columns, rows = (np.rint(xy[:, k]).astype(int).clip(0, values.shape[1 - k] - 1) for k in (0, 1))
    return values[rows, columns]


def _sample_mask(mask: np.ndarray, image: np.ndarray, grid: np.ndarray) -> np.ndarray:
    mask = np.asarray(mask)
    if mask.dtype != bool or mask.shape != image.shape[:2]:
        raise ValueError(f"mask1 must be bool of shape {image.shape[:2]} like image1, got {mask.dtype} {mask.shape}")
    inside = _sample_nearest(mask, grid.reshape(-1, 2)).reshape(grid.shape[:2])
    if not inside.any():
        raise ValueError("mask1 must hold at least one cell of the grid, got none: is the object in the image?")
    return inside


def _check_image(name: str, image: np.ndarray) -> None:
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        got = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{name} must be an RGB image, (H, W, 3) uint8, got {got}")
    if min(image.shape[:2]) < 16:
        raise ValueError(f"{name} must be at least 16 px wide and high, got shape {image.shape}")
