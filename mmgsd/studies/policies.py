"""Who answers: from a demonstration's look and a picture of the present state to the pixels of picks and places."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mmgsd.config import DEFAULT_GROUP, load_preset
from mmgsd.fold.demonstration import Look
from mmgsd.fold.moves import AGREE, BEST, JOINT, match_look
from mmgsd.match.baselines import BaselineMatcher
from mmgsd.match.match import Match
from mmgsd.match.matcher import Matcher, find_weights
from mmgsd.model.tensors import WEIGHTS
from mmgsd.paths import Paths, find_root
from mmgsd.studies.models import configure_model, get_colour
from mmgsd.symmetry import load_group

TRAINED_BY = "quick"  # preset whose models of an equal, small budget are compared
VERSION = 4  # to be raised where a policy answers the same question otherwise than before


@dataclass(frozen=True)
class Policy:
    """A row of the bench: a matcher and how its modes are chosen; the true matches and chance have none."""

    name: str
    label: str
    colour: str
    matcher: str = ""  # what follows the object in the name of shipped weights ("" with ``chosen``), or a baseline
    chosen: str = ""
    # instead of shipped weights: the row of the main table that the preset `TRAINED_BY` trained
    trained: str = field(default="", repr=False)  # the weights themselves are what an answer depends on
    weights: Path | None = field(default=None, repr=False)  # or this file
    one: bool = field(default=False, repr=False)  # answers with one mode, as what learnt one match a pixel does
    named: bool = field(default=False, repr=False)  # looks for places by name, whatever the demonstration's picture
    looks: int = 1  # where few of its modes agree, it looks so often, each time from elsewhere, before it acts


POLICIES = {
    policy.name: policy
    for policy in (
        Policy("truth", "true matches", "#404040"),
        Policy("mmgsd", "MMGSD, modes that agree", "#D55E00", "", AGREE),
        Policy("mmgsd_again", "the same, looks again if unsure", "#8A3500", "", AGREE, looks=3),
        Policy("mmgsd_named", "MMGSD, places by name, modes that agree", "#E69F00", "", AGREE, named=True),
        Policy("mmgsd_joint", "MMGSD, surest joint answer", "#F0A070", "", JOINT),
        Policy("mmgsd_best", "MMGSD, each pixel's surest", "#A6761D", "", BEST),
        Policy("mmgsd_paper", "MMGSD of clean images alone, modes that agree", "#B22222", "-paper", AGREE),
        Policy("spcl", "SPCL, modes that agree", "#0072B2", "-spcl", AGREE),
        Policy("sift", "SIFT, modes that agree", "#CC79A7", "sift", AGREE),
        Policy("imagenet", "ImageNet features, modes that agree", "#117733", "imagenet", AGREE),
        *(Policy(f"quick_{name}", f"{label}, as `{TRAINED_BY}` trains it", get_colour(name), "", AGREE, name)
          for name, label in (("mmgsd", "MMGSD"), ("spcl", "SPCL"), ("unimodal", "Unimodal"), ("pcl", "PCL"))),
        Policy("quick_one", f"Unimodal, as `{TRAINED_BY}` trains it, one mode", get_colour("unimodal"), "", AGREE,
               "unimodal", one=True),
        Policy("random", "random points", "#9A9A9A"),
        Policy("nothing", "nothing is done", "#CCCCCC"),
    )
}  # fmt: skip


SHIPPED = tuple(policy for policy in POLICIES.values() if not policy.trained and policy.name != "nothing")


@cache
def load_matcher(policy: Policy, object: str) -> Any:
    """What answers a policy's questions about an object."""
    if policy.matcher.isalpha():
        return BaselineMatcher(policy.matcher, modes=load_group(object, DEFAULT_GROUP[object]).order)
    return Matcher.load(find_answering(policy, object))


def find_answering(policy: Policy, object: str) -> Path:
    """The file of weights that answers; FileNotFoundError for a model that is not trained yet."""
    if policy.weights:
        return policy.weights
    if not policy.trained:
        return find_weights(object + policy.matcher)
    model = configure_model(load_preset(TRAINED_BY), object, policy.trained)
    path = Paths(find_root(), TRAINED_BY).model(model) / WEIGHTS
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there: `make reproduce` trains the models of the preset {TRAINED_BY}")
    return path


@cache
def digest_policy(policy: Policy, object: str) -> str:
    """What a policy's answers depend on beside the pictures and the demonstration."""
    weights = "" if policy.matcher.isalpha() or not policy.chosen else find_answering(policy, object)
    content = weights.read_bytes() if weights else b""
    return hashlib.sha256(repr((VERSION, policy)).encode() + content).hexdigest()[:16]


def ask(policy: Policy, object: str, look: Look, image: np.ndarray, mask: np.ndarray) -> Match:
    """The matches of a look's picks and anchors in an image; baselines are told the object's ``mask`` (H, W) bool.

    As many modes as the symmetry has members are asked for, also of methods that learnt one match a pixel.
    """
    matcher, order = load_matcher(policy, object), load_group(object, DEFAULT_GROUP[object]).order
    options = {"mask1": mask} if isinstance(matcher, BaselineMatcher) else {"joint": policy.chosen == JOINT}
    return match_look(matcher, look, image, by_name=policy.named, n=1 if policy.one else order, **options)


def draw_moves(look: Look, mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Moves (M, 2, 2) px between random pixels of the object's mask (H, W); none where it shows nothing."""
    pixels = np.argwhere(mask)[:, ::-1]
    if not len(pixels):
        return np.zeros((0, 2, 2))
    return rng.choice(pixels, (len(look.moves), 2)).astype(float)
