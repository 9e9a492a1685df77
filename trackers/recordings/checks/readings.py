"""The readings of a table by stream, and their differences from the true values and from a local line.

Checks of these: readings that repeat the one before; quantisation steps, the smallest spacing of which nearly all
differences are multiples; the autocorrelation time of errors, against truth or about a local line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.columns import stable_order
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, unit_of, wrapped

MOST_ROWS, MOST_DIFFERENCES, MOST_TIMES = 100_000, 20_000, 10_000
"""Readings of a table that are looked at, of a column whose differences are, and pairs that tell a lag's interval."""

LINE_S, LEAST_ROWS, LEAST_VALUES, LEAST_PAIRS = 2.0, 5, 20, 50
"""Time, s, over which a line is put through readings; least numbers of readings of a line, of differences of which a
step is looked for, and of pairs of errors at a lag."""

FEW, MANY = 0.01, 0.2
"""Share of repeated readings that is reported, and that is a warning."""

MULTIPLES, NEAR, COARSE = 0.95, 0.02, 0.1
"""Of quantisation: the least share of the differences that are multiples of a step; the distance from a multiple, in
steps: one in 25 differences of a continuous value is as near; and the least step that is reported, relative to the
scatter of the readings: a finer one adds nothing to their noise."""

CANDIDATES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3])
"""Quantiles of the differences that are tried as steps."""

BOUND = 4.0
"""Robust standard deviations at which errors are cut off: outliers would hide the correlation of the others."""


class Readings(NamedTuple):
    """The rows of a table, of a stream (one tag and one anchor or station) one after another, by time.

    `stream` (N,): its number. `times` (N,) s. `values` (N, m): of the `columns`, NaN where one is missing. `errors`
    (N, m): their differences from the true values, NaN where these are unknown.
    """

    columns: tuple[str, ...]
    stream: Int[np.ndarray, " N"]
    times: Float[np.ndarray, " N"]
    values: Float[np.ndarray, "N m"]
    errors: Float[np.ndarray, "N m"]


