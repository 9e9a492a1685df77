"""The readings of a table by stream: repeats, quantisation steps, and how long their errors against truth last."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.recordings.checks import CheckResult
from trackwright.trackers.recordings.columns import stable_order, within_groups
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, unit_of, wrapped

MOST_ROWS, MOST_DIFFERENCES, MOST_TIMES = 100_000, 20_000, 10_000
"""Readings of a table that are looked at, of a column whose differences are, and pairs that tell a lag's interval."""

LEAST_VALUES, LEAST_PAIRS, FEW, MANY = 20, 50, 0.01, 0.2
"""Least differences of which a step is looked for, and pairs of errors at a lag; share of repeated readings that is
reported, and that is a warning."""

MULTIPLES, NEAR, COARSE, BOUND = 0.95, 0.02, 0.1, 4.0
"""Least share of differences that are multiples of a step, and the distance from one, in steps: one in 25 continuous
values is as near; least step beside the scatter of readings that is reported; robust standard deviations at which
errors are cut off, since outliers would hide the correlation of the others."""

CANDIDATES = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3])
"""Quantiles of the differences that are tried as steps."""


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
        order = order[within_groups(counts) < MOST_ROWS // np.count_nonzero(counts)]
    times, measured = rows.times[order], measured.of_rows(order)
    differences = np.full(measured.values.shape, np.nan)
    if errors and len(recording.paths.times) and kind.averaged and kind.predicted is not None:
        # The order is one of tags too.
        tag = np.searchsorted(rows.starts, order, side="right") - 1
        starts = np.searchsorted(tag, np.arange(len(rows.tags) + 1))
        differences = measured.errors(recording.paths.at(rows.tags, starts, times)[0])
    return Readings(measured.columns, stream[order], times, measured.values, differences)


def known_median(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The median (m,) of each column without its missing values, NaN without any value."""
    return np.array([np.median(c[~np.isnan(c)]) if not np.isnan(c).all() else np.nan for c in x.T])


def check_readings(recording: RecordingFolder, name: str) -> Iterator[CheckResult]:
    """Repeats, quantisation steps and, against truth, the correlation time of the errors of a table."""
    read, kind = readings(recording, name), KINDS[name]
    share, steps = repeated_share(read), dict[float, list[str]]()
    if share >= FEW:
        of = "tag and pair of anchors" if kind.difference else " and ".join(kind.layout(()).ids)
        message = f"repeated readings: {100 * share:.2g} % of the rows equal the previous row of the same {of}"
        expected = "; expected one row per measurement" if share >= MANY else ""
        yield CheckResult("warning" if share >= MANY else "info", name, message + expected)
    follows, moved = changes(read)
    scatter = 1.4826 / math.sqrt(2) * np.nan_to_num(known_median(np.abs(moved[follows])))
    for k, column in enumerate(read.columns):
        if (step := quantisation_step(read, k)) is not None and step >= COARSE * scatter[k]:
            steps.setdefault(float(f"{step:.3g}"), []).append(column)
    for step, columns in steps.items():
        unit = unit_of(columns[0])
        degrees = f" ({math.degrees(step):.3g}°)" if unit == "rad" else ""
        message = (
            f"quantised: {', '.join(columns)} in steps of {step:.3g} {unit}{degrees}; standard deviation at least "
        )
        yield CheckResult("info", name, f"{message}step/√12 = {step / math.sqrt(12):.2g} {unit}")
    for k, column in enumerate(read.columns):
        if (known := autocorrelation(read, read.errors[:, k])) is not None:
            sigma, interval, time = known
            lasting = f"uncorrelated after {interval:.2g} s"
            if time > 0:
                size = f"; effective sample size: 1 in {float(f'{2 * time / interval:.2g}'):g} readings"
                lasting = f"correlated for {time:.2g} s{size}" if time < math.inf else "correlated throughout"
            spread = f"standard deviation {sigma:.2g} {unit_of(column)}"
            yield CheckResult("info", name, f"errors of {column} against truth: {spread}, {lasting}")


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


def autocorrelation(read: Readings, errors: np.ndarray) -> tuple[float, float, float] | None:
    """Of errors (N,) along the streams: standard deviation, interval, s, and the time to a correlation of 1/e.

    The time is 0 within an interval, and infinite beyond the recording. None for too few errors, or constant ones.
    """
    seen = np.isfinite(errors)
    # Of readings with one time the first: copies would count as readings without an interval.
    seen[1:] &= (np.diff(read.times) > 0) | (np.diff(read.stream) != 0)
    stream, times, x = read.stream[seen], read.times[seen], errors[seen]
    _, number, counts = np.unique(stream, return_inverse=True, return_counts=True)
    x = x - (np.bincount(number, x) / counts)[number]
    sigma = 1.4826 * float(np.median(np.abs(x))) if len(x) >= LEAST_PAIRS else 0.0
    if sigma == 0.0:
        return None
    x = np.clip(x, -BOUND * sigma, BOUND * sigma)
    variance, level = float(np.mean(x * x)), math.exp(-1.0)
    before, at, interval, lag = 1.0, 0.0, math.nan, 1
    while lag <= counts.max() // 4:
        pairs = stream[lag:] == stream[:-lag]
        if (count := int(np.count_nonzero(pairs))) < LEAST_PAIRS:
            break
        some = slice(None, None, 1 + len(pairs) // MOST_TIMES)
        later = float(np.median((times[lag:][some] - times[:-lag][some])[pairs[some]]))
        interval = later if lag == 1 else interval
        value = float(np.sum(x[lag:] * pairs * x[:-lag])) / count / variance
        if value < level:
            return sigma, interval, (at + (later - at) * (before - level) / (before - value)) * (lag > 1)
        before, at, lag = value, later, max(lag + 1, int(1.25 * lag))
    return None if math.isnan(interval) else (sigma, interval, math.inf)
