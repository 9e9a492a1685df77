"""Detection of a tag that leaves its line, from the distance between a free and a path-constrained estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Excursion(NamedTuple):
    """Time off the line: the first row off it, the first row back on it, and the greatest distance, m."""

    start: int
    end: int
    farthest: float


def cusum(times: np.ndarray, distance: np.ndarray, slack: np.ndarray | float, cap: float = np.inf) -> np.ndarray:
    """The cumulative sum (Page 1954) of distance beyond `slack` m times seconds, (T,) m·s, clipped to 0 … `cap`.

    `distance` (T,) m between a free and a constrained estimate at `times` (T,) s; NaN adds nothing.
    """
    excess = np.nan_to_num(np.asarray(distance, float) - slack) * np.diff(times, prepend=times[0])
    sums, total = np.zeros(len(excess)), 0.0
    for row, added in enumerate(excess):
        total = sums[row] = min(max(total + added, 0.0), cap)
    return sums


def excursions(times: np.ndarray, distance: np.ndarray, slack: np.ndarray | float, limit: float) -> list[Excursion]:
    """The excursions, from the `distance` (T,) m between a free and a constrained estimate at `times` (T,) s.

    An excursion is detected once `cusum`, capped at twice `limit` m·s, reaches `limit`. It starts where the sum was
    last zero and ends where the sum is zero again; `end` is T if it lasts. Chapter 4 of the thesis proposes this
    detection, the growing difference of both filters.
    """
    detections: list[Excursion] = []
    total, start, detected = 0.0, 0, False
    for row, after in enumerate(cusum(times, distance, slack, 2.0 * limit)):
        if total == 0.0:
            start = row
        total = float(after)
        if total >= limit:
            detected = True
        if detected and total == 0.0:
            detections.append(Excursion(start, row, float(np.nanmax(distance[start : row + 1]))))
            detected = False
    if detected:
        detections.append(Excursion(start, len(times), float(np.nanmax(distance[start:]))))
    return detections
