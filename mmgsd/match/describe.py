"""An answer in plain values and in words, the same on the command line, in the explorer and above a figure."""

from __future__ import annotations

from typing import Any

import numpy as np

from mmgsd.match.match import LIKELY, Match


def describe_answer(match: Match) -> list[dict[str, Any]]:
    """A `Match` as plain values, a dictionary a query: px, shares, nats.

    ``visible`` of a mode, ``on_object``, ``absent`` and ``said``, which is "" or why there is no answer
    (`Match.say_presence`), only where they are known. Of a joint answer each mode has its ``answer``, from 1 on: those
    of one number belong together.
    """
    confidence, described = match.confidence(), []
    per_query = {"entropy": match.entropy, "outside": match.outlier_mass, "on_object": match.on_object,
                 "absent": match.absent}  # fmt: skip
    per_query = {name: values for name, values in per_query.items() if values is not None}
    for query, xy in enumerate(match.xy):
        modes = [_describe_mode(match, query, k, confidence) for k in np.flatnonzero(match.weights[query] > 0)]
        scalars = {name: round(float(values[query]), 4) for name, values in per_query.items()}
        if "on_object" in scalars or "absent" in scalars:
            scalars["said"] = match.say_presence(query)
        described.append({"xy": xy.astype(float).round(2).tolist(), "modes": modes, **scalars})
    return described


def _describe_mode(match: Match, query: int, k: int, confidence: np.ndarray) -> dict[str, Any]:
    mode = {
        "xy": match.modes[query, k].astype(float).round(2).tolist(),
        "weight": round(float(match.weights[query, k]), 4),
        "spread_px": round(float(match.spread_px[query, k]), 2),
        "confidence": round(float(confidence[query, k]), 4),
    }
    if match.joint_weights is not None:
        mode["answer"] = int(k) + 1
    return mode if match.visible is None else {**mode, "visible": round(float(match.visible[query, k]), 4)}


def format_query(query: dict[str, Any]) -> str:
    """A line of text of one query's plain values (`describe_answer`)."""
    x, y = query["xy"]
    return f"{x:g},{y:g} -> " + (query.get("said") or ", ".join(map(_format_mode, query["modes"])))


def _format_mode(mode: dict[str, Any]) -> str:
    hidden = ", hidden" if mode.get("visible", 1) < LIKELY else ""
    return "{:.1f},{:.1f} (±{:.0f} px{})".format(*mode["xy"], mode["spread_px"], hidden)
