"""Residuals that last: whether some stations or anchors are wrong for seconds, found without truth.

Student's t takes a large residual for one bad reading. Where a station is obstructed its residuals are large for as
long as the tag stays there, and covariances are too small.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.recording import Columns
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.columns import run_starts
from trackwright.trackers.recordings.tracks import Tracks, from_origins
from trackwright.trackers.recordings.trajectories import Trajectories

BLOCK_S = 5.0
"""Time, s, over which residuals are averaged."""

LEAST_ROWS, LEAST_BLOCKS = 3, 8
"""Fewest residuals of a mean, and fewest means of a ratio."""

MOST_ROWS = 100_000
"""Residuals of a recording that are looked at, whole trajectories."""


def residual_ratios(tracks: Tracks) -> dict[str, tuple[float, float]]:
    """Of each recording with enough readings, the size of 5 s means of residuals relative to that of most residuals.

    The root mean square over the means of each station or anchor, of residuals about their median, divided by the
    robust standard deviation (median absolute deviation) of all residuals. At most about 1 for normal residuals,
    however correlated. Beside it the part of the residuals' mean square that those means have beyond chance: their
    location, which no level of white noise explains. Of sensors that measure a position, the largest of their channels.
    """
    if "x_m" not in tracks.table.columns:
        return {}
    table = from_origins(tracks.table, tracks.batches)
    estimates = table.select("recording", "tag", "t_s", "x_m", "y_m", "z_m").drop_nulls(["x_m", "y_m"])
    starts = run_starts(estimates, ["recording", "tag"])
    keys = estimates.select("recording", "tag")[starts[:-1]].rows()
    estimated = dict(zip(keys, map(slice, starts[:-1], starts[1:]), strict=True))
    residuals: dict[str, dict[str, list[np.ndarray]]] = defaultdict(lambda: defaultdict(list))
    rows: Counter[str] = Counter()
    for batch in tracks.batches:
        tracker = batch.tracker
        # Smoothers and levels of noise run a tracker that they hold.
        while hasattr(tracker, "tracker"):
            tracker = tracker.tracker
        sensors = tracker.sensors if isinstance(tracker, Tracker) else {}
        sensors = {name: sensor for name, sensor in sensors.items() if sensor.view_fields == ("position",)}
        trajectories = Trajectories.of(batch.trajectories)
        keys = [(folder.name, tag) for folder, tag in zip(trajectories.folders, trajectories.tags, strict=True)]
        chosen, before = [], []
        for k, length in enumerate(np.diff(trajectories.columns.starts).tolist()):
            recording = keys[k][0]
            if sensors and keys[k] in estimated and rows[recording] <= MOST_ROWS:
                chosen.append(k)
                # The rows so far tell trajectories apart.
                before.append(rows[recording])
                rows[recording] += length
        if not chosen:
            continue
        columns, names = trajectories.columns.chosen(np.array(chosen)), [keys[k][0] for k in chosen]
        parts, axes = [estimated[keys[k]] for k in chosen], "xy" if batch.planar else "xyz"
        first = [k for k, name in enumerate(names) if k == 0 or name != names[k - 1]]
        position = _interpolated(estimates, parts, columns, axes)
        for channel, values, seen in residuals_of(sensors, columns, position, np.array(before)):
            for a, b in pairwise([*first, len(names)]):
                part = slice(*columns.starts[[a, b]])
                residuals[names[a]][channel].append(values[part][seen[part]])
    ratios = {
        name: [r for values in channels.values() if (r := _ratio(np.concatenate(values))) is not None]
        for name, channels in residuals.items()
    }
    return {name: (max(r for r, _ in each), max(part for _, part in each)) for name, each in ratios.items() if each}


def _interpolated(estimates: pl.DataFrame, parts: Sequence[slice], columns: Columns, axes: str) -> Vector:
    """The positions at the times of all rows (N,) of trajectories, whose estimates are these parts of the table."""
    at, *known = (estimates[name].to_numpy() for name in ("t_s", *(f"{axis}_m" for axis in axes)))
    position = np.empty((len(axes), len(columns.times)))
    for part, (a, b) in zip(parts, pairwise(columns.starts.tolist()), strict=True):
        for values, x in zip(position, known, strict=True):
            values[a:b] = np.interp(columns.times[a:b], at[part], x[part])
    return Vector(*position)


def residuals_of(
    sensors: Mapping[str, AbstractSensor],
    columns: Columns,
    position: Vector,
    before: Int[np.ndarray, " n"] | None = None,
) -> Iterator[tuple[str, Float[np.ndarray, "N 4"], Bool[np.ndarray, " N"]]]:
    """Residuals of each channel about the positions, with the numbers of their source, block and trajectory (`before`).

    And the mask of the rows that have one.
    """
    inputs = {key: np.moveaxis(x, 0, -1) for key, x in columns.inputs.items()}
    block = (columns.times - columns.of_each(columns.times[columns.starts[:-1]])) // BLOCK_S
    of = np.arange(len(columns.starts) - 1) if before is None else before
    for name, sensor in sensors.items():
        reading, predicted = columns.readings[name], sensor.measure(SimpleNamespace(position=position), inputs)
        given = {x.name: inputs[x.name] for x in sensor.inputs if x.name in inputs}
        for k, channel in enumerate(sensor.channels):
            residual = reading.values[:, k] - np.asarray(predicted[k])
            residual = np.asarray(wrap(residual)) if channel.wraps else residual
            seen = reading.seen[:, k] & np.isfinite(residual)
            if "levers" in given:
                # Where a lever arm points is not known from the position.
                seen = seen & (given["levers"][3 * k : 3 * k + 3] == 0.0).all(axis=0)
            for sign, source in _sources(given, k, len(block)):
                values = np.stack([sign * residual, source, block, columns.of_each(of)], axis=1)
                yield f"{name}.{channel.name}", values, seen


def _sources(given: Mapping[str, np.ndarray], k: int, rows: int) -> list[tuple[int, Int[np.ndarray, " N"]]]:
    """The stations or anchors of the readings of channel `k`, and the sign with which residuals count for each.

    A difference counts for both its anchors.
    """
    if "pair" in given:
        first, second = given["pair"][2 * k : 2 * k + 2].astype(int)
        return [(1, first), (-1, second)]
    numbers = next((given[name] for name in ("station", "anchor") if name in given), np.zeros(rows))
    return [(1, (numbers[k] if numbers.ndim > 1 else numbers).astype(int))]


def _ratio(residuals: Float[np.ndarray, "n 4"]) -> tuple[float, float] | None:
    """The ratio and the part of one channel; None of too few blocks."""
    if not len(residuals):
        return None
    about = residuals[:, 0] - np.median(residuals[:, 0])
    # One number for each block, in the order of source, block and trajectory.
    source, block, trajectory = residuals[:, 1:].T.astype(int)
    number = (source * (block.max() + 1) + block) * (trajectory.max() + 1) + trajectory
    _, block, count = np.unique(number, return_inverse=True, return_counts=True)
    means = (np.bincount(block, about) / count)[count >= LEAST_ROWS]
    scatter = 1.4826 * float(np.median(np.abs(about)))
    if len(means) < LEAST_BLOCKS or scatter == 0.0:
        return None
    # Analysis of variance: the scatter within blocks against the mean square.
    within = about - (np.bincount(block, about) / count)[block]
    part = 1 - np.sum(within**2) / max(len(about) - len(count), 1) / np.mean(residuals[:, 0] ** 2)
    return float(np.sqrt(np.mean(means**2)) / scatter), max(float(part), 0.0)
