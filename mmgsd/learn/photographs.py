"""Photographs as training images: marks, and the model's own sure answers, take the part of material points.

A batch knows matches by numbers of points and a group that permutes them. The marks of a cloth's corners or a rope's
ends have the numbers of these points. To any others, and to pixels of which the model is sure, numbers are added: a
block of as many as the group has members, which it permutes in a circle, so that all in a block match each other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
import torch

from mmgsd.images import check_aspect
from mmgsd.learn.augmentation import CACHE_SCALE, Batch, TrainingImages, rescale
from mmgsd.match.joint import spread_places
from mmgsd.match.matcher import Matcher
from mmgsd.match.pair import Pair
from mmgsd.measure.photographs import ENDS, Photograph
from mmgsd.model.heads import Outputs, look_up
from mmgsd.model.network import compute_input_size
from mmgsd.symmetry import SymmetryGroup

SURE = 8  # pixels of a photograph, at most, whose matches in it the model is sure of
ASKED = 64  # pixels of each that it is asked about
LEAST_CONFIDENCE = 0.5  # of each match of a pixel
NEAR = 0.04  # of an image's longer side: so far from itself a pixel's own match may lie
MARK = 0.02  # likewise: radius around a mark that is taken for the object
OFF_OBJECT = 0.05  # probability that a mark lies on the object, below which it is said to lie off it
NOWHERE = -1e5  # px: of points that a photograph does not show


def prepare_photographs(
    photographs: Sequence[Photograph], matcher: Matcher, group: SymmetryGroup
) -> tuple[TrainingImages, np.ndarray]:
    """Photographs as images of the training's size, and the group on all of their points, (G, P + added).

    ValueError, which names the file, for one that cannot be read, has marks outside it or off the object, or more of
    them than look alike; and where nothing can be learnt from any.
    """
    turns = np.arange(group.order)
    circle = group.n_points + (turns[:, None] + turns) % group.order  # (G, G) the group on the first added block
    added = [circle + group.order * block for block in range(1 + SURE * len(photographs))]
    permutations = np.concatenate([group.permutations, *added], axis=1)
    xy = np.full((len(photographs), permutations.shape[1], 2), NOWHERE)
    visible, images, masks = np.zeros(xy.shape[:2], bool), [], []
    for number, photograph in enumerate(photographs):
        image = photograph.read()
        check_aspect(image.shape[1::-1], str(photograph.path))
        outputs = matcher.describe([image])[0]
        mask, marked = _find_mask(matcher, outputs, photograph, image), _number_marks(photograph, group, matcher.object)
        sure = _find_sure(matcher, image, outputs, mask)  # (S, G, 2)
        first = group.n_points + group.order * (1 + SURE * number)
        answered = first + np.arange(sure.shape[0] * sure.shape[1])
        xy[number, marked], xy[number, answered] = photograph.xy, sure.reshape(-1, 2)
        visible[number, [*marked, *answered[:: group.order]]] = True  # of an answer, the pixel itself is asked about
        fitted = _fit(image, mask, photograph, matcher, xy[number])
        images.append(fitted[0]), masks.append(fitted[1])
        xy[number], visible[number] = fitted[2], visible[number] & (fitted[2] > NOWHERE).all(1)
    if not visible.any():
        raise ValueError("folder must hold photographs with marks, or such as the weights are sure of in places: mark "
                         f"some, got {len(photographs)} without a mark that they know nothing of")  # fmt: skip
    return TrainingImages(images, masks, xy, visible, matcher.size), permutations


def take(images: TrainingImages, chosen: Sequence[int]) -> TrainingImages:
    """Some of the images."""
    lists = {name: [getattr(images, name)[k] for k in chosen] for name in ("images", "masks")}
    return dataclasses.replace(images, **lists, xy=images.xy[chosen], visible=images.visible[chosen])


def add_points(images: TrainingImages, count: int) -> TrainingImages:
    """The same with ``count`` points in all, of which they do not show the added ones."""
    added = ((0, 0), (0, count - images.xy.shape[1]))
    xy = np.pad(images.xy, (*added, (0, 0)), constant_values=NOWHERE)
    mirror = images.mirror if images.mirror is None else np.r_[images.mirror, len(images.mirror) : count]
    return dataclasses.replace(images, xy=xy, visible=np.pad(images.visible, added), mirror=mirror)


def join_batches(batches: Sequence[Batch]) -> Batch:
    """One batch of all images; ValueError where their sizes or numbers of points differ."""
    fields = [field.name for field in dataclasses.fields(Batch)]
    return Batch(*(torch.cat([getattr(batch, name) for batch in batches]) for name in fields))


def _number_marks(photograph: Photograph, group: SymmetryGroup, kind: str) -> np.ndarray:
    """The numbers of the points that a photograph's marks are, (k,)."""
    points = ENDS[kind][1] if kind in ENDS and photograph.by != "marks" else ()
    is_orbit = bool(points) and {*points} == {*group.orbit(points[0])}
    numbers = np.array(points) if is_orbit else group.n_points + np.arange(group.order)
    if len(photograph.xy) > len(numbers):
        raise ValueError(f"{photograph.path} must have at most {len(numbers)} marks, as many places as look alike "
                         f"under the group {group.name!r}, got {len(photograph.xy)}")  # fmt: skip
    return numbers[: len(photograph.xy)]


