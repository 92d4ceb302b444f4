"""From matches to moves: which modes are grasped, and where what is grasped is laid down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mmgsd.checks import check_choice, read_flag
from mmgsd.fold.consensus import (
    MAX_FREE_SCALE,
    RADIUS,
    Motion,
    assign_grasps,
    find_consensus,
    find_extent,
    fit_motion_to,
    refine_motion,
)
from mmgsd.fold.demonstration import Demonstration, Look
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher

Plane = Callable[[np.ndarray], np.ndarray]  # pixels (…, 2) to places (…, 2) of the plane that motions are in
AGREE, BEST, JOINT = "agree", "best", "joint"  # how one mode of each query is chosen
RIGID = 0.7  # share of the queries that agree where an object lies as it was shown
LEAST = 0.5  # share of the queries that must agree before a picture of a user's is answered


@dataclass(frozen=True, eq=False)
class PolicyAnswer:
    """Moves (M, 2, 2) of the plane, pick and place; none where nothing agrees. ``motion`` is kept for later looks."""

    moves: np.ndarray
    motion: Motion | None
    share: float  # of the queries that agree with the motion


def choose_moves(
    look: Look, match: Match, chosen: str, look_to_plane: Plane, image_to_plane: Plane, *, motion: Motion | None = None,
    free_scale: bool = False,
) -> PolicyAnswer:  # fmt: skip
    """Picks and places from the matches of a look's picks and anchors (`Look.asked`).

    ``seen`` and ``shown`` take pixels of the look's image and of the new one to the plane. "agree": the motion that
    most modes agree with, or that of an earlier look; each pick is its mode near to where the motion takes it, or that
    place. Where less than `RIGID` agree, the object is bent otherwise than shown: the motion is the best for all, and
    each pick its nearest mode. "best": each pixel's `Match.best`, and the motion that fits them all; "joint" the same,
    for a ``match`` that is joint: all take the same member of the symmetry. Places are where the motion takes them.
    """
    queries, modes = look_to_plane(look.asked), image_to_plane(match.modes)
    picks, places = look_to_plane(look.moves[:, 0]), look_to_plane(look.moves[:, 1])
    if chosen in (BEST, JOINT):
        surest = image_to_plane(match.best().xy)
        finite = np.isfinite(surest).all(1)
        if not finite[: len(picks)].all() or finite.sum() < 2:
            return PolicyAnswer(np.zeros((0, 2, 2)), None, 0.0)
        motion = fit_motion_to(queries[finite], surest[finite], free_scale=free_scale)
        return PolicyAnswer(np.stack([surest[: len(picks)], motion.apply(places)], 1), motion, float(finite.mean()))
    share, bent = 1.0, False
    if motion is None:
        consensus = find_consensus(queries, modes, match.weights, free_scale=free_scale)
        if consensus is None:
            return PolicyAnswer(np.zeros((0, 2, 2)), None, 0.0)
        motion, share = consensus
        bent = share < RIGID
    if bent:
        motion = refine_motion(queries, modes, motion, free_scale=free_scale)
    wanted = motion.apply(picks)  # (M, 2)
    radius = RADIUS * find_extent(queries) * abs(motion.factor)
    grasped = assign_grasps(picks, modes[: len(picks)], motion, min_distance=radius)
    reach = np.inf if bent else 2 * radius
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(grasped - wanted, axis=1) <= reach  # not where it is NaN
    return PolicyAnswer(np.stack([np.where(near[:, None], grasped, wanted), motion.apply(places)], 1), motion, share)


def match_look(matcher: Matcher, look: Look, image: np.ndarray, *, by_name: bool = False, **how: Any) -> Match:
    """The matches of a look's picks and anchors, found by their pixels in its image or by its places' names.

    ``how`` is as `Matcher.match` has it. ValueError where the look, or the weights, know no places.
    """
    if not by_name:
        return matcher.match(look.image, image, look.asked, **how)
    if not look.places:
        raise ValueError("places must be named in the demonstration's look where it is asked by_name")
    return matcher.find(image, list(look.places), **how)


def answer_picture(
    matcher: Matcher, demonstration: Demonstration, image: np.ndarray, *, look: int = 0, chosen: str = AGREE,
    by_name: bool = False,
) -> PolicyAnswer:  # fmt: skip
    """Moves (M, 2, 2) px in a picture (H, W, 3) uint8 of the present state, as one look of a demonstration made them.

    The picture is taken from about where the demonstration's was: a turn, a shift and a scale lead from one to the
    other; ``chosen`` is as `choose_moves` has it. ``by_name`` the look's places are looked for instead of its pixels.
    ValueError for a look that there is not, or that names no places, weights of another object, a picture that does not
    show the object, a pick off the object, picks that are answered by one place, and where fewer than `LEAST` of the
    look's picks and anchors agree.
    """
    count = len(demonstration.looks)
    if look not in range(count):
        raise ValueError(f"look must be from 0 to {count - 1}, got {look!r}")
    if matcher.object and matcher.object != demonstration.object:
        raise ValueError(f"weights must be of the demonstration's object {demonstration.object!r}, got weights of "
                         f"{matcher.object!r}")  # fmt: skip
    check_choice("chosen", chosen, (AGREE, BEST, JOINT))
    reference = demonstration.looks[look]
    match = match_look(matcher, reference, image, by_name=read_flag("by_name", by_name), joint=chosen == JOINT)
    if match.on_object is not None and (match.on_object < 0.5).any():
        off = reference.asked[match.on_object < 0.5].tolist()
        raise ValueError(f"picks and anchors must be on the object of the demonstration, these are not: {off}")
    if match.absent is not None and match.absent[0] > 0.5:
        raise ValueError(f"the picture must show a {demonstration.object}, none is seen in it")
    zoom = _estimate_zoom(matcher, reference, match, by_name=by_name)
    answer = choose_moves(reference, match, chosen, lambda xy: zoom * xy, np.asarray, free_scale=True)
    if answer.share < LEAST:
        raise ValueError(f"the picture's answers must agree with the demonstration, {answer.share:.0%} of them do: "
                         "take it from where the demonstration was taken, or add anchors")  # fmt: skip
    if find_extent(answer.moves[:, 0]) * MAX_FREE_SCALE < zoom * find_extent(reference.moves[:, 0]):
        raise ValueError("the picture's answers to the picks must lie apart as these do, chosen by "
                         f"{chosen!r} they are at one place, {answer.moves[0, 0].round().tolist()}: choose another of "
                         f"{[AGREE, JOINT]}")  # fmt: skip
    motion = answer.motion and Motion(zoom * answer.motion.factor, answer.motion.shift)
    return PolicyAnswer(answer.moves, motion, answer.share)


def _estimate_zoom(matcher: Matcher, look: Look, match: Match, *, by_name: bool) -> float:
    """How much larger the object is in a new picture: by how far all answers lie from each other, in both pictures.

    Where the look's picture is not asked about, by the pictures' sizes: one of more pixels is none from nearer by.
    """
    if not by_name:
        own = matcher.match(look.image, look.image, look.asked)
        before, after = (_measure_spread(each.modes) for each in (own, match))
        if before > 0 and after > 0:
            return after / before
    return max(match.image1.shape[:2]) / max(look.image.shape[:2])


def _measure_spread(modes: np.ndarray) -> float:
    """The root mean square distance of modes (S, n, 2) from their mean; 0 of none."""
    places = modes[np.isfinite(modes).all(-1)]
    return float(np.sqrt(((places - places.mean(0)) ** 2).sum(1).mean())) if len(places) else 0.0
