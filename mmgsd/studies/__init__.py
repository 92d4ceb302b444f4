"""The studies, one a module: its rows, what is run, tables, figures, claims, and what a verdict compares.

    import mmgsd.studies as studies

    studies.run_study("sigma", "quick")                     # train, ask, write; the results file
    study = studies.open_study("sigma", "paper")            # or show what is stored
    studies.sigma, studies.parameters, …                    # a module of this package, imported when it is used
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mmgsd.studies.registry import get_study, list_studies, open_study, run_study, save_figures

__all__ = ["get_study", "list_studies", "open_study", "run_study", "save_figures"]


def __getattr__(name: str) -> Any:
    """Import a module of this package, and torch with it, only where it is used."""
    if name in __all__:
        return getattr(importlib.import_module("mmgsd.studies.registry"), name)
    if name.startswith("_") or importlib.util.find_spec(f"mmgsd.studies.{name}") is None:
        raise AttributeError(f"module 'mmgsd.studies' has no attribute {name!r}")
    return importlib.import_module(f"mmgsd.studies.{name}")
