"""The paper's claims, each judged from the results by a stated rule: what was measured, and whether it held.

A claim has parts, each True, False, or None where it was not measured; the verdict follows from these alone.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import spearmanr

from mmgsd.config import OBJECTS
from mmgsd.report.results import PEAK
from mmgsd.studies.models import PAPER

HELD, IN_PART, NOT_HELD, NOT_MEASURED = "held", "held in part", "did not hold", "not measured"
MARGIN = 0.05  # two errors that differ by less are not told apart: one training each, one seed
SEEDS = 3  # from which a spread over seeds is spoken of
IMPROVEMENT = 0.477  # on SPCL, as the paper reports it
FOUND = 0.5  # a method fails that finds less than this share of the matches within 20 px
CHOSEN = 0.6  # two matches are told apart where an answer is the right one so often; by chance it is in half
RANKED = 0.3  # rank correlation from which entropy is said to rank the errors
NATS = 0.05  # entropies that differ by less are not told apart: 5 % of the area
OURS = {"mmgsd_plain": "its own loss alone", "mmgsd": "a dense supervision besides, which the paper does not have"}
SEEN, KNOTS = ("seen", "hidden"), ("straight", "overhand knot")  # kinds of queries; states of the rope
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


def judge_rmse(results: Mapping[str, Any], *, row: str = "mmgsd_plain") -> Claim:
    """The paper's headline errors, of the paper's own loss alone."""
    errors = {name: get(results, "rmse", name, row, "rmse_mean") for name in OBJECTS}
    parts = tuple(is_at_least(PAPER[name], errors[name]) for name in OBJECTS)
    claim = " and ".join(f"{PAPER[name]} px on {name}" for name in OBJECTS)
    return Claim(
        "rmse" if row == "mmgsd_plain" else "rmse-dense", f"MMGSD's error is {claim}; here with {OURS[row]}.",
        "Ours is no larger; a part each object.", f"{_list(errors)}, one seed", parts,
    )  # fmt: skip


def judge_rmse_dense(results: Mapping[str, Any]) -> Claim:
    """The same of what this project calls MMGSD."""
    return judge_rmse(results, row="mmgsd")


def judge_improvement(results: Mapping[str, Any]) -> Claim:
    """The distance to the contrastive baseline, neither with dense supervision; other pairs are told beside."""

    def gain(row: str, other: str, table: str = "rmse") -> dict[str, float | None]:
        return {name: _compute_gain(get(results, table, name), row, other) for name in OBJECTS}

    gains = gain("mmgsd_plain", "spcl")
    mean = None if None in gains.values() else sum(gains.values()) / len(gains)
    parts = (*(is_at_least(each, MARGIN) for each in gains.values()), is_at_least(mean, IMPROVEMENT))
    others = {
        "with dense supervision, below SPCL without": gain("mmgsd", "spcl"),
        "both with it": gain("mmgsd", "spcl_dense"),
        "the first at the studies' budget": gain("mmgsd", "spcl", "budget"),
    }
    beside = "".join(f"; {other}: {_list_gains(row)}" for other, row in others.items() if any(row.values()))
    return Claim(
        "improvement", f"MMGSD's error is {100 * IMPROVEMENT:.1f} % below SPCL's on average.",
        "With its own loss alone MMGSD is better, a part each object; the mean improvement is as large, a part.",
        f"{_list_gains(gains)}, mean {_say(mean, 'percent')}{beside}; one seed each", parts,
    )  # fmt: skip


def judge_stable(results: Mapping[str, Any]) -> Claim:
    """The contrastive training's instability, as the spread over seeds."""
    spreads = {m: {name: _measure_spread(get(results, "seeds_1000", name), m) for name in OBJECTS}
               for m in ("mmgsd", "spcl")}  # fmt: skip
    parts = tuple(None if None in (ours := spreads["mmgsd"][n], theirs := spreads["spcl"][n]) else theirs > ours
                  for n in OBJECTS)  # fmt: skip
    reference = {name: get(results, "rmse", name, "spcl_reference", "rmse_mean") for name in OBJECTS}
    return Claim(
        "stable", "SPCL's training is unstable; MMGSD's is more stable.",
        f"Over {SEEDS} seeds or more, SPCL's error has the larger standard deviation; a part each object.",
        f"std at the studies' budget, MMGSD: {_list(spreads['mmgsd'])}, SPCL: {_list(spreads['spcl'])}; in its "
        f"reference setting, one seed, SPCL's error is {_list(reference)}", parts,
    )  # fmt: skip


