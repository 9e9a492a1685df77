"""The autocorrelation time of errors: of the readings against truth, without truth about a local line."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trackwright.trackers.recordings.checks.check_result import CheckResult
from trackwright.trackers.recordings.checks.readings import LINE_S, Readings, robust_std
from trackwright.trackers.recordings.kinds import unit_of

LEAST_PAIRS = 50
"""Least number of pairs of errors at a lag."""

MOST_TIMES = 10_000
"""Pairs whose median interval is that of a lag."""

BOUND = 4.0
"""Robust standard deviations at which errors are cut off: outliers would hide the correlation of the others."""

_LEVEL = math.exp(-1.0)


class Correlation(NamedTuple):
    """`time`, s: at which the autocorrelation falls to 1/e. `interval`, s: between readings of a stream.

    `resolved`: it falls there after the first interval. `ended`: within the recording; else `time` is the longest lag.
    `sigma`: the robust standard deviation about the mean of each stream.
    """

    time: float
    interval: float
    resolved: bool
    ended: bool
    sigma: float


def check_correlation(name: str, read: Readings, errors: np.ndarray, true: bool) -> list[CheckResult]:
    """The autocorrelation time of each column's `errors` (N, m): against truth, or about a local line."""
    results = []
    for k, column in enumerate(read.columns):
        found = autocorrelation(read, errors[:, k])
        if found is None or (not true and not found.resolved):
            continue
        unit = unit_of(column)
        what = f"errors of {column} against truth" if true else f"{column} about a line through {LINE_S:g} s"
        line = f"{what}: standard deviation {found.sigma:.2g} {unit}, {_duration(found)}"
        if found.resolved:
            line += f"; effective sample size: 1 in {float(f'{2 * found.time / found.interval:.2g}'):g} readings"
            line += "" if true else " at most; slower errors only show against truth"
        results.append(CheckResult("info", name, line))
    return results


def _duration(found: Correlation) -> str:
    if not found.resolved:
        return f"uncorrelated after {found.interval:.2g} s"
    return f"correlated for {'' if found.ended else 'more than '}{found.time:.2g} s"


def autocorrelation(read: Readings, errors: np.ndarray) -> Correlation | None:
    """The autocorrelation of errors (N,) along the streams; None for too few of them, or constant ones."""
    seen = np.isfinite(errors)
    # Of readings with one time the first: copies would count as readings without an interval.
    seen[1:] &= (np.diff(read.times) > 0) | (np.diff(read.stream) != 0)
    stream, times, x = read.stream[seen], read.times[seen], errors[seen]
    if len(x) < LEAST_PAIRS:
        return None
    _, number, counts = np.unique(stream, return_inverse=True, return_counts=True)
    x = x - (np.bincount(number, x) / counts)[number]
    sigma = float(robust_std(x[:, None])[0])
    if sigma == 0.0:
        return None
    x = np.clip(x, -BOUND * sigma, BOUND * sigma)
    variance = float(np.mean(x * x))
    before, at, interval, lag = 1.0, 0.0, math.nan, 1
    longest = counts.max() // 4
    while lag <= longest:
        pairs = stream[lag:] == stream[:-lag]
        count = int(np.count_nonzero(pairs))
        if count < LEAST_PAIRS:
            break
        some = slice(None, None, 1 + len(pairs) // MOST_TIMES)
        later = float(np.median((times[lag:][some] - times[:-lag][some])[pairs[some]]))
        interval = later if lag == 1 else interval
        value = float(np.einsum("n,n->", x[lag:] * pairs, x[:-lag])) / count / variance
        if value < _LEVEL:
            fallen = at + (later - at) * (before - _LEVEL) / (before - value)
            return Correlation(fallen, interval, lag > 1, True, sigma)
        before, at, lag = value, later, max(lag + 1, int(1.25 * lag))
    return None if math.isnan(interval) else Correlation(at, interval, True, False, sigma)
