"""Autocorrelation over time of a consistency statistic such as NIS, by ranks, on irregular time stamps.

A few large values rule an ordinary correlation, and a wrong noise level shifts all values. Ranks depend on neither.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int, Num

from trackwright.trackers.evaluation.scores import Groups

LAGS_S = {"100ms": 0.1, "1s": 1.0, "5s": 5.0}
"""Lags, s, by the ending of their metric's name."""

TOLERANCE = 0.25
"""Part of the lag by which the time difference of a pair may deviate from the lag."""

ROUNDING_S = 1e-6
"""Differences of times, s, below which they are rounding errors."""

WINDOW_S = 1.0
"""Length, s, of the windows over which ranks are added."""

MIN_PAIRS = 30
"""Pairs of rows below which there is no autocorrelation, and rows below which there is no inflation."""

PAIRED, WINDOWED = ("product", "first", "second", "pairs"), ("window sums", "window squares", "window rows")
"""The sums of each lag, and those over windows of time."""


def correlation(product: np.ndarray, first: np.ndarray, second: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """The autocorrelation (g,) from sums of u_i u_j, u_i², u_j² and 1; NaN with fewer than `MIN_PAIRS` pairs."""
    scale = np.sqrt(first * second)
    enough = (pairs >= MIN_PAIRS) & (scale > 0)
    return np.where(enough, product / np.where(enough, scale, 1.0), math.nan)


def inflation(sums: np.ndarray, squares: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The variance (g,) of sums over windows of time relative to that of independent rows, from sums of these.

    So many rows carry the information of one on the noise level. NaN with fewer than `MIN_PAIRS` rows.
    """
    enough = (rows >= MIN_PAIRS) & (squares > 0)
    return np.where(enough, sums / np.where(enough, squares, 1.0), math.nan)


def rank_sums(
    times: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    dof: Num[np.ndarray, " n"],
    starts: Int[np.ndarray, " g1"],
) -> dict[str, Float[np.ndarray, " g"]]:
    """Sums over the ranks of a statistic, from which its autocorrelation follows for any set of tracks.

    By name, of each of g tracks: over pairs of rows at each lag the `product` u_i u_j, `first` u_i², `second` u_j² and
    the number of `pairs`, as in `pairs 1s`; the `window sums`, squared sums of u over windows of time, and over rows
    the `window squares` u² and their number, `window rows`.

    u: the rank of a row among the rows of its track with the same degrees of freedom, uniform over ±1/2, ties averaged.
    Row j of a pair is nearest to the lag after row i; pairs that miss the lag by more than `TOLERANCE` of it are left
    out. `times`: s, sorted in each track; `starts` (g + 1,): the first row of each track, then n. Rows with dof 0, or
    without time or value, take no part.
    """
    known = np.isfinite(times) & np.isfinite(values) & (dof > 0)
    tracks, times = Groups(starts).where(known, times)
    if not len(times):
        names = [*(f"{what} {lag}" for lag in LAGS_S for what in PAIRED), *WINDOWED]
        return {name: np.zeros(len(starts) - 1) for name in names}
    track = np.repeat(np.arange(len(tracks.count)), tracks.count)
    u = _ranks(values[known], dof[known], track)
    elapsed = times - np.repeat(times[tracks.starts[:-1][tracks.count > 0]], tracks.count[tracks.count > 0])
    result: dict[str, np.ndarray] = {}
    for name, lag in LAGS_S.items():
        i, j = _pairs(elapsed, tracks.starts, lag)
        pairs, first, second = Groups(np.searchsorted(i, tracks.starts)), u[i], u[j]
        sums = *map(pairs.sum, (first * second, first**2, second**2)), pairs.count.astype(float)
        result |= {f"{what} {name}": x for what, x in zip(PAIRED, sums, strict=True)}
    begins = np.flatnonzero(_changes(track, np.floor(elapsed / WINDOW_S)))
    windows = Groups(np.searchsorted(begins, tracks.starts))
    in_windows = windows.sum(np.add.reduceat(u, begins) ** 2), tracks.sum(u**2), tracks.count.astype(float)
    return result | dict(zip(WINDOWED, in_windows, strict=True))


def _ranks(values: np.ndarray, dof: np.ndarray, track: np.ndarray) -> np.ndarray:
    """Ranks within each group of equal track and dof, scaled to −1/2 … 1/2, ties averaged."""
    count, starts = len(values), np.flatnonzero(np.append(_changes(track, dof), True))
    # Mostly the rows of a track have one dof and stand together: sorted group by group they take a fifth of the time.
    if np.count_nonzero(_changes(track)) < len(starts) - 1:
        order = np.lexsort((values, dof, track))
        starts = np.flatnonzero(np.append(_changes(track[order], dof[order]), True))
    else:
        order = _order_within(values, starts)
    tied = _changes(values[order])
    tied[starts[:-1]] = True
    tie = np.flatnonzero(tied)
    middle = np.repeat((tie + np.append(tie[1:], count) - 1) / 2, np.diff(np.append(tie, count)))
    sizes = np.diff(starts)
    ranks = np.empty(count)
    ranks[order] = (middle - np.repeat(starts[:-1], sizes) + 0.5) / np.repeat(sizes, sizes) - 0.5
    return ranks


def _order_within(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The order (n,) that sorts the values of each group; `starts` (g + 1,): the first of each group, then n."""
    lengths = np.diff(starts)
    if (lengths == lengths[0]).all():
        order = np.argsort(values.reshape(len(lengths), -1), axis=1)
        return np.ravel(order + starts[:-1, None])
    return np.concatenate([a + np.argsort(values[a:b]) for a, b in pairwise(starts.tolist())])


def _changes(*columns: np.ndarray) -> np.ndarray:
    """Mask of the rows at which any column differs from the row before; the first row counts."""
    changed = np.zeros(len(columns[0]), bool)
    changed[:1] = True
    for x in columns:
        changed[1:] |= x[1:] != x[:-1]
    return changed


def _pairs(elapsed: np.ndarray, starts: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows (i, j) of one track, j nearest to the lag after i, sorted by i.

    `elapsed` (n,): s since the start of the track; `starts` (g + 1,): the first row of each track, then n.
    """
    lengths = np.diff(starts)
    if len(lengths) > 1 and (lengths == lengths[0]).all():
        # Tracks of simulated recordings have the same times, and then the same pairs.
        each = elapsed.reshape(len(lengths), -1)
        if (each == each[0]).all():
            i, j = _pairs(each[0], starts[:2], lag)
            return (starts[:-1, None] + i).ravel(), (starts[:-1, None] + j).ravel()
    # All tracks one after the other, so that one search serves all. Differences are taken within a track: the pairs of
    # a track then do not depend on the others.
    track = np.repeat(np.arange(len(lengths)), lengths)
    spans = np.zeros(len(lengths))
    spans[lengths > 0] = elapsed[starts[1:][lengths > 0] - 1] + 2 * lag
    at = elapsed + np.repeat(np.cumsum(spans) - spans, lengths)
    i = np.arange(len(at))
    after = np.minimum(np.searchsorted(at, at + lag), len(at) - 1)
    before = np.maximum(after - 1, 0)
    miss_before, miss_after = (
        np.where(track[j] == track, np.abs(elapsed[j] - elapsed - lag), math.inf) for j in (before, after)
    )
    # Half-way between two rows the earlier one counts, whatever the rounding.
    j = np.where(miss_before <= miss_after + ROUNDING_S, before, after)
    usable = (np.minimum(miss_before, miss_after) <= TOLERANCE * lag + ROUNDING_S) & (j > i)
    return i[usable], j[usable]
