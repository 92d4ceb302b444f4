"""Tables of queries of the cloth whose errors are known."""

from __future__ import annotations

import numpy as np
import pandas as pd

from mmgsd.measure.regions import find_regions


def make_queries(corner: float, other: float, points: int = 625) -> pd.DataFrame:
    """Each point once, with an RMSE of ``corner`` or ``other`` px, and once with a hidden source and a huge one."""
    point = np.unique(np.linspace(0, 624, points).round().astype(int))
    errors = np.where(find_regions()["corner"][point], corner, other)
    table = pd.DataFrame({"point": point, "visible": True, "rmse_px": errors, "entropy": errors / 10})
    hidden = table.assign(visible=False, rmse_px=1e6)
    return pd.concat([table, hidden], ignore_index=True)
