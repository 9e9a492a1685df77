"""Detection of a tag that leaves its line, from the distance between a free and a path-constrained estimate."""

from __future__ import annotations

import numpy as np


def cusum(times: np.ndarray, distance: np.ndarray, slack: np.ndarray | float, cap: float = np.inf) -> np.ndarray:
    """The cumulative sum (Page 1954) of distance beyond `slack` m times seconds, (T,) m·s, clipped to 0 … `cap`.

    `distance` (T,) m between a free and a constrained estimate at `times` (T,) s; NaN adds nothing.
    """
    excess = np.nan_to_num(np.asarray(distance, float) - slack) * np.diff(times, prepend=times[0])
    sums, total = np.zeros(len(excess)), 0.0
    for row, added in enumerate(excess):
        total = sums[row] = min(max(total + added, 0.0), cap)
    return sums
