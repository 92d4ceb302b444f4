"""What a study says of a claim of the paper's: which parts of it held, by a rule that is written down.

A part is True, False, or None where it was not measured; the verdict follows from these alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

HELD, IN_PART, NOT_HELD, NOT_MEASURED = "held", "held in part", "did not hold", "not measured"
MARGIN = 0.05  # two errors that differ by less are not told apart: one training each, one seed
FOUND = 0.5  # a method fails that finds less than this share of the matches within 20 px
RANKED = 0.3  # rank correlation from which entropy is said to rank the errors
NATS = 0.05  # entropies that differ by less are not told apart: 5 % of the area


@dataclass(frozen=True)
class Claim:
    """One claim; texts are Markdown, ``key`` is what the report asks its verdict by."""

    key: str
    claim: str
    rule: str
    measured: str
    parts: tuple[bool | None, ...]
    command: str = ""  # that repeats it; "" is the study's notebook
    models: tuple[str, ...] = ()  # rows of runs.json whose minutes it took
    runs: str = ""  # instead: the results file that says what its rows took, all of them or all seeds of ``models``

    @property
    def verdict(self) -> str:
        """What `judge` says of the parts."""
        return judge(self.parts)


def judge(parts: Sequence[bool | None]) -> str:
    """``held`` where all parts do, ``did not hold`` where no measured one does, ``held in part`` between.

    A part that was not measured keeps a claim from being held; with none measured it is ``not measured``.
    """
    measured = [part for part in parts if part is not None]
    if not measured:
        return NOT_MEASURED
    if not any(measured):
        return NOT_HELD
    return HELD if all(parts) else IN_PART


def is_better(error: float | None, reference: float | None) -> bool | None:
    """Whether an error is lower by more than ``MARGIN``; None where either is missing."""
    if error is None or reference is None:
        return None
    return error < (1 - MARGIN) * reference


def is_at_least(value: float | None, bound: float | None) -> bool | None:
    """Whether ``value`` reaches ``bound``; None where either is missing."""
    return None if value is None or bound is None else value >= bound


def is_above(nats: float | None, others: float | None) -> bool | None:
    """Whether an entropy is higher by `NATS` or more; None where either is missing."""
    return is_at_least(nats, None if others is None else others + NATS)


def fails(share: float | None) -> bool | None:
    """Whether a method that finds this ``share`` of the matches within 20 px fails; None where it is missing."""
    return None if share is None else share < FOUND


def hold_all(parts: Sequence[bool | None]) -> bool | None:
    """Whether all of a claim's parts hold; None where none fails and one was not measured."""
    return False if False in parts else None if None in parts else True


def get(results: Any, *keys: str) -> Any:
    """What lies under ``keys`` of nested results; None where one of them is missing."""
    for key in keys:
        results = results.get(key) if isinstance(results, Mapping) else None
    return results


def get_regions(results: Mapping[str, Any], group: str, measure: str) -> dict[str, float | None]:
    """A measure of a group of the symmetry study, by region of the cloth."""
    regions = get(results, "symmetry", group, "regions") or {}
    return {region: row[measure] for region, row in regions.items()}


def list_errors(errors: Mapping[str, float | None]) -> str:
    """ "cloth 26.1, rope 24.4 px"."""
    return ", ".join(f"{name} {say(error)}" for name, error in errors.items()) + " px" if errors else "–"


def list_shares(shares: Mapping[str, float | None], kind: str = "percent") -> str:
    """ "cloth 34 %, rope 41 %"."""
    return ", ".join(f"{name} {say(share, kind)}" for name, share in shares.items())


def say(value: float | None, kind: str = "px") -> str:
    """A number as ``px``, ``percent``, ``permille`` or a ``share``; a dash for None."""
    if value is None:
        return "–"
    forms = {"px": f"{value:.1f}", "percent": f"{100 * value:.0f} %", "permille": f"{100 * value:.1f} %"}
    return forms.get(kind, f"{value:.2f}")
