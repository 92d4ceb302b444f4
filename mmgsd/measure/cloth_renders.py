"""A matcher's errors on others' renders of one cloth, whose material points' pixels are told.

The folder is as `priyasundaresan/cloth-rendering` has its ``texture_images``: pictures ``000001_rgb.png``, …, and in
``knots_info.json``, by a picture's number, a list of the pixels of its 25 × 25 points, row by row: [[[x, y]], …].
The square at the left of each picture is asked about: each ordered pair, every second point of each row and column,
whether it is seen or not, and all its matches under ``c4``.
"""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mmgsd.config import DEFAULT_GROUP, N_POINTS
from mmgsd.files import DamagedFileError, read_json
from mmgsd.images import read_image
from mmgsd.match.matcher import Matcher
from mmgsd.measure.metrics import aggregate, compute_query_errors
from mmgsd.measure.regions import SIDE
from mmgsd.symmetry import load_group

LABELS, PICTURES = "knots_info.json", "*_rgb.png"
STEP = 2  # of the rows and columns of points that are asked about


def read_cloth_renders(folder: Path | str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Square pictures (s, s, 3) uint8 and their points (625, 2) px; DamagedFileError, which names what is wrong."""
    path = Path(folder) / LABELS
    labels, renders = read_json(path), []
    for file in sorted(Path(folder).glob(PICTURES)):
        image, number = read_image(file), str(int(file.name.partition("_")[0]))
        try:
            xy = np.array(labels[number], float).reshape(N_POINTS, 2)
        except (KeyError, TypeError, ValueError) as error:
            raise DamagedFileError(f"{path} must hold {N_POINTS} pixels [[x, y]] of {file.name} ({error!r})") from error
        renders.append((image[:, : image.shape[0]], xy))
    if len(renders) < 2:
        raise DamagedFileError(f"{folder} must hold at least two pictures {PICTURES}, got {len(renders)}")
    return renders


def measure_cloth_renders(matcher: Matcher, folder: Path | str) -> dict[str, Any]:
    """`mmgsd.measure.metrics.aggregate` over all queries, and the number of ``pictures``."""
    group, renders = load_group("cloth", DEFAULT_GROUP["cloth"]), read_cloth_renders(folder)
    points = np.arange(N_POINTS).reshape(SIDE, SIDE)[::STEP, ::STEP].ravel()
    count = group.count_modes(points)
    frames = []
    for (image0, xy0), (image1, xy1) in permutations(renders, 2):
        prepared = matcher.prepare(image0, image1)
        for n in np.unique(count):
            asked = points[count == n]
            match = prepared.match(xy0[asked], n=int(n))
            true = xy1[np.stack([group.distinct_modes(int(point)) for point in asked])]  # (S, n, 2)
            frames.append(pd.DataFrame(compute_query_errors(match.modes, match.covariances, true)))
    return aggregate(pd.concat(frames, ignore_index=True)) | {"pictures": len(renders)}
