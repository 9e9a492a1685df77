"""Positions from the ranges of the last seconds, for all rows on the host: the start of trackers that read ranges."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.parts.multilaterate import multilaterate

MEDIAN_RANGES = 5
"""Latest ranges of an anchor of which the median is taken; it tolerates two outliers."""

CAUCHY_SCALE = 0.3
"""Cauchy scale, m: residuals beyond it are down-weighted."""

MAX_BATCH = 256, 4096
"""Rows solved at once, in a short and in a long recording: two compiled programs in all."""


def recent_positions(
    times: np.ndarray,
    anchors: np.ndarray,
    numbers: np.ndarray,
    ranges: np.ndarray,
    seen: np.ndarray,
    height: float | None,
    windows: tuple[float, ...] = (1.0, 5.0),
) -> np.ndarray:
    """For every row (T, 4): the position from the ranges of the last seconds, m, and 1 where they determine it.

    `times` (T,) s, sorted; `anchors` (A, 3) m; `numbers` (T,): the anchor of each row; `ranges` (T,) m and `seen` (T,).
    With a known `height`, m, three anchors are needed; without, four. The second of the `windows`, s, is used where the
    ranges of the first do not determine the position.
    """
    result = np.zeros((len(times), 4))
    for window in windows:
        open_rows = np.flatnonzero(result[:, 3] == 0)
        if len(open_rows) == 0:
            break
        medians, recent = _medians(times, len(anchors), numbers, ranges, seen, window)
        result[open_rows] = _positions(anchors, medians[open_rows], recent[open_rows], height)
    return result


def _medians(
    times: np.ndarray, count: int, numbers: np.ndarray, ranges: np.ndarray, seen: np.ndarray, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Per row and anchor (T, A): the median of its latest ranges in the window, m, and whether there is one."""
    medians, fresh = np.zeros((len(times), count)), np.zeros((len(times), count), bool)
    for k in range(count):
        mine = np.flatnonzero((numbers == k) & seen)
        if len(mine) == 0:
            continue
        own_times, own = times[mine], ranges[mine]
        back = np.arange(len(mine))[:, None] - np.arange(MEDIAN_RANGES)
        recent = (back >= 0) & (own_times[:, None] - own_times[np.maximum(back, 0)] <= window)
        running = np.nanmedian(np.where(recent, own[np.maximum(back, 0)], np.nan), axis=1)
        # Up to and including this row; later rows at the same time do not count.
        last = np.searchsorted(mine, np.arange(len(times)), side="right") - 1
        fresh[:, k] = (last >= 0) & (times - own_times[np.maximum(last, 0)] <= window)
        medians[:, k] = running[np.maximum(last, 0)]
    return medians, fresh


def _positions(anchors: np.ndarray, ranges: np.ndarray, counts: np.ndarray, height: float | None) -> np.ndarray:
    """`recent_positions` (T, 4) of ranges (T, A) where `counts` (T, A) is true."""
    result = np.zeros((len(ranges), 4))
    known_height = None if height is None else jnp.asarray(height, float)
    batch = MAX_BATCH[0] if len(ranges) <= 4 * MAX_BATCH[0] else MAX_BATCH[1]
    for first in range(0, len(ranges), batch):
        rows = len(ranges[first : first + batch])
        own, own_counts = (np.pad(x[first : first + rows], ((0, batch - rows), (0, 0))) for x in (ranges, counts))
        solved = _solved(jnp.asarray(anchors, float), jnp.asarray(own, float), own_counts, known_height)
        position, determined = (np.asarray(x)[:rows] for x in solved)
        if height is not None:
            position = np.column_stack([position, np.full(rows, height)])
        result[first : first + rows] = np.column_stack([np.where(determined[:, None], position, 0.0), determined])
    return result


@jax.jit
def _solved(anchors: Any, ranges: Any, counts: Any, height: Any) -> tuple[Any, Any]:
    scale = jnp.asarray(CAUCHY_SCALE, ranges.dtype)
    fit = jax.vmap(lambda r, c: multilaterate(r, anchors, c, height, scale))(ranges, counts)
    return fit.position, fit.determined
