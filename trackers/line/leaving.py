"""Whether a tag has left its line: the difference between a filter held to it and a free one grows and stays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Absence(NamedTuple):
    """A stay away from the line: from the first row of doubt to the first back on it, and how far off at most, m."""

    start: int
    end: int
    farthest: float


def evidence(times: np.ndarray, apart: np.ndarray, slack: np.ndarray | float, most: float = np.inf) -> np.ndarray:
    """The cumulative sum (Page 1954), (T,) m·s, of distance beyond `slack` m times seconds, kept within 0 … `most`.

    `apart` (T,) m between a free and a constrained estimate at `times` (T,) s; NaN adds nothing.
    """
    excess = np.nan_to_num(np.asarray(apart, float) - slack) * np.diff(times, prepend=times[0])
    sums, total = np.zeros(len(excess)), 0.0
    for row, added in enumerate(excess):
        total = sums[row] = min(max(total + added, 0.0), most)
    return sums


def absences(times: np.ndarray, apart: np.ndarray, slack: np.ndarray | float, limit: float) -> list[Absence]:
    """The stays away, from the distances `apart` (T,) m between a free and a constrained estimate at `times` (T,) s.

    By `evidence`, the sum of distance beyond `slack` m times seconds: a stay is certain once it reaches `limit` m·s,
    began when the sum last was zero, and ends when the distance is within the slack for as long as it takes to bring a
    sum cut off at twice the limit back to zero. `end` is T for one that lasts. The detection that chapter 4 of the
    thesis names: the growing difference of both filters.
    """
    found: list[Absence] = []
    total, began, certain = 0.0, 0, False
    for row, after in enumerate(evidence(times, apart, slack, 2.0 * limit)):
        if total == 0.0:
            began = row
        total = float(after)
        if total >= limit:
            certain = True
        if certain and total == 0.0:
            found.append(Absence(began, row, float(np.nanmax(apart[began : row + 1]))))
            certain = False
    if certain:
        found.append(Absence(began, len(times), float(np.nanmax(apart[began:]))))
    return found
