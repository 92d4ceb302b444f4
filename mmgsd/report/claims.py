"""The paper's claims, each judged from the results by a stated rule: what was measured, and whether it held.

A claim has parts, each True, False, or None where it was not measured; the verdict follows from these alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mmgsd.config import OBJECTS
from mmgsd.report.results import PAPER

HELD, IN_PART, NOT_HELD, NOT_MEASURED = "held", "held in part", "did not hold", "not measured"
MARGIN = 0.05  # two errors that differ by less are not told apart: one training each, one seed
IMPROVEMENT = 0.477  # on SPCL, as the paper reports it
FOUND = 0.5  # a method fails that finds less than this share of the matches within 20 px
CHOSEN = 0.6  # two matches are told apart where an answer is the right one so often; by chance it is in half
RANKED = 0.3  # rank correlation from which entropy is said to rank the errors
NATS = 0.05  # entropies that differ by less are not told apart: 5 % of the area
SPCL = ("spcl", "spcl_dense")  # the paper's, and the one with the dense supervision that MMGSD gets
PLAIN = ("edge", "interior")  # of a cloth: where the groups differ
HAND_MADE = ("sift", "surf", "orb")  # that the paper names; SURF is not in the OpenCV that pip installs


@dataclass(frozen=True)
class Claim:
    """One claim; texts are Markdown, ``key`` is what the report asks its verdict by."""

    key: str
    claim: str
    rule: str
    measured: str
    parts: tuple[bool | None, ...]

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


def get(results: Any, *keys: str) -> Any:
    """What lies under ``keys`` of nested results; None where one of them is missing."""
    for key in keys:
        results = results.get(key) if isinstance(results, Mapping) else None
    return results


def list_claims(results: Mapping[str, Any]) -> list[Claim]:
    """Every claim, judged from {name of the results file: its content}."""
    return [rule(results) for rule in RULES]


def judge_rmse(results: Mapping[str, Any]) -> Claim:
    """The paper's headline errors."""
    errors = {name: get(results, "rmse", name, "mmgsd", "rmse_mean") for name in OBJECTS}
    parts = tuple(is_at_least(PAPER[name], errors[name]) for name in OBJECTS)
    claim = " and ".join(f"{PAPER[name]} px on {name}" for name in OBJECTS)
    return Claim("rmse", f"MMGSD's error is {claim}.", "Ours is no larger; a part each object.", _list(errors), parts)


def judge_improvement(results: Mapping[str, Any]) -> Claim:
    """The distance to the contrastive baseline; SPCL with MMGSD's dense supervision is told beside."""
    gains, dense = ({name: _compute_gain(get(results, "rmse", name), m) for name in OBJECTS} for m in SPCL)
    equal = {name: _compute_gain(get(results, "budget", name), SPCL[0]) for name in OBJECTS}
    known = None not in gains.values()
    mean = sum(gains.values()) / len(gains) if known else None
    parts = (*(is_at_least(gain, MARGIN) for gain in gains.values()), is_at_least(mean, IMPROVEMENT))
    others = {"SPCL with dense supervision": dense, "SPCL, both at the studies' budget": equal}
    beside = "".join(f"; below {other}: {_list_gains(row)}" for other, row in others.items() if any(row.values()))
    return Claim(
        "improvement", f"MMGSD's error is {100 * IMPROVEMENT:.1f} % below SPCL's on average.",
        "MMGSD is better, a part each object; the mean of the two improvements is as large, a part.",
        f"{_list_gains(gains)}, mean {_say(mean, 'percent')}{beside}", parts,
    )  # fmt: skip


def judge_sigma(results: Mapping[str, Any]) -> Claim:
    """The width of the target."""
    errors = {name: {s: row["rmse_mean"] for s, row in (get(results, "sigma", name) or {}).items()} for name in OBJECTS}
    parts = tuple(is_better(row.get("1"), row[s]) for row in errors.values() for s in row if float(s) > 1) or (None,)
    shown = [f"{n}: " + ", ".join(f"{_say(e)} at {s}" for s, e in row.items()) for n, row in errors.items()]
    return Claim(
        "sigma", "A target of σ = 1 px is best; every wider one is worse.",
        "The wider target's error is larger; a part each object and width.", "; ".join(shown), parts,
    )  # fmt: skip