def judge_continuous(results: Mapping[str, Any]) -> Claim:
    """Whether neighbouring pixels have neighbouring matches."""
    jumps = {m: {name: get(results, "continuity", name, m, "jumps") for name in OBJECTS} for m in ("mmgsd", "spcl")}
    parts = tuple(is_better(jumps["mmgsd"][name], jumps["spcl"][name]) for name in OBJECTS)
    shown = [f"{m.upper()}: {_list_gains(row, 'permille')}" for m, row in jumps.items()]
    return Claim(
        "continuous", "SPCL's answers are discontinuous; MMGSD's are more continuous.",
        "Fewer of MMGSD's matches jump from one material point to its neighbour; a part each object.",
        f"jumps, {'; '.join(shown)}; the sample's images, one seed", parts,
    )  # fmt: skip


def judge_bimodal(results: Mapping[str, Any]) -> Claim:
    """The shape of the error's distribution."""
    peaks = {name: get(results, "peaks", name) for name in OBJECTS}
    return Claim(
        "bimodal", "The distribution of MMGSD's error has two peaks: exteriors, then interiors.",
        f"Two peaks stand out by {100 * PEAK:.0f} % of the highest value; a part each object.",
        "peaks: " + ", ".join(f"{name} {count or '–'}" for name, count in peaks.items()),
        tuple(None if count is None else count == 2 for count in peaks.values()),
    )  # fmt: skip


def judge_sigma(results: Mapping[str, Any]) -> Claim:
    """The width of the target."""
    errors = {name: {s: row["rmse_mean"] for s, row in (get(results, "sigma", name) or {}).items()} for name in OBJECTS}
    parts = tuple(is_better(row.get("1"), row[s]) for row in errors.values() for s in row if float(s) > 1) or (None,)
    shown = [f"{n}: " + ", ".join(f"{_say(e)} at {s}" for s, e in row.items()) for n, row in errors.items()]
    return Claim(
        "sigma", "A target of σ = 1 px is best; every wider one is worse.",
        "The wider target's error is larger; a part each object and width.", f"{'; '.join(shown)}; one seed", parts,
    )  # fmt: skip


