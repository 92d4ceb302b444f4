"""How far a table's uncertainties can be trusted: does entropy rank errors, do ellipses hold what they promise, does
mass outside them tell that a match is occluded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import scipy

from mmgsd.measure.metrics import LISTS
from mmgsd.model.calibration import LEVELS as TABLED
from mmgsd.model.calibration import Calibration, Gaussian, Modes

LEVELS = TABLED[:-1]  # expected coverage of a mode's ellipse: 5, 10 … 95 %
REPORTED = (0.5, 0.9, 0.95)
RADII_PX = (5.0, 10.0, 20.0, 40.0, 80.0)  # at which confidences are fitted; all but the last are checked
BINS = 10  # of confidences, equally wide


def compute_risk_coverage(error: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coverage (S,) and risk (S,): share of the queries kept, lowest score first, and the mean error of those kept.

    ``error`` (S,), its unit the risk's, and ``score`` (S,), high where uncertain. Queries of one score share their mean
    error, so that the rows' order does not matter. Risk-coverage curve of El-Yaniv and Wiener, "On the foundations of
    noise-free selective classification" (JMLR 2010).
    """
    error, score = np.asarray(error, float), np.asarray(score, float)
    order = np.lexsort((error, score))
    _, tied = np.unique(score[order], return_inverse=True)
    shared = np.bincount(tied, error[order]) / np.bincount(tied)  # (scores,)
    counts = np.arange(1, len(error) + 1)
    return counts / max(len(error), 1), np.cumsum(shared[tied]) / counts


def compute_aurc(error: np.ndarray, score: np.ndarray) -> float:
    """Area under the risk-coverage curve, the mean risk over all coverages: in the error's unit, NaN of no query."""
    risk = compute_risk_coverage(error, score)[1]
    return float(risk.mean()) if len(risk) else np.nan


def compute_coverage(mahalanobis2: np.ndarray, levels: Sequence[float] = LEVELS) -> np.ndarray:
    """Observed share (L,) of true matches within the ellipse that a Gaussian fills to each expected level (L,).

    ``mahalanobis2`` (M,) squared distances, one a true match. NaN, a match without an ellipse, counts as not within;
    all are NaN where all distances are, or there are none.
    """
    if np.isnan(mahalanobis2).all():
        return np.full(len(levels), np.nan)
    ordered = np.sort(mahalanobis2)  # NaN last
    return np.searchsorted(ordered, scipy.stats.chi2.ppf(levels, 2), side="right") / len(ordered)


def compute_coverage_error(mahalanobis2: np.ndarray, levels: Sequence[float] = LEVELS) -> float:
    """Expected calibration error: mean of |observed - expected| coverage over the levels, in [0, 1]."""
    return float(np.abs(compute_coverage(mahalanobis2, levels) - levels).mean())


def compute_auroc(score: np.ndarray, positive: np.ndarray) -> float:
    """Probability that a positive's score exceeds a negative's, ties a half; NaN without one of them, or of a NaN.

    ``score`` (S,) and ``positive`` (S,) bool.
    """
    from sklearn.metrics import roc_auc_score  # alone needs it, and waits for it

    if np.isnan(score).any() or len(np.unique(positive)) < 2:
        return np.nan
    return float(roc_auc_score(positive, score))


def get_distances(queries: pd.DataFrame) -> np.ndarray:
    """(M,) squared Mahalanobis distances of all true matches of the queries with a visible source."""
    rows = queries.mahalanobis2[queries.visible]
    return np.concatenate([np.empty(0), *rows]).astype(float)


def recalibrate(queries: pd.DataFrame, calibration: Calibration | None) -> pd.DataFrame:
    """The table with other ``mahalanobis2``: those that a Gaussian fills to the levels that ``calibration`` tells.

    None leaves it as it is. ValueError for a table of before it held what is needed.
    """
    if calibration is None:
        return queries
    _check_lists(queries)
    rows = _explode(queries)
    distances = scipy.stats.chi2.ppf(calibration.compute_level(rows.mahalanobis2.to_numpy(), measure_modes(rows)), 2)
    ends = queries.mahalanobis2.map(len).cumsum()
    return queries.assign(mahalanobis2=pd.Series(np.split(distances, ends[:-1]), queries.index, object))


def get_modes(queries: pd.DataFrame) -> pd.DataFrame:
    """A row a mode of the queries with a visible source: ``pair``, ``entropy`` and `mmgsd.measure.metrics.LISTS`.

    Modes without a spread, of chance, are left out. ValueError for a table of before these columns were kept.
    """
    _check_lists(queries)
    modes = _explode(queries[queries.visible])
    return modes[modes.spread_px > 0]


def _explode(queries: pd.DataFrame) -> pd.DataFrame:
    modes = queries[["pair", "entropy", *LISTS]].explode(list(LISTS), ignore_index=True)
    return modes.astype(dict.fromkeys(LISTS, float))


def measure_modes(modes: pd.DataFrame) -> Modes:
    """What a calibration asks of the M modes of `get_modes`, (M,) each."""
    effective_size_px = np.exp(modes.entropy.to_numpy(float) / 2)
    return Modes(modes.spread_px.to_numpy(), modes.share.to_numpy(), effective_size_px)


