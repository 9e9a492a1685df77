"""Positions from the ranges of the last seconds, for all rows on the host, from which range trackers start."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.run.chunks import called
from trackwright.trackers.parts.multilaterate import multilaterate

MEDIAN_RANGES = 5
"""Number of an anchor's latest ranges in the median, which tolerates two outliers."""

WINDOWS_S = (1.0, 5.0)
"""Windows of recent ranges, s, the shortest first."""

CAUCHY_SCALE = 0.3
"""Cauchy scale, m: residuals beyond it are down-weighted."""

BLOCK, BLOCKS = 256, 16
"""Rows solved at once, few enough for the processor's cache, and blocks of them per call."""


def recent_positions(
    starts: np.ndarray,
    times: np.ndarray,
    anchors: np.ndarray,
    numbers: np.ndarray,
    ranges: np.ndarray,
    seen: np.ndarray,
    heights: np.ndarray,
) -> np.ndarray:
    """For every row (N, 4): the position from the ranges of the last seconds, m, and 1 where they determine it.

    `starts` (n + 1,): the first row of each of n tags, then N. `times` (N,) s, sorted by tag; `anchors` (A, 3) m;
    `numbers` (N,): the anchor of each row; `ranges` (N,) m and `seen` (N,). `heights` (n,) m: of the tags; with a known
    one three anchors are needed, without, NaN, four. The second of `WINDOWS_S` is used where the ranges of the first do
    not determine the position.
    """
    result = np.zeros((len(times), 4))
    tag = np.repeat(np.arange(len(heights)), np.diff(starts))
    row_heights = heights[tag]
    latest = latest_rows(starts, numbers, seen, len(anchors))
    for window in WINDOWS_S:
        rows = np.flatnonzero(result[:, 3] == 0)
        if len(rows) == 0:
            break
        medians = _medians(starts, times, numbers, ranges, seen, window)
        recent = (latest[rows] >= 0) & (times[rows, None] - times[latest[rows]] <= window)
        for height in np.unique(heights):
            at_height = np.isnan(row_heights[rows]) if np.isnan(height) else row_heights[rows] == height
            known = None if np.isnan(height) else float(height)
            part = np.flatnonzero(at_height)
            result[rows[part]] = _positions(anchors, medians[latest[rows[part]]], recent[part], known)
    return result


def latest_rows(starts: np.ndarray, numbers: np.ndarray, seen: np.ndarray, count: int) -> np.ndarray:
    """For each row, the latest row (N, A) so far of the same tag with a range to each of A anchors; −1 if none.

    `starts` (n + 1,): the first row of each tag, then N. `numbers` (N,): the anchor of each row. Later rows at the same
    time do not count.
    """
    rows = np.arange(len(numbers))
    first = np.repeat(starts[:-1], np.diff(starts))
    latest_of_each = np.empty((len(numbers), count), int)
    for anchor in range(count):
        latest = np.maximum.accumulate(np.where(seen & (numbers == anchor), rows, -1))
        latest_of_each[:, anchor] = np.where(latest >= first, latest, -1)
    return latest_of_each


def _medians(
    starts: np.ndarray, times: np.ndarray, numbers: np.ndarray, ranges: np.ndarray, seen: np.ndarray, window: float
) -> np.ndarray:
    """Per row with a range (N,): the median of its anchor's latest ranges to the tag in the window, m."""
    tag = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    kept = np.flatnonzero(seen)
    order = kept[np.lexsort((numbers[kept], tag[kept]))]
    same = tag[order] * (int(numbers.max(initial=0)) + 1) + numbers[order]
    back = np.arange(len(order))[:, None] - np.arange(MEDIAN_RANGES)
    before = np.maximum(back, 0)
    recent = (back >= 0) & (same[before] == same[:, None]) & (times[order][:, None] - times[order][before] <= window)
    ordered = np.sort(np.where(recent, ranges[order][before], np.inf), axis=1)
    count = recent.sum(axis=1)
    row = np.arange(len(order))
    medians = np.zeros(len(times))
    medians[order] = (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2.0
    return medians


def _positions(anchors: np.ndarray, ranges: np.ndarray, counts: np.ndarray, height: float | None) -> np.ndarray:
    """`recent_positions` (T, 4) from ranges (T, A) where `counts` (T, A) is true."""
    result = np.zeros((len(ranges), 4))
    # Arrays of NumPy go to the device with the call, in a third of the time.
    floating = jax.dtypes.canonicalize_dtype(float)
    known = np.asarray(anchors, floating), None if height is None else np.asarray(height, floating)
    for first in range(0, len(ranges), BLOCK * BLOCKS):
        part = slice(first, first + BLOCK * BLOCKS)
        rows = len(ranges[part])
        padded, padded_counts = (np.zeros((BLOCKS * BLOCK, len(anchors)), kind) for kind in (floating, bool))
        padded[:rows], padded_counts[:rows] = ranges[part], counts[part]
        solved = called(
            _solved, known, (_in_blocks(padded), _in_blocks(padded_counts), np.asarray(-(-rows // BLOCK), np.int32))
        )
        position, determined = (np.moveaxis(np.asarray(x), -1, 1).reshape(BLOCKS * BLOCK, -1)[:rows] for x in solved)
        of_part = result[part]
        of_part[:, : position.shape[1]] = np.where(determined, position, 0.0)
        if height is not None:
            of_part[:, 2] = np.where(determined[:, 0], height, 0.0)
        of_part[:, 3] = determined[:, 0]
    return result


def _in_blocks(rows: np.ndarray) -> np.ndarray:
    """The rows (BLOCKS · BLOCK, A) in blocks, rows of a block last (BLOCKS, A, BLOCK)."""
    return np.ascontiguousarray(np.moveaxis(rows.reshape(BLOCKS, BLOCK, -1), 1, -1))


def _solved(known: tuple[Any, Any], measured: tuple[Any, Any, Any]) -> tuple[Any, Any]:
    """Positions (BLOCKS, n, BLOCK) of the first blocks, and whether they are determined (BLOCKS, 1, BLOCK).

    `known`: anchors and height. `measured`: ranges, which of them count, and the number of blocks.
    """
    (anchors, height), (ranges, counts, blocks) = known, measured
    scale = jnp.asarray(CAUCHY_SCALE, ranges.dtype)

    def solve(block: Any, solved: tuple[Any, Any]) -> tuple[Any, Any]:
        fit = jax.vmap(lambda r, c: multilaterate(r, anchors, c, height, scale), -1, -1)(ranges[block], counts[block])
        return solved[0].at[block].set(fit.position), solved[1].at[block, 0].set(fit.determined)

    axes = 3 if height is None else 2
    nothing = jnp.zeros((BLOCKS, axes, BLOCK), ranges.dtype), jnp.zeros((BLOCKS, 1, BLOCK), bool)
    return jax.lax.fori_loop(0, blocks, solve, nothing)
