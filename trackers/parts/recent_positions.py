"""Positions from the ranges of the last seconds, for all rows on the host: the start of trackers that read ranges."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.chunks import called
from trackers.parts.multilaterate import multilaterate

MEDIAN_RANGES = 5
"""Latest ranges of an anchor of which the median is taken; it tolerates two outliers."""

CAUCHY_SCALE = 0.3
"""Cauchy scale, m: residuals beyond it are down-weighted."""

MAX_BATCH = 256, 4096
"""Rows solved at once, in a short and in a long recording: two compiled programs in all."""


def recent_positions(
    starts: np.ndarray,
    times: np.ndarray,
    anchors: np.ndarray,
    numbers: np.ndarray,
    ranges: np.ndarray,
    seen: np.ndarray,
    heights: np.ndarray,
    windows: tuple[float, ...] = (1.0, 5.0),
) -> np.ndarray:
    """For every row (N, 4): the position from the ranges of the last seconds, m, and 1 where they determine it.

    `starts` (n + 1,): the first row of each of n tags, then N. `times` (N,) s, sorted by tag; `anchors` (A, 3) m;
    `numbers` (N,): the anchor of each row; `ranges` (N,) m and `seen` (N,). `heights` (n,) m: of the tags; with a known
    one three anchors are needed, without, NaN, four. The second of the `windows`, s, is used where the ranges of the
    first do not determine the position.
    """
    result = np.zeros((len(times), 4))
    tag = np.repeat(np.arange(len(heights)), np.diff(starts))
    own_heights = heights[tag]
    latest = latest_rows(starts, numbers, seen, len(anchors))
    for window in windows:
        rows = np.flatnonzero(result[:, 3] == 0)
        if len(rows) == 0:
            break
        medians = _medians(starts, times, numbers, ranges, seen, window)
        recent = (latest[rows] >= 0) & (times[rows, None] - times[latest[rows]] <= window)
        # The rows of short recordings together, and those of long ones: the two programs differ in last bits.
        short = (np.bincount(tag[rows]) <= 4 * MAX_BATCH[0])[tag[rows]]
        for height in np.unique(heights):
            at_height = np.isnan(own_heights[rows]) if np.isnan(height) else own_heights[rows] == height
            known = None if np.isnan(height) else float(height)
            for batch, of_size in zip(MAX_BATCH, (short, ~short), strict=True):
                part = np.flatnonzero(at_height & of_size)
                result[rows[part]] = _positions(anchors, medians[latest[rows[part]]], recent[part], known, batch)
    return result


def latest_rows(starts: np.ndarray, numbers: np.ndarray, seen: np.ndarray, count: int) -> np.ndarray:
    """The latest row, up to and including each (N, A), of the same tag with a range to each of A anchors; −1 if none.

    `starts` (n + 1,): the first row of each tag, then N. `numbers` (N,): the anchor of each row. Later rows at the same
    time do not count.
    """
    rows = np.arange(len(numbers))
    first = np.repeat(starts[:-1], np.diff(starts))
    found = np.empty((len(numbers), count), int)
    for anchor in range(count):
        latest = np.maximum.accumulate(np.where(seen & (numbers == anchor), rows, -1))
        found[:, anchor] = np.where(latest >= first, latest, -1)
    return found


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


def _positions(
    anchors: np.ndarray, ranges: np.ndarray, counts: np.ndarray, height: float | None, batch: int
) -> np.ndarray:
    """`recent_positions` (T, 4) of ranges (T, A) where `counts` (T, A) is true, `batch` rows at once."""
    result = np.zeros((len(ranges), 4))
    known = jnp.asarray(anchors, float), None if height is None else jnp.asarray(height, float)
    for first in range(0, len(ranges), batch):
        rows = len(ranges[first : first + batch])
        own, own_counts = (np.pad(x[first : first + rows], ((0, batch - rows), (0, 0))) for x in (ranges, counts))
        solved = called(_solved, known, (jnp.asarray(own, float), jnp.asarray(own_counts)))
        position, determined = (np.asarray(x)[:rows] for x in solved)
        if height is not None:
            position = np.column_stack([position, np.full(rows, height)])
        result[first : first + rows] = np.column_stack([np.where(determined[:, None], position, 0.0), determined])
    return result


def _solved(known: tuple[Any, Any], measured: tuple[Any, Any]) -> tuple[Any, Any]:
    """Positions and whether they are determined; `known`: anchors and height; `measured`: ranges and which count."""
    (anchors, height), (ranges, counts) = known, measured
    scale = jnp.asarray(CAUCHY_SCALE, ranges.dtype)
    fit = jax.vmap(lambda r, c: multilaterate(r, anchors, c, height, scale), -1, -1)(ranges.T, counts.T)
    return fit.position.T, fit.determined