def judge_interior(results: Mapping[str, Any]) -> Claim:
    """Where on the objects the errors lie; for the cloth, where not measured by place, the study's model of c4."""
    cloth = get(results, "places", "cloth") or _get_regions(results, "c4", "rmse_px")
    rope = get(results, "places", "rope") or {}
    parts = (_is_greatest(cloth, "interior", ("corner", "edge")), is_better(rope.get("end"), rope.get("middle")))
    return Claim(
        "interior", "Errors are highest in the object's interior and low at its extremities.",
        "MMGSD's error inside is larger than at corners and edges (cloth), or than at the ends (rope); a part each.",
        f"cloth: {_list(cloth)}; rope: {_list(rope)}", parts,
    )  # fmt: skip


def judge_hand_made(results: Mapping[str, Any]) -> Claim:
    """The hand-made descriptors that the paper names."""
    shares = {m: {n: get(results, "rmse", n, m, "pck@20px") for n in OBJECTS} for m in (*HAND_MADE, "mmgsd")}
    parts = tuple(fails(shares[m][n]) for m in HAND_MADE for n in OBJECTS)
    shown = [f"{m.upper()} {' / '.join(_say(v, 'percent') for v in row.values())}" for m, row in shares.items()]
    return Claim(
        "hand-made", "SIFT, SURF and ORB fail.",
        f"They find fewer than {100 * FOUND:.0f} % of the matches within 20 px; a part each method and object.",
        f"found, cloth / rope: {', '.join(shown)}", parts,
    )  # fmt: skip


def judge_rotation_limit(results: Mapping[str, Any]) -> Claim:
    """The first fix of prior work; its errors are not kept by angle, so the cause stays open."""
    free, limited = (get(results, "broken_symmetry", f"cloth, {fix}") for fix in ("any rotation", "±45° only"))
    share = get(limited, "pck@20px")
    errors = {"any rotation": get(free, "rmse_mean"), "±45°": get(limited, "rmse_mean")}
    return Claim(
        "rotation-limit", "PCL still suffers where the cloth turns by no more than ±45°.",
        "Limited, PCL fails by the rule for SIFT, a part; its errors gather at the range's ends, a part not measured.",
        f"{_list(errors)}; limited, {_say(share, 'percent')} found within 20 px", (fails(share), None),
    )  # fmt: skip


def judge_ball(results: Mapping[str, Any]) -> Claim:
    """The second fix of prior work."""
    fixes = {"plain": "rope, plain", "with a ball": "rope, ball at one end"}
    rows = {name: get(results, "broken_symmetry", key) for name, key in fixes.items()}
    errors, right = ({name: get(row, key) for name, row in rows.items()} for key in ("rmse_mean", "right"))
    chosen = None if right["with a ball"] is None else right["with a ball"] >= CHOSEN
    return Claim(
        "ball", "A ball at one end of the rope breaks its symmetry.",
        "PCL's error is lower with the ball, a part; it takes the right one of the two matches in "
        f"{100 * CHOSEN:.0f} % of its answers or more, a part.",
        f"{_list(errors)}; right {', '.join(_say(share, 'percent') for share in right.values())}",
        (is_better(errors["with a ball"], errors["plain"]), chosen),
    )  # fmt: skip


def judge_entropy(results: Mapping[str, Any]) -> Claim:
    """Entropy as a measure of uncertainty."""
    ranks = {name: get(results, "uncertainty", "calibrated", name, "mmgsd", "spearman") for name in OBJECTS}
    return Claim(
        "entropy", "The heatmap's entropy measures uncertainty.",
        f"Rank correlation of MMGSD's entropy and error of {RANKED} or more; a part each object.",
        ", ".join(f"{name} {_say(rank, 'share')}" for name, rank in ranks.items()),
        tuple(is_at_least(rank, RANKED) for rank in ranks.values()),
    )  # fmt: skip