def _find_mask(matcher: Matcher, outputs: Outputs, photograph: Photograph, image: np.ndarray) -> np.ndarray:
    """(H, W) uint8, 255 where the model sees the object and at the marks; empty of weights without masks."""
    size, mask = image.shape[1::-1], np.zeros(image.shape[:2], np.uint8)
    if outputs.mask is None:
        return mask
    on_object = look_up(None, outputs.mask, photograph.xy, size)
    if len(on_object) and on_object.max() < OFF_OBJECT:
        raise ValueError(f"{photograph.path} must have marks on the object: the weights see none near any of them; "
                         "mark it anew, leave it out, or give weights of what it shows")  # fmt: skip
    mask[matcher.resize_mask(outputs.mask, size) >= 0.5] = 255
    for x, y in photograph.xy:
        cv2.circle(mask, (round(x), round(y)), max(1, round(MARK * max(size))), 255, cv2.FILLED)
    return mask


def _find_sure(matcher: Matcher, image: np.ndarray, outputs: Outputs, mask: np.ndarray) -> np.ndarray:
    """Pixels with their matches in the same image (S, G, 2), each pixel first, where the model is sure of all."""
    places, group = spread_places(mask > 0, ASKED), matcher.num_modes
    if not len(places):
        return np.zeros((0, group, 2))
    answer = Pair(matcher, image, image, (outputs, outputs)).match(places)
    distance = np.linalg.norm(answer.modes - places[:, None], axis=-1) / max(image.shape[:2])  # (S, G), NaN: merged
    sure = np.where(np.isnan(distance).any(1) | (distance.min(1) > NEAR), 0, answer.confidence().min(1))
    order = np.argsort(-sure, kind="stable")[:SURE]
    order = order[sure[order] >= LEAST_CONFIDENCE]
    own_first = np.argsort(distance[order], axis=1)[..., None]
    modes = np.take_along_axis(answer.modes[order], own_first, 1).astype(float)
    modes[:, 0] = places[order]
    return modes


def _fit(
    image: np.ndarray, mask: np.ndarray, photograph: Photograph, matcher: Matcher, xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A photograph, its mask and points (P, 2), cut or continued at its edges to the aspect of the training's images.

    It is as large as the network sees it when it answers: of as many pixels as they. What is cut off lies far from the
    marks, or from the middle.
    """
    inner = np.array([round(s * CACHE_SCALE) for s in compute_input_size(matcher.size, matcher.config.input_px)])
    old = np.array(image.shape[1::-1])
    fitted = np.maximum(1, np.rint(old * np.sqrt(inner.prod() / old.prod()))).astype(int)
    middle = rescale(photograph.xy.mean(0), old, fitted) if len(photograph.xy) else fitted / 2
    spare = fitted - inner
    low, high = np.minimum(0, spare) // 2, np.maximum(spare, spare // 2)
    corner = np.clip(np.rint(middle - inner / 2).astype(int), low, high)
    before, after = np.maximum(0, -corner), np.maximum(0, corner + inner - fitted)
    padding = before[1], after[1], before[0], after[0]
    (left, top), (width, height) = np.maximum(0, corner), inner
    planes = []
    for plane, border in ((image, cv2.BORDER_REPLICATE), (mask, cv2.BORDER_CONSTANT)):
        small = cv2.resize(plane, fitted.tolist(), interpolation=cv2.INTER_AREA)
        padded = cv2.copyMakeBorder(small, *map(int, padding), border)
        planes.append(np.ascontiguousarray(padded[top : top + height, left : left + width]))
    moved = rescale(xy, old, fitted) - corner
    inside = (xy > NOWHERE).all(1) & (moved > -0.5).all(1) & (moved < inner - 0.5).all(1)
    return *planes, np.where(inside[:, None], rescale(moved, inner, np.array(matcher.size)), NOWHERE)