def compute_confidences(
    modes: pd.DataFrame, radius_px: float, calibration: Calibration | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Of each of M modes (`get_modes`), the confidence (M,) that a match is within the radius, and whether it is."""
    promise = calibration or Gaussian()
    confidence = promise.compute_confidence(radius_px, measure_modes(modes))
    return confidence, modes.distance_px.to_numpy() <= radius_px


def compute_reliability(
    confidence: np.ndarray, near: np.ndarray, pair: np.ndarray, *, bins: int = BINS
) -> pd.DataFrame:
    """A reliability diagram: a row for each of ``bins`` equal intervals of confidence that holds any.

    ``expected`` mean ``confidence`` (M,), ``observed`` share of ``near`` (M,) bool, ``margin`` half of the observed
    share's 95 % interval by pairs: modes of one ``pair`` (M,) err together. ``count`` of modes.
    """
    table = pd.DataFrame({"expected": confidence, "observed": np.asarray(near, float), "pair": np.asarray(pair)})
    table["bin"] = np.minimum((confidence * bins).astype(int), bins - 1)
    rows = table.groupby("bin")[["expected", "observed"]].mean()
    rows["count"] = table.groupby("bin").size()
    off = (table.observed - table["bin"].map(rows.observed)).groupby([table["bin"], table["pair"]]).sum()
    rows["margin"] = 1.96 * np.sqrt(off.pow(2).groupby("bin").sum()) / rows["count"]
    return rows


def compute_confidence_error(
    modes: pd.DataFrame, calibration: Calibration | None = None, *, radii_px: Sequence[float] = RADII_PX[:-1]
) -> float:
    """Expected calibration error of confidences in [0, 1], the mean over radii: of |observed - expected| by bins."""
    errors = []
    for radius in radii_px:
        rows = compute_reliability(*compute_confidences(modes, radius, calibration), modes["pair"].to_numpy())
        errors.append(np.average(np.abs(rows.observed - rows.expected), weights=rows["count"]) if len(rows) else np.nan)
    return float(np.mean(errors))


def summarise_uncertainty(queries: pd.DataFrame, *, calibration: Calibration | None = None) -> dict[str, float | None]:
    """Quality of the uncertainties of queries with a visible source; None, JSON's null, for what is undefined.

    ``spearman`` of entropy and error; ``aurc`` (px) by entropy, ``aurc_oracle`` by the error itself, ``aurc_random``
    without a score, ``aurc_share`` = (aurc - oracle) / (random - oracle): 0 as good as the oracle, 1 as random;
    ``coverage@50%`` … and ``ece`` of the ellipses, each true match counts;
    ``ece_confidence`` of 5 to 40 px; ``auroc_occluded`` and ``auroc_absent``: mass outside the ellipses tells that at
    least one true match is hidden, or all are. Ellipses and confidences promise what ``calibration`` says, or without
    one what a Gaussian would.
    """
    seen = queries[queries.visible]
    distances = get_distances(recalibrate(queries, calibration))
    coverage = compute_coverage(distances, REPORTED)
    summary = _summarise_risk(seen.rmse_px.to_numpy(float), seen.entropy.to_numpy(float)) | {
        **{f"coverage@{100 * level:.0f}%": share for level, share in zip(REPORTED, coverage, strict=True)},
        "ece": compute_coverage_error(distances),
        **_summarise_confidence(seen, calibration),
        "auroc_occluded": compute_auroc(seen.outside, seen.hidden >= 1),
        "auroc_absent": compute_auroc(seen.outside, seen.hidden == seen.n),
    }
    rounded = {name: round(float(value), 4) if np.isfinite(value) else None for name, value in summary.items()}
    return rounded | {"queries": len(seen)}


def _summarise_confidence(queries: pd.DataFrame, calibration: Calibration | None) -> dict[str, float]:
    """The confidences' error, of tables that tell it."""
    if not set(LISTS) <= set(queries):
        return {}
    return {"ece_confidence": compute_confidence_error(get_modes(queries), calibration)}


def _summarise_risk(error: np.ndarray, entropy: np.ndarray) -> dict[str, float]:
    varied = len(np.unique(entropy)) > 1 and len(np.unique(error)) > 1
    aurc = compute_aurc(error, entropy) if np.isfinite(entropy).all() else np.nan
    oracle, mean = compute_aurc(error, error), error.mean() if len(error) else np.nan
    return {
        "spearman": scipy.stats.spearmanr(entropy, error).statistic if varied else np.nan,
        "aurc": aurc,
        "aurc_oracle": oracle,
        "aurc_random": mean,
        "aurc_share": (aurc - oracle) / (mean - oracle) if error.size and np.ptp(error) > 0 else np.nan,
    }


def _check_lists(queries: pd.DataFrame) -> None:
    missing = [name for name in LISTS if name not in queries]
    if missing:
        raise ValueError(f"queries must have the columns {', '.join(LISTS)}, got none of {missing}: ask again")
