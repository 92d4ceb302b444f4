"""MMGSD: multi-modal Gaussian shape descriptors for correspondence matching of deformable objects."""

import importlib
from typing import Any

__version__ = "0.1.0"
_PLACES = {"Matcher": "match.matcher", "load": "match.matcher", "read_image": "images"}
__all__ = ["Matcher", "load", "read_image"]


def __getattr__(name: str) -> Any:
    """Import torch only where it is used: the rendering's child processes do without it."""
    if name in __all__:
        return getattr(importlib.import_module(f"mmgsd.{_PLACES[name]}"), name)
    raise AttributeError(f"module 'mmgsd' has no attribute {name!r}")
