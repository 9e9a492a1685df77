"""Residuals that last: whether some stations or anchors are wrong for seconds, found without truth.

Student's t takes a large residual for one bad reading. Where a station is obstructed its residuals are large for as
long as the tag stays there, and covariances are too small.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import SimpleNamespace

import numpy as np
import polars as pl
from jaxtyping import Int

from trackwright.trackers.core.data.recording import Columns
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.tracks import Tracks, from_origins
from trackwright.trackers.recordings.trajectories import Trajectories

BLOCK_S = 5.0
"""Time, s, over which residuals are averaged."""

_COLUMNS = ["residual", "source", "block", "trajectory"]

LEAST_ROWS, LEAST_BLOCKS = 3, 8
"""Fewest residuals of a mean, and fewest means of a ratio."""


def residual_ratios(tracks: Tracks) -> dict[str, tuple[float, float]]:
    """Of each recording with enough readings, the size of 5 s means of residuals relative to most residuals.

    The root mean square over the means of each station or anchor, of residuals about their median, divided by the
    robust standard deviation (median absolute deviation) of all residuals. At most about 1 for normal residuals,
    however correlated. Beside it the part of the residuals' mean square that those means have beyond chance: their
    location, which no level of white noise explains. Of sensors that measure a position, the largest of their channels.
    """
    if "x_m" not in tracks.table.columns:
        return {}
    table = from_origins(tracks.table, tracks.batches)
    estimates = table.drop_nulls(["x_m", "y_m"]).partition_by("recording", "tag", as_dict=True)
    parts = []
    for number, batch in enumerate(tracks.batches):
        tracker = batch.tracker
        # Smoothers and levels of noise run a tracker that they hold.
        while hasattr(tracker, "tracker"):
            tracker = tracker.tracker
        sensors = tracker.sensors if isinstance(tracker, Tracker) else {}
        sensors = {name: sensor for name, sensor in sensors.items() if sensor.view_fields == ("position",)}
        trajectories, axes = Trajectories.of(batch.trajectories), ("x_m", "y_m", "z_m")[: 2 if batch.planar else 3]
        keys = [(folder.name, tag) for folder, tag in zip(trajectories.folders, trajectories.tags, strict=True)]
        known = [k for k, key in enumerate(keys) if key in estimates] if sensors else []
        if not known:
            continue
        columns, places = trajectories.columns.chosen(np.array(known)), []
        for k, times in zip(known, np.split(columns.times, columns.starts[1:-1]), strict=True):
            own = estimates[keys[k]]
            places.append([np.interp(times, own["t_s"].to_numpy(), own[axis].to_numpy()) for axis in axes])
        names = pl.Series([keys[k][0] for k in known])
        for channel, rows in residuals_of(sensors, columns, Vector(*np.concatenate(places, axis=1))):
            recording = names.gather(rows["trajectory"])
            parts.append(rows.with_columns(recording=recording, channel=pl.lit(channel), batch=pl.lit(number)))
    return _ratios(pl.concat(parts)) if parts else {}


def _ratios(residuals: pl.DataFrame) -> dict[str, tuple[float, float]]:
    """The ratio and the part of each recording, the largest of its channels with enough means."""
    of, about, square = ["recording", "channel"], pl.col("about"), pl.col("residual") ** 2
    rows = residuals.with_columns(about=pl.col("residual") - pl.col("residual").median().over(of))
    channels = rows.group_by(of, maintain_order=True).agg(
        scatter=1.4826 * about.abs().median(), square=square.mean(), n=pl.len()
    )
    # In a fixed order, so that their sums have the same bits.
    blocks = rows.group_by(*of, "source", "block", "batch", "trajectory", maintain_order=True).agg(
        about=about.mean(), within=about.var(ddof=0) * pl.len(), rows=pl.len()
    )
    long = about.filter(pl.col("rows") >= LEAST_ROWS)
    means = blocks.group_by(of, maintain_order=True).agg(
        size=(long**2).mean().sqrt(), means=long.len(), within=pl.col("within").sum(), blocks=pl.len()
    )
    # Analysis of variance: the scatter within blocks against the mean square.
    within = pl.col("within") / (pl.col("n") - pl.col("blocks")).cast(pl.Int64).clip(lower_bound=1)
    found = channels.join(means, of).filter(pl.col("means") >= LEAST_BLOCKS, pl.col("scatter") > 0)
    found = found.group_by("recording", maintain_order=True).agg(
        (pl.col("size") / pl.col("scatter")).max(), (1 - within / pl.col("square")).max().clip(lower_bound=0)
    )
    return {name: (ratio, part) for name, ratio, part in found.iter_rows()}


def residuals_of(
    sensors: Mapping[str, AbstractSensor], columns: Columns, position: Vector
) -> Iterator[tuple[str, pl.DataFrame]]:
    """The residuals of each channel about the positions (N,), with their source, block of time and trajectory."""
    inputs = {key: np.moveaxis(x, 0, -1) for key, x in columns.inputs.items()}
    block = (columns.times - columns.of_each(columns.times[columns.starts[:-1]])) // BLOCK_S
    number = columns.of_each(np.arange(len(columns)))
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
                values = sign * residual.astype(float), source, block, number
                yield f"{name}.{channel.name}", pl.DataFrame([x[seen] for x in values], _COLUMNS)


def _sources(given: Mapping[str, np.ndarray], k: int, rows: int) -> list[tuple[int, Int[np.ndarray, " N"]]]:
    """The stations or anchors of the readings of channel `k`, and the sign with which residuals count for each.

    A difference counts for both its anchors.
    """
    if "pair" in given:
        first, second = given["pair"][2 * k : 2 * k + 2].astype(int)
        return [(1, first), (-1, second)]
    numbers = next((given[name] for name in ("station", "anchor") if name in given), np.zeros(rows))
    return [(1, (numbers[k] if numbers.ndim > 1 else numbers).astype(int))]
