"""Binary search in many sorted parts of one array at once."""

from __future__ import annotations

import numpy as np


def first_not_before(times: np.ndarray, low: np.ndarray, high: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The first index in `low` … `high` (N,) of a time that is not before `wanted` (N,); `high` where all are before.

    `times` (n,): sorted between each pair of `low` and `high`.
    """
    for _ in range(int((high - low).max(initial=0)).bit_length()):
        middle = (low + high) // 2
        earlier = times[middle] < wanted
        low, high = np.where(earlier & (low < high), middle + 1, low), np.where(earlier, high, middle)
    return high
