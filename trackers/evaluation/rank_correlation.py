"""Autocorrelation over time of a consistency statistic such as NIS, by ranks, on irregular time stamps.

A few large values rule an ordinary correlation, and a wrong noise level shifts all values. Ranks depend on neither.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int, Num

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
    n_tracks = len(starts) - 1
    result: dict[str, np.ndarray] = {f"{what} {lag}": np.zeros(n_tracks) for lag in LAGS_S for what in PAIRED}
    result |= {name: np.zeros(n_tracks) for name in WINDOWED}
    rows = np.flatnonzero(np.isfinite(times) & np.isfinite(values) & (dof > 0))
    if not len(rows):
        return result
    track = np.repeat(np.arange(n_tracks), np.diff(starts))[rows]
    u = _ranks(values[rows], dof[rows], track)
    begins = np.flatnonzero(_changes(track))
    elapsed = times[rows] - np.repeat(times[rows[begins]], np.diff(np.append(begins, len(rows))))
    for name, lag in LAGS_S.items():
        i, j = _pairs(elapsed, track, lag)
        first, second, of_track = u[i], u[j], track[i]
        for what, x in zip(PAIRED, (first * second, first**2, second**2, np.ones(len(i))), strict=True):
            result[f"{what} {name}"] = np.bincount(of_track, x, minlength=n_tracks)
    begins = np.flatnonzero(_changes(track, np.floor(elapsed / WINDOW_S)))
    sums = np.add.reduceat(u, begins)
    of_windows = (track[begins], sums**2), (track, u**2), (track, np.ones(len(u)))
    for name, (of_track, x) in zip(WINDOWED, of_windows, strict=True):
        result[name] = np.bincount(of_track, x, minlength=n_tracks)
    return result


def _ranks(values: np.ndarray, dof: np.ndarray, track: np.ndarray) -> np.ndarray:
    """Ranks within each group of equal track and dof, scaled to −1/2 … 1/2, ties averaged."""
    starts = np.flatnonzero(np.append(_changes(track, dof), True))
    # Mostly the rows of a track have one dof and stand together: sorted group by group they take a fifth of the time.
    apart = np.count_nonzero(_changes(track)) < len(starts) - 1
    order = np.lexsort((values, dof, track)) if apart else _order_within(values, starts)
    group = np.flatnonzero(_changes(track[order], dof[order]))
    tie = np.flatnonzero(_changes(track[order], dof[order], values[order]))
    count = len(values)
    middle = np.repeat((tie + np.append(tie[1:], count) - 1) / 2, np.diff(np.append(tie, count)))
    sizes = np.diff(np.append(group, count))
    ranks = np.empty(count)
    ranks[order] = (middle - np.repeat(group, sizes) + 0.5) / np.repeat(sizes, sizes) - 0.5
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
    changed = np.ones(len(columns[0]), bool)
    changed[1:] = np.any([x[1:] != x[:-1] for x in columns], axis=0)
    return changed


def _pairs(elapsed: np.ndarray, track: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of rows (i, j) of one track, j nearest to the lag after i; `elapsed`: s since the start of the track."""
    # All tracks one after the other, so that one search serves all. Differences are taken within a track: the pairs of
    # a track then do not depend on the others.
    last = np.flatnonzero(np.append(_changes(track)[1:], True))
    spans = elapsed[last] + 2 * lag
    at = elapsed + np.repeat(np.cumsum(spans) - spans, np.diff(np.append(-1, last)))
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