def judge_inward(results: Mapping[str, Any]) -> Claim:
    """Where the uncertainty lies."""
    nats = _get_regions(results, "c4", "entropy")
    corner, interior = nats.get("corner"), nats.get("interior")
    parts = (is_at_least(interior, None if corner is None else corner + NATS), None)
    shown = ", ".join(f"{region} {_say(value, 'share')}" for region, value in nats.items())
    return Claim(
        "inward", "Uncertainty is least at the extremities and grows inwards and at knots.",
        f"The cloth's interior has at least {NATS} nats more than its corners, a part; knots, a part not measured.",
        f"nats: {shown}", parts,
    )  # fmt: skip


def judge_group(results: Mapping[str, Any]) -> Claim:
    """This project's own conjecture about the paper's error map."""
    v4, c4 = (_get_regions(results, group, "rmse_px") for group in ("v4", "c4"))
    worse = {region: is_better(c4.get(region), v4.get(region)) for region in ("corner", "edge", "interior")}
    parts = tuple(None if None in (worse[r], worse["corner"]) else worse[r] and not worse["corner"] for r in PLAIN)
    return Claim(
        "group", "Our conjecture: the errors inside are those of the group `v4`, not of cloth.",
        "Edge, or interior, is worse under `v4` than under `c4`, the corners are not; a part each.",
        f"`v4`: {_list(v4)}; `c4`: {_list(c4)}", parts,
    )  # fmt: skip


def judge_surest(results: Mapping[str, Any]) -> Claim:
    """What the paper is for: a robot takes the one of the like places that it is surest of (its introduction)."""
    low = {name: get(results, "folding", name, "mmgsd_best", "beyond", "error", "low") for name in OBJECTS}
    parts = tuple(None if low[name] is None else low[name] <= 0 for name in OBJECTS)
    ways = {"modes that agree": "mmgsd", "surest joint answer": "mmgsd_joint", "each pixel's surest": "mmgsd_best"}
    shown = []
    for name in OBJECTS:
        successes = {way: get(results, "folding", name, policy, "success", "mean") for way, policy in ways.items()}
        shown.append(f"{name}: " + ", ".join(f"{way} {_say(share, 'percent')}" for way, share in successes.items()))
    return Claim(
        "surest", "Of the like matches, a robot should act on the one that it is surest of.",
        "Folding by each pixel's surest mode ends no farther off than by modes that agree, as far as the 95 % interval "
        "of the difference tells; a part each object.", f"successes, {'; '.join(shown)}", parts,
    )  # fmt: skip


RULES = (
    judge_rmse, judge_improvement, judge_sigma, judge_interior, judge_hand_made, judge_rotation_limit, judge_ball,
    judge_entropy, judge_inward, judge_group, judge_surest,
)  # fmt: skip


def fails(share: float | None) -> bool | None:
    """Whether a method that finds this ``share`` of the matches within 20 px fails; None where it is missing."""
    return None if share is None else share < FOUND


def _compute_gain(methods: Mapping[str, Any] | None, other: str) -> float | None:
    ours, theirs = (get(methods, method, "rmse_mean") for method in ("mmgsd", other))
    return None if ours is None or theirs is None else 1 - ours / theirs


def _get_regions(results: Mapping[str, Any], group: str, measure: str) -> dict[str, float | None]:
    regions = get(results, "symmetry", group, "regions") or {}
    return {region: row[measure] for region, row in regions.items()}


def _is_greatest(errors: Mapping[str, float | None], place: str, others: Sequence[str]) -> bool | None:
    lower = [is_better(errors.get(other), errors.get(place)) for other in others]
    if False in lower:
        return False
    return None if None in lower else True


def _list(errors: Mapping[str, float | None]) -> str:
    return ", ".join(f"{name} {_say(error)}" for name, error in errors.items()) + " px" if errors else "–"


def _list_gains(gains: Mapping[str, float | None]) -> str:
    return ", ".join(f"{name} {_say(gain, 'percent')}" for name, gain in gains.items())


def _say(value: float | None, kind: str = "px") -> str:
    if value is None:
        return "–"
    return {"px": f"{value:.1f}", "percent": f"{100 * value:.0f} %", "share": f"{value:.2f}"}[kind]