def readings(recording: RecordingFolder, name: str, errors: bool = True) -> Readings:
    """The readings of a table with measurements; of more than `MOST_ROWS`, equally many first ones of each stream.

    Without `errors` these are unknown.
    """
    rows, kind = recording.rows(name), KINDS[name]
    measured = kind.measured(recording.rig, rows)
    stream = rows.of_each(np.arange(len(rows.tags)))
    for number in measured.sensors.number.T:
        stream = stream * len(measured.ids) + number
    order = stable_order(stream)
    if len(order) > MOST_ROWS:
        counts = np.bincount(stream)
        within = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        order = order[within < MOST_ROWS // np.count_nonzero(counts)]
    times, measured = rows.times[order], measured.of_rows(order)
    differences = np.full(measured.values.shape, np.nan)
    if errors and len(recording.paths.times) and kind.averaged and kind.predicted is not None:
        # The order is one of tags too.
        tag = np.searchsorted(rows.starts, order, side="right") - 1
        starts = np.searchsorted(tag, np.arange(len(rows.tags) + 1))
        differences = measured.errors(recording.paths.at(rows.tags, starts, times)[0])
    return Readings(measured.columns, stream[order], times, measured.values, differences)


def about_local_line(read: Readings) -> Float[np.ndarray, "N m"]:
    """The differences (N, m) of readings from a line through those around them; NaN where there are too few."""
    differences = np.full(read.values.shape, np.nan)
    for k, column in enumerate(read.columns):
        seen = np.flatnonzero(np.isfinite(read.values[:, k]))
        if not len(seen):
            continue
        x, t = read.values[seen, k], read.times[seen] - read.times.mean()
        x = np.unwrap(x) if column.endswith("_rad") else x - np.mean(x)
        # Streams one after another on one axis of time, too far apart to share a line.
        at = t + (np.ptp(t) + 2 * LINE_S) * read.stream[seen]
        first, end = (
            np.searchsorted(at, at + way * LINE_S / 2, side="left" if way < 0 else "right") for way in (-1, 1)
        )
        sums = np.cumsum(np.pad(np.stack([t, x, t * t, t * x], axis=1), ((1, 0), (0, 0))), axis=0)
        count = end - first
        mean_t, mean_x, square, product = ((sums[end] - sums[first]) / count[:, None]).T
        variance = square - mean_t**2
        slope = (product - mean_t * mean_x) / np.where(variance > 0, variance, 1.0)
        line = mean_x + slope * (t - mean_t)
        differences[seen, k] = np.where((count >= LEAST_ROWS) & (variance > 0), x - line, np.nan)
    return differences


def known_median(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The median (m,) of each column without its missing values, NaN without any value."""
    return np.array([np.median(c[~np.isnan(c)]) if not np.isnan(c).all() else np.nan for c in x.T])


def robust_std(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The standard deviation (m,) of each column from its median size, blind to outliers; 0 without any value."""
    return np.nan_to_num(1.4826 * known_median(np.abs(x)))


def check_readings(recording: RecordingFolder, name: str) -> Iterator[CheckResult]:
    """Repeats, quantisation steps and the correlation time of the readings of a table."""
    read, kind = readings(recording, name), KINDS[name]
    about, share, steps = about_local_line(read), repeated_share(read), dict[float, list[str]]()
    if share >= FEW:
        of = "tag and pair of anchors" if kind.difference else " and ".join(kind.layout(()).ids)
        message = f"repeated readings: {100 * share:.2g} % of the rows equal the previous row of the same {of}"
        expected = "; expected one row per measurement" if share >= MANY else ""
        yield CheckResult("warning" if share >= MANY else "info", name, message + expected)
    for k, (column, scatter) in enumerate(zip(read.columns, robust_std(about), strict=True)):
        if (found := quantisation_step(read, k)) is not None and found >= COARSE * scatter:
            steps.setdefault(float(f"{found:.3g}"), []).append(column)
    for step, columns in steps.items():
        unit = unit_of(columns[0])
        degrees = f" ({math.degrees(step):.3g}°)" if unit == "rad" else ""
        message = (
            f"quantised: {', '.join(columns)} in steps of {step:.3g} {unit}{degrees}; their standard deviation is "
        )
        yield CheckResult("info", name, f"{message}at least step/√12 = {step / math.sqrt(12):.2g} {unit}")
    true = bool(np.isfinite(read.errors).any())
    # A local line through an IMU or phases does not follow the motion.
    for k, column in enumerate(read.columns if kind.averaged else ()):
        known = autocorrelation(read, (read.errors if true else about)[:, k])
        if known is None or not (true or known.resolved):
            continue
        what = f"errors of {column} against truth" if true else f"{column} about a line through {LINE_S:g} s"
        lasting = f"uncorrelated after {known.interval:.2g} s"
        if known.resolved:
            size = float(f"{2 * known.time / known.interval:.2g}")
            lasting = f"correlated for {'' if known.ended else 'more than '}{known.time:.2g} s"
            lasting += f"; effective sample size: 1 in {size:g} readings"
            lasting += "" if true else " at most; slower errors only show against truth"
        message = f"{what}: standard deviation {known.sigma:.2g} {unit_of(column)}, {lasting}"
        yield CheckResult("info", name, message)


def repeated_share(read: Readings) -> float:
    """The share of the readings with a predecessor in their stream that equal it in all columns; NaN without any."""
    follows, moved = changes(read)
    return float(np.mean((moved[follows] == 0.0).all(axis=1))) if follows.any() else float("nan")


def changes(read: Readings) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """Of each reading but the first, in order: whether it is of the stream of the one before, and the change from it.

    Rows without any value are left out. Where both lack a column its change is zero, where one does infinite.
    """
    seen = np.isfinite(read.values).any(axis=1)
    values, stream = read.values[seen], read.stream[seen]
    missing = np.isnan(values)
    moved = np.where(missing[1:] & missing[:-1], 0.0, wrapped(np.diff(values, axis=0), read.columns))
    return stream[1:] == stream[:-1], np.where(np.isnan(moved), np.inf, moved)


def quantisation_step(read: Readings, column: int) -> float | None:
    """The quantisation step of a column, in its unit; None where its values are not multiples of one."""
    x, stream = read.values[:MOST_DIFFERENCES, column], read.stream[:MOST_DIFFERENCES]
    seen = np.isfinite(x)
    x, stream = x[seen], stream[seen]
    # The offsets of streams may differ, as their wraps may.
    differences = np.abs(wrapped(np.diff(x)[:, None], (read.columns[column],))[:, 0][stream[1:] == stream[:-1]])
    resolution = 1e-12 * (1.0 + np.abs(x).max(initial=0.0))
    differences = differences[differences > resolution]
    if len(differences) < LEAST_VALUES:
        return None
    spacings = np.diff(np.sort(x[stream == np.bincount(stream).argmax()]))
    candidates = np.concatenate([spacings[spacings > resolution], differences])
    # The coarsest first: a few values off the steps, as means of two, are multiples of half a step.
    for candidate in np.unique(np.quantile(candidates, CANDIDATES, method="lower"))[::-1]:
        multiples = np.round(differences / candidate)
        good = (np.abs(differences / candidate - multiples) < NEAR) & (multiples > 0)
        if good.mean() >= MULTIPLES:
            return float(differences[good].sum() / multiples[good].sum())
    return None


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
    before, at, interval, lag, level = 1.0, 0.0, math.nan, 1, math.exp(-1.0)
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
        if value < level:
            fallen = at + (later - at) * (before - level) / (before - value)
            return Correlation(fallen, interval, lag > 1, True, sigma)
        before, at, lag = value, later, max(lag + 1, int(1.25 * lag))
    return None if math.isnan(interval) else Correlation(at, interval, True, False, sigma)
