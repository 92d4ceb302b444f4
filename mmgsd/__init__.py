"""MMGSD: multi-modal Gaussian shape descriptors for correspondence matching of deformable objects."""

from typing import Any

__version__ = "0.1.0"
__all__ = ["Matcher", "load", "read_image"]


def __getattr__(name: str) -> Any:
    """Import torch only where it is used: the rendering's child processes do without it."""
    if name in __all__:
        from mmgsd import matching

        return getattr(matching, name)
    raise AttributeError(f"module 'mmgsd' has no attribute {name!r}")
