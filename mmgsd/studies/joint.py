"""The table of joint answers (`mmgsd.measure.joint`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mmgsd.studies.shipped import SETS

HEADS = {"heaviest": "right: heaviest modes", "joint": "first joint answer", "any_joint": "mean of joint answers",
         "possible": "best choice of modes", "swaps_heaviest": "swaps: heaviest modes",
         "swaps_joint": "first joint answer"}  # fmt: skip


def make_joint_table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Markdown: shares of right questions and of swaps, a row an object and set, clean ones by image1's state."""
    lines = ["|  | " + " | ".join(HEADS.values()) + " |", "|---" * (len(HEADS) + 1) + "|"]
    for row in rows.values():
        for preset, word in SETS.items():
            for kind, said in row.get(preset, {}).items():
                if kind != "all" and preset != next(iter(SETS)):
                    continue  # of clean images alone
                label = f"{row['object']}, {word}" if kind == "all" else f"{row['object']}, {word}, {kind}"
                lines.append(f"| {label} | " + " | ".join(_say(said[name]) for name in HEADS) + " |")
    return "\n".join(lines)


def make_joint_sentence(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """How many questions were asked, and what a joint answer costs."""
    asked = sum(row[preset]["all"]["questions"] for row in rows.values() for preset in SETS if preset in row)
    cost = max(row["milliseconds"]["joint"] - row["milliseconds"]["alone"] for row in rows.values())
    hardware = next(iter(rows.values()))["hardware"]
    return f"{asked} questions. A joint answer takes up to {cost} ms more than one that is not ({hardware})."


def _say(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"
