"""Checks whose ValueError names the argument, what was received and what is accepted."""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
import warnings
from collections.abc import Collection
from typing import Any


def check(name: str, value: Any, accepted: str, ok: bool) -> None:
    """ValueError that says what is ``accepted`` where a value is not ``ok``."""
    if not ok:
        raise ValueError(f"{name} must be {accepted}, got {value!r}")


def describe_choices(value: Any, choices: Collection[str]) -> str:
    """The choices, and which of them is the nearest to a value: "one of 'a', 'b' (did you mean 'a'?)"."""
    close = difflib.get_close_matches(str(value), choices, n=1)
    return f"one of {', '.join(map(repr, choices))}" + (f" (did you mean {close[0]!r}?)" if close else "")


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """ValueError that names the argument and the choices, the nearest one too, where ``value`` is none of them."""
    check(name, value, describe_choices(value, choices), value in choices)


FLAGS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def read_flag(name: str, value: Any) -> bool:
    """A flag from a boolean, 0 or 1, or its usual spellings ("true", "No", "off"); ValueError names it otherwise.

    papermill hands ``-p overwrite false`` over as a string, which Python takes for true.
    """
    word = str(value).strip().lower()
    check(name, value, "true or false (yes, no, on, off, 1, 0)", word in FLAGS)
    return FLAGS[word]


def read_count(name: str, value: Any, *, least: int = 0) -> int:
    """An integer of at least ``least``; ValueError names it otherwise, also where it is a string or a boolean."""
    check(name, value, "an integer", isinstance(value, numbers.Integral) and not isinstance(value, bool))
    check(name, value, f"at least {least}", value >= least)
    return int(value)


def check_types(config: Any) -> None:
    """Reject values whose type is not the field's: a string steps='200' would fail much later."""
    kinds = {"int": int, "float": (int, float), "str": str, "bool": bool}
    for field in dataclasses.fields(config):
        value, kind = getattr(config, field.name), str(field.type)
        wrong_bool = isinstance(value, bool) and kind != "bool"
        if wrong_bool or not isinstance(value, kinds[kind]) or (kind == "float" and not math.isfinite(value)):
            raise ValueError(f"{field.name} must be {'a finite float' if kind == 'float' else kind}, got {value!r}")
        if kind == "float":  # 1 and 1.0 are one configuration, with one digest
            object.__setattr__(config, field.name, float(value))


def renamed(old: str, new: str) -> property:
    """An attribute under its former name ``old``, which warns and gives that of the ``new`` one."""

    def get(self: object) -> Any:
        """The value of the present name."""
        warnings.warn(f"{type(self).__name__}.{old} is called {new} now", DeprecationWarning, stacklevel=2)
        return getattr(self, new)

    get.renamed = new
    return property(get, doc=f"Deprecated: `{new}` is its present name.")