def judge_interior(results: Mapping[str, Any]) -> Claim:
    """Where on the objects the errors lie; for the cloth, where not measured by place, the study's model of c4."""
    cloth = get(results, "places", "cloth") or _get_regions(results, "c4", "rmse_px")
    rope = get(results, "places", "rope") or {}
    parts = (_is_greatest(cloth, "interior", ("corner", "edge")), is_better(rope.get("end"), rope.get("middle")))
    return Claim(
        "interior", "Errors are highest in the object's interior and low at its extremities.",
        "MMGSD's error inside is larger than at corners and edges (cloth), or than at the ends (rope); a part each.",
        f"cloth: {_list(cloth)}; rope: {_list(rope)}; one seed", parts,
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
    corner, edge, interior = (nats.get(region) for region in ("corner", "edge", "interior"))
    above = _is_above(edge, corner), _is_above(interior, corner)
    least = False if False in above else None if None in above else True
    shown = ", ".join(f"{region} {_say(value, 'share')}" for region, value in nats.items())
    return Claim(
        "inward", "Uncertainty is least at the extremities and grows inwards.",
        f"MMGSD's entropy is at least {NATS} nats lower at the cloth's corners than at edges and inside, a part, and "
        "lower at edges than inside, a part.", f"nats: {shown}; studies' budget, one seed",
        (least, _is_above(interior, edge)),
    )  # fmt: skip


def judge_hidden(results: Mapping[str, Any]) -> Claim:
    """Uncertainty where something covers the match; of the heatmap's entropy, not of its mass outside the modes."""
    nats = {name: get(results, "entropy", name) or {} for name in OBJECTS}
    pairs = {f"{name}, {high}": (nats[name].get(high), nats[name].get(low), low)
             for name, low, high in (*((name, *SEEN) for name in OBJECTS), ("rope", *KNOTS))}  # fmt: skip
    shown = [f"{kind} {_say(high, 'share')}, {other} {_say(low, 'share')}"
             for kind, (high, low, other) in pairs.items()]  # fmt: skip
    return Claim(
        "hidden", "Uncertainty is high at rope knots and at what is occluded.",
        f"MMGSD's entropy is at least {NATS} nats higher where a match is hidden, a part each object, and on knotted "
        "ropes than on straight ones, a part.", f"nats, {'; '.join(shown)}; one seed",
        tuple(_is_above(high, low) for high, low, _ in pairs.values()),
    )  # fmt: skip


def judge_group(results: Mapping[str, Any]) -> Claim:
    """This project's own conjecture about the paper's error map, in which the error grows inwards."""
    rings = {group: get(results, "symmetry", group, "rings") for group in ("v4", "c4")}
    inwards = {group: None if row is None else rank_inwards(row) for group, row in rings.items()}
    known = None not in inwards.values()
    shown = [f"`{group}`: {_say(row[0])} … {_say(row[-2])} px, rank correlation {_say(inwards[group], 'share')}"
             for group, row in rings.items() if row]  # fmt: skip
    return Claim(
        "group", "Our conjecture: the errors inside are those of the group `v4`, not of cloth.",
        f"From the border inwards the error grows, ring by ring (rank correlation of {RANKED} or more), under `v4` "
        "and not under `c4`.", f"rings, outermost … next to the centre, {'; '.join(shown) or '–'}; one seed",
        (inwards["v4"] >= RANKED > inwards["c4"] if known else None,),
    )  # fmt: skip


def rank_inwards(rings: Sequence[float]) -> float:
    """Rank correlation of errors by ring, outermost first, with the ring; the centre, one point, is left out."""
    return float(spearmanr(range(len(rings) - 1), rings[:-1]).statistic)


def judge_surest(results: Mapping[str, Any]) -> Claim:
    """What the paper is for: a robot takes the one of the like corners that it is surest of (its introduction)."""
    ways = {"surest": "surest", "most probable": "probable", "any": "any"}
    rows = {way: get(results, "grasp", "mmgsd", key) for way, key in ways.items()}
    high = get(results, "grasp", "mmgsd", "surest", "beyond", "high")
    shown = [f"{way} {_say(get(row, 'distance', 'mean'), 'percent')} of the side off, lifted "
             f"{_say(get(row, 'lifted', 'mean'), 'percent')}" for way, row in rows.items() if row]  # fmt: skip
    return Claim(
        "surest", "Of the four like corners, a robot should take the one that it is surest of.",
        "One grasp: the surest of the four modes is nearer to a corner than any of them, as far as the 95 % interval "
        "of the difference tells.", "; ".join(shown) or "–", (None if high is None else high < 0,),
    )  # fmt: skip


def judge_several(results: Mapping[str, Any]) -> Claim:
    """The same where several places are grasped at once: each pixel's surest match may be of another turn."""
    low = {name: get(results, "folding", name, "mmgsd_best", "beyond", "error", "low") for name in OBJECTS}
    parts = tuple(None if low[name] is None else low[name] <= 0 for name in OBJECTS)
    ways = {"modes that agree": "mmgsd", "surest joint answer": "mmgsd_joint", "each pixel's surest": "mmgsd_best"}
    shown = []
    for name in OBJECTS:
        successes = {way: get(results, "folding", name, policy, "success", "mean") for way, policy in ways.items()}
        shown.append(f"{name}: " + ", ".join(f"{way} {_say(share, 'percent')}" for way, share in successes.items()))
    return Claim(
        "several", "Our question: may each of several picks take its own surest match?",
        "Folding by each pixel's surest mode ends no farther off than by modes that agree, as far as the 95 % interval "
        "of the difference tells; a part each object.", f"successes, {'; '.join(shown)}", parts,
    )  # fmt: skip


RULES = (
    judge_rmse, judge_rmse_dense, judge_improvement, judge_sigma, judge_stable, judge_continuous, judge_interior,
    judge_bimodal, judge_hand_made, judge_rotation_limit, judge_ball, judge_entropy, judge_inward, judge_hidden,
    judge_surest, judge_several, judge_group,
)  # fmt: skip


def fails(share: float | None) -> bool | None:
    """Whether a method that finds this ``share`` of the matches within 20 px fails; None where it is missing."""
    return None if share is None else share < FOUND


def _is_above(nats: float | None, others: float | None) -> bool | None:
    return is_at_least(nats, None if others is None else others + NATS)


def _measure_spread(rows: Mapping[str, Any] | None, method: str) -> float | None:
    errors = [row["rmse_mean"] for key, row in (rows or {}).items() if key.rpartition("-")[0] == method]
    return statistics.stdev(errors) if len(errors) >= SEEDS else None


def _compute_gain(methods: Mapping[str, Any] | None, method: str, other: str) -> float | None:
    ours, theirs = (get(methods, name, "rmse_mean") for name in (method, other))
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


def _list_gains(gains: Mapping[str, float | None], kind: str = "percent") -> str:
    return ", ".join(f"{name} {_say(gain, kind)}" for name, gain in gains.items())


def _say(value: float | None, kind: str = "px") -> str:
    if value is None:
        return "–"
    forms = {"px": f"{value:.1f}", "percent": f"{100 * value:.0f} %", "permille": f"{100 * value:.1f} %"}
    return forms.get(kind, f"{value:.2f}")
