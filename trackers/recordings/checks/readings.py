"""The readings of a table by stream, and their differences from the true values and from a local line."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.recordings.columns import stable_order
from trackwright.trackers.recordings.kinds import KINDS, wrapped

if TYPE_CHECKING:  # the folder's module imports `anomalies`
    from trackwright.trackers.recordings.folder import RecordingFolder

MOST_ROWS = 100_000
"""Readings of a table that are looked at."""

LINE_S = 2.0
"""Time, s, over which a line is put through readings."""

LEAST_ROWS = 5
"""Least number of readings of a line."""


class Readings(NamedTuple):
    """The rows of a table, those of a stream (one tag and one anchor or station) one after another, by time.

    `stream` (N,): its number. `times` (N,) s. `values` (N, m): of the `columns`, NaN where one is missing. `errors`
    (N, m): their differences from the true values, NaN where these are unknown.
    """

    columns: tuple[str, ...]
    stream: Int[np.ndarray, " N"]
    times: Float[np.ndarray, " N"]
    values: Float[np.ndarray, "N m"]
    errors: Float[np.ndarray, "N m"]


def readings(recording: RecordingFolder, name: str) -> Readings:
    """The readings of a table with measurements; of more than `MOST_ROWS`, equally many first ones of each stream."""
    rows, kind = recording.rows(name), KINDS[name]
    columns = kind.layout(recording.tables[name].columns).values
    ids = tuple(kind.places(recording.rig))
    sensor = kind.numbers(rows, ids)
    stream = rows.of_each(np.arange(len(rows.tags)))
    for number in sensor.T:
        stream = stream * len(ids) + number
    order = stable_order(stream)
    if len(order) > MOST_ROWS:
        counts = np.bincount(stream)
        within = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        order = order[within < MOST_ROWS // np.count_nonzero(counts)]
    stream, times = stream[order], rows.times[order]
    values = rows.floats(columns)[order]
    errors = np.full(values.shape, np.nan)
    if len(recording.paths.times) and kind.averaged and kind.predicted is not None:
        # The order is one of tags too.
        tag = np.searchsorted(rows.starts, order, side="right") - 1
        starts = np.searchsorted(tag, np.arange(len(rows.tags) + 1))
        positions, _ = recording.paths.at(rows.tags, starts, times)
        sensors = kind.sensors_of(recording.rig, ids, sensor[order], len(columns))
        errors = wrapped(values - kind.predicted(positions, sensors), columns)
    return Readings(columns, stream, times, values, errors)


def about_local_line(read: Readings) -> Float[np.ndarray, "N m"]:
    """The differences (N, m) of readings from a line through those around them; NaN where there are too few."""
    found = np.full(read.values.shape, np.nan)
    for k, column in enumerate(read.columns):
        seen = np.flatnonzero(np.isfinite(read.values[:, k]))
        if not len(seen):
            continue
        x, stream, t = read.values[seen, k], read.stream[seen], read.times[seen] - read.times.mean()
        x = np.unwrap(x) if column.endswith("_rad") else x - np.mean(x)
        # Streams one after another on one axis of time, too far apart to share a line.
        at = t + (np.ptp(t) + 2 * LINE_S) * stream
        first = np.searchsorted(at, at - LINE_S / 2, side="left")
        end = np.searchsorted(at, at + LINE_S / 2, side="right")
        count = end - first
        mean_t, mean_x, square, product = (_sums(y, first, end) / count for y in (t, x, t * t, t * x))
        variance = square - mean_t**2
        slope = (product - mean_t * mean_x) / np.where(variance > 0, variance, 1.0)
        line = mean_x + slope * (t - mean_t)
        found[seen, k] = np.where((count >= LEAST_ROWS) & (variance > 0), x - line, np.nan)
    return found


def _sums(x: np.ndarray, first: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The sums of x[first:end]."""
    sums = np.concatenate([[0.0], np.cumsum(x)])
    found: np.ndarray = sums[end] - sums[first]
    return found


def known_median(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The median (m,) of each column without its missing values, NaN without any value."""
    return np.array([np.median(c[~np.isnan(c)]) if not np.isnan(c).all() else np.nan for c in x.T])


def robust_std(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The standard deviation (m,) of each column from its median size, blind to outliers; 0 without any value."""
    return np.array(
        [1.4826 * float(np.median(np.abs(c[np.isfinite(c)]))) if np.isfinite(c).any() else 0.0 for c in x.T]
    )
