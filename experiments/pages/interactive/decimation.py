"""Which rows, tags and events a page holds where a recording has more than a browser draws fluently."""

from __future__ import annotations

import numpy as np

MOST_ROWS, MOST_TRACKS, MOST_POINTS, MOST_EVENTS = 25_000, 300, 12_000, 1_000
"""The most estimates, tracks, residuals and events of a page, over all its recordings."""


def drawn_tracks(worst_first: list[int], most: int) -> list[int]:
    """The numbers of the tracks that are drawn, ascending: all, or evenly over the ranks from the worst to the best."""
    if len(worst_first) <= most:
        return sorted(worst_first)
    return sorted({worst_first[k] for k in np.linspace(0, len(worst_first) - 1, most).round().astype(int)})


def drawn_rows(lengths: np.ndarray, weight: np.ndarray, most: int) -> np.ndarray:
    """The rows that are drawn, ascending: all, or the first, the last and those with the largest weight of each block.

    Blocks of equal length; `lengths` (g,): rows of each track; `weight` (n,): the size of the error, NaN as zero. About
    `most` rows, two of each block at least.
    """
    n = int(lengths.sum())
    if n <= most:
        return np.arange(n)
    size = -(-2 * n // max(most - 2 * len(lengths), 2))
    first = np.cumsum(lengths) - lengths
    within = np.arange(n) - np.repeat(first, lengths)
    begins = np.flatnonzero(within % size == 0)
    block = np.repeat(np.arange(len(begins)), np.diff(np.append(begins, n)))
    order = np.lexsort((-np.nan_to_num(weight), block))
    return np.unique(np.concatenate([begins, order[begins], first + lengths - 1]))
