"""How modes are best read from heatmaps of trained weights (`mmgsd.match.mixture.ModeReadout`), by renders held out.

What counts is what a robot can grasp: `mmgsd.measure.photographs` asks the same of photographs, which choose nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mmgsd.config import EvaluateConfig
from mmgsd.dataset import Dataset
from mmgsd.match.match import RADIUS_PX
from mmgsd.match.matcher import Matcher
from mmgsd.match.mixture import AS_IT_IS, ModeReadout, fit_modes
from mmgsd.measure.metrics import compute_query_errors
from mmgsd.measure.questions import choose_points, describe, draw_pairs
from mmgsd.model.network import compute_cell_centres
from mmgsd.progress import ProgressBar

POWERS = (1.0, 1.25, 1.5, 2.0)
SHARPNESSES = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
ALLOWED = 1.05  # times the RMSE of modes that are read as they are


class Asked(NamedTuple):
    """The heatmaps of a pair's questions, and where the true matches are."""

    heatmaps: Tensor  # (S, h, w)
    true: np.ndarray  # (S, n, 2) px
    seen: np.ndarray  # (S, n) bool


class Quality(NamedTuple):
    """What a reading gives: mean RMSE, and of the matches that are seen the shares `count_seen` tells."""

    rmse_px: float
    found: float
    spurious: float

    @property
    def gain(self) -> float:
        """Found less spurious, by which readings are compared."""
        return self.found - self.spurious


def choose_readout(
    matcher: Matcher, data: Dataset, *, pairs: int = 120, points: int = 40, seed: int = 0, progress: bool = False
) -> ModeReadout:
    """The reading that finds the most matches that are seen in ``data``, which must not have been trained on.

    Of `POWERS` and `SHARPNESSES` that with the largest found share less the spurious one, as `count_seen` counts them,
    among those whose RMSE is at most `ALLOWED` times what it is without. Leaves it set on the matcher and returns it.
    """
    config = EvaluateConfig(pairs=pairs, points=points, seed=seed)
    asked = list(_ask(matcher, data, config))
    roundness = matcher.readout.shape_prior
    readouts = [ModeReadout(roundness, power, sharpness) for power in POWERS for sharpness in SHARPNESSES]
    bar = ProgressBar(readouts, desc="choose a reading", disable=not progress, leave=False)
    quality = {readout: measure_readout(asked, readout, data.size) for readout in bar}
    least = quality[ModeReadout(roundness, AS_IT_IS.exponent, AS_IT_IS.mean_exponent)].rmse_px
    allowed = [readout for readout in readouts if quality[readout].rmse_px <= ALLOWED * least]
    matcher.readout = max(allowed, key=lambda readout: quality[readout].gain)
    return matcher.readout


def _ask(matcher: Matcher, data: Dataset, config: EvaluateConfig) -> Iterator[Asked]:
    """Of each pair the points that are seen in its first image."""
    chosen, points = draw_pairs(data, config), choose_points(config.points, data.n_points)
    outputs, group = describe(matcher, data, np.unique(chosen)), data.group(matcher.config.group).permutations
    points = points[[len(np.unique(group[:, point])) == len(group) for point in points]]  # none of a symmetry's centre
    for first, second in chosen:
        shown = points[data.visible[first, points]]
        if len(shown):
            xy, orbits = torch.from_numpy(data.xy[first, shown]), group[:, shown].T  # (S, 2), (S, n)
            heatmaps = matcher.compute_heatmaps(outputs[first], outputs[second], xy, data.size)
            yield Asked(heatmaps, data.xy[second][orbits].astype(float), data.visible[second][orbits])


def measure_readout(asked: list[Asked], readout: ModeReadout, size: tuple[int, int]) -> Quality:
    """What a reading gives on questions about images of one ``size`` (width, height) px."""
    errors, found, spurious = [], [], []
    for heatmaps, true, seen in asked:
        fit = fit_modes(heatmaps, true.shape[1], *compute_cell_centres(size, heatmaps.shape[-2:]), readout=readout)
        modes, covariances = (t.double().cpu().numpy() for t in (fit.modes, fit.covariances))
        errors.append(compute_query_errors(modes, covariances, true)["rmse_px"])
        shares = count_seen(modes, true, seen)
        found.append(shares[0])
        spurious.append(shares[1])
    return Quality(*(float(np.concatenate(values).mean()) for values in (errors, found, spurious)))


def count_seen(modes: np.ndarray, true: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares found and spurious (Q,) of the Q queries with a match that is seen.

    ``modes`` and ``true`` (S, n, 2) px, ``seen`` (S, n) bool. Found: of the seen matches those with a mode within
    `RADIUS_PX`. Spurious: of the k most probable modes, k matches being seen, those twice as far from all of them.
    """
    asked = seen.any(1)
    modes, true, seen = modes[asked], true[asked], seen[asked]
    distance = np.linalg.norm(modes[:, :, None] - true[:, None], axis=-1)  # (Q, modes, matches)
    count = seen.sum(1)
    found = ((distance.min(1) < RADIUS_PX) & seen).sum(1) / count
    far = np.where(seen[:, None], distance, np.inf).min(2) > 2 * RADIUS_PX  # (Q, modes)
    first = np.arange(modes.shape[1]) < count[:, None]
    return found, (far & first).sum(1) / count
