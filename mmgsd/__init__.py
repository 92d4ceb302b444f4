"""MMGSD: multi-modal Gaussian shape descriptors for correspondence matching of deformable objects.

    matcher = mmgsd.load("cloth")
    image0, image1 = map(mmgsd.read_image, mmgsd.find_samples("cloth"))
    match = matcher.match(image0, image1, xy=[(235, 80)])

Images are (H, W, 3) uint8 in the order red, green, blue; OpenCV's are turned by ``image[..., ::-1]``.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mmgsd.images import read_image
    from mmgsd.learn.adapt import adapt
    from mmgsd.match.camera import compute_rays
    from mmgsd.match.match import Match
    from mmgsd.match.matcher import Matcher, load
    from mmgsd.match.track import Track, Tracker
    from mmgsd.paths import find_samples

__version__ = "0.1.0"
__all__ = ["Match", "Matcher", "Track", "Tracker", "adapt", "compute_rays", "find_samples", "load", "read_image"]
_PLACES = {"Match": "match.match", "Matcher": "match.matcher", "adapt": "learn.adapt", "compute_rays": "match.camera",
           "find_samples": "paths", "load": "match.matcher", "read_image": "images"}  # fmt: skip
_PLACES |= dict.fromkeys(("Track", "Tracker"), "match.track")


def __getattr__(name: str) -> Any:
    """Import torch only where it is used: the rendering's child processes do without it."""
    if name in __all__:
        return getattr(importlib.import_module(f"mmgsd.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'mmgsd' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *(name for name in globals() if name.startswith("__"))])
