"""Who answers: from a demonstration's look and a picture of the present state to the pixels of picks and places."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from mmgsd.checks import check_choice
from mmgsd.config import DEFAULT_GROUP
from mmgsd.fold.agreement import RADIUS, Motion, find_agreement, fit_motion_to, to_complex
from mmgsd.fold.demonstration import Look
from mmgsd.match.baselines import BaselineMatcher
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.symmetry import load_group

Plane = Callable[[np.ndarray], np.ndarray]  # pixels (…, 2) to places (…, 2) of the plane that motions are in
AGREE, BEST = "agree", "best"  # how one mode of each question is chosen


@dataclass(frozen=True)
class Policy:
    """A row of the bench: a matcher and how its modes are chosen; the true matches and chance have none."""

    name: str
    label: str
    colour: str
    matcher: str = ""  # what follows the object in the name of shipped weights ("" with ``chosen``), or a baseline
    chosen: str = ""


POLICIES = {
    policy.name: policy
    for policy in (
        Policy("truth", "true matches", "#404040"),
        Policy("mmgsd", "MMGSD, modes that agree", "#D55E00", "", AGREE),
        Policy("mmgsd_best", "MMGSD, each pixel's surest", "#A6761D", "", BEST),
        Policy("spcl", "SPCL, modes that agree", "#0072B2", "-spcl", AGREE),
        Policy("daisy", "DAISY, modes that agree", "#E69F00", "daisy", AGREE),
        Policy("sift", "SIFT, modes that agree", "#CC79A7", "sift", AGREE),
        Policy("random", "random points", "#9A9A9A"),
    )
}


@dataclass(frozen=True, eq=False)
class Answer:
    """Moves (M, 2, 2) of the plane, pick and place; none where nothing agrees. ``motion`` is kept for later looks."""

    moves: np.ndarray
    motion: Motion | None
    share: float  # of the questions that agree with the motion


def find_policy(name: str) -> Policy:
    """The policy of a name; ValueError, which names the accepted, for any other."""
    check_choice("policy", name, tuple(POLICIES))
    return POLICIES[name]


@cache
def load_matcher(policy: Policy, object: str) -> Any:
    """What answers a policy's questions about an object."""
    if policy.matcher.isalpha():
        return BaselineMatcher(policy.matcher, modes=load_group(object, DEFAULT_GROUP[object]).order)
    return Matcher.load(find_weights(object + policy.matcher))


@cache
def digest_policy(policy: Policy, object: str) -> str:
    """What a policy's answers depend on beside the pictures."""
    weights = "" if policy.matcher.isalpha() or not policy.chosen else find_weights(object + policy.matcher)
    content = weights.read_bytes() if weights else b""
    return hashlib.sha256(repr(policy).encode() + content).hexdigest()[:16]


def ask(policy: Policy, object: str, look: Look, image: np.ndarray, mask: np.ndarray) -> Match:
    """The matches of a look's picks and anchors in an image; baselines are told the object's ``mask`` (H, W) bool."""
    matcher = load_matcher(policy, object)
    told = {"mask1": mask} if isinstance(matcher, BaselineMatcher) else {}
    return matcher.match(look.image, image, look.asked, **told)


def choose_moves(
    look: Look, match: Match, chosen: str, seen: Plane, shown: Plane, *, motion: Motion | None = None,
    free_scale: bool = False,
) -> Answer:  # fmt: skip
    """Picks and places from the matches of a look's picks and anchors (`Look.asked`).

    ``seen`` and ``shown`` take pixels of the look's image and of the new one to the plane. "agree": the motion that
    most modes agree with, or that of an earlier look; each pick is its mode near to where the motion takes it, or that
    place. "best": each pixel's `Match.best`, and the motion that fits them all. Places are where the motion takes them.
    """
    asked, modes = seen(look.asked), shown(match.modes)
    picks, places = seen(look.moves[:, 0]), seen(look.moves[:, 1])
    if chosen == BEST:
        surest = shown(match.best().xy)
        known = np.isfinite(surest).all(1)
        if not known[: len(picks)].all() or known.sum() < 2:
            return Answer(np.zeros((0, 2, 2)), None, 0.0)
        motion = fit_motion_to(asked[known], surest[known], free_scale=free_scale)
        return Answer(np.stack([surest[: len(picks)], motion.apply(places)], 1), motion, float(known.mean()))
    share = 1.0
    if motion is None:
        agreement = find_agreement(asked, modes, match.weights, free_scale=free_scale)
        if agreement is None:
            return Answer(np.zeros((0, 2, 2)), None, 0.0)
        motion, share = agreement.motion, agreement.share
    reach = 2 * RADIUS * float(np.abs(to_complex(asked - asked.mean(0))).max()) * abs(motion.factor)
    wanted = motion.apply(picks)  # (M, 2)
    distance = np.nan_to_num(np.linalg.norm(modes[: len(picks)] - wanted[:, None], axis=-1), nan=np.inf)  # (M, n)
    nearest = distance.argmin(1)
    near = distance[np.arange(len(picks)), nearest] <= reach
    grasped = np.where(near[:, None], modes[np.arange(len(picks)), nearest], wanted)
    return Answer(np.stack([grasped, motion.apply(places)], 1), motion, share)


def draw_moves(look: Look, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Moves (M, 2, 2) px between random pixels of the object's mask (H, W); none where it shows nothing."""
    pixels = np.argwhere(mask)[:, ::-1]
    if not len(pixels):
        return np.zeros((0, 2, 2))
    return rng.choice(pixels, (len(look.moves), 2)).astype(float)
