"""Residuals that last: whether some stations or anchors are wrong for seconds, found without truth.

Student's t takes a large residual for one bad reading. Where a station is obstructed its residuals are large for as
long as the tag stays there, and covariances are too small.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import polars as pl
from jaxtyping import Float, Int

from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.tracks import Tracks, from_origins
from trackwright.trackers.recordings.trajectories import Trajectory

BLOCK_S = 5.0
"""Time, s, over which residuals are averaged."""

LEAST_ROWS, LEAST_BLOCKS = 3, 8
"""Fewest residuals of a mean, and fewest means of a ratio."""

MOST_ROWS = 100_000
"""Residuals of a recording that are looked at, whole trajectories."""


def residual_ratios(tracks: Tracks) -> dict[str, float]:
    """Of each recording with enough readings, the size of 5 s means of residuals relative to that of most residuals.

    The root mean square over the means of each station or anchor, of residuals about their median, divided by the
    robust standard deviation (median absolute deviation) of all residuals. At most about 1 for normal residuals,
    however correlated. Of sensors that measure a position, the largest of their channels.
    """
    residuals: dict[str, dict[str, list[np.ndarray]]] = {}
    rows: dict[str, int] = {}
    if "x_m" not in tracks.table.columns:
        return {}
    table = from_origins(tracks.table, tracks.batches)
    estimates = table.select("recording", "tag", "t_s", "x_m", "y_m", "z_m").drop_nulls(["x_m", "y_m"])
    of_tags = estimates.partition_by(["recording", "tag"], as_dict=True)
    for batch in tracks.batches:
        tracker = batch.tracker.tracker if isinstance(batch.tracker, Smoothed) else batch.tracker
        sensors = tracker.sensors if isinstance(tracker, Tracker) else {}
        for trajectory in batch.trajectories:
            of_tag = of_tags.get((trajectory.folder.name, trajectory.tag))
            if of_tag is None or rows.get(trajectory.folder.name, 0) > MOST_ROWS:
                continue
            channels, number = residuals.setdefault(trajectory.folder.name, {}), rows.get(trajectory.folder.name, 0)
            for name, sensor in sensors.items():
                if sensor.view_fields == ("position",):
                    for channel, values in _residuals(name, sensor, trajectory, of_tag, batch.planar):
                        # The rows so far tell trajectories apart.
                        values = np.column_stack([values, np.full(len(values), number)])
                        channels.setdefault(channel, []).append(values)
            rows[trajectory.folder.name] = number + len(trajectory.recording)
    ratios = {
        name: [r for parts in channels.values() if (r := _ratio(np.concatenate(parts))) is not None]
        for name, channels in residuals.items()
    }
    return {name: max(each) for name, each in ratios.items() if each}


def _residuals(
    name: str, sensor: AbstractSensor, trajectory: Trajectory, estimates: pl.DataFrame, planar: bool
) -> Iterator[tuple[str, Float[np.ndarray, "n 3"]]]:
    """Residuals of each channel about the estimated positions, with the numbers of their source and block."""
    recording = trajectory.recording
    at = estimates["t_s"].to_numpy()
    axes = "xy" if planar else "xyz"
    position = Vector.of(np.interp(recording.times, at, estimates[f"{axis}_m"].to_numpy()) for axis in axes)
    inputs = {key: np.moveaxis(x, 0, -1) for key, x in recording.inputs.items()}
    reading = recording.readings[name]
    predicted = sensor.measure(SimpleNamespace(position=position), inputs)
    for k, channel in enumerate(sensor.channels):
        source: Int[np.ndarray, " T"] = np.zeros(len(recording), int)
        if "station" in inputs or "anchor" in inputs:
            source = np.ravel(inputs["station"] if "station" in inputs else inputs["anchor"][k]).astype(int)
        block = (recording.times - recording.times[0]) // BLOCK_S
        residual = reading.values[:, k] - np.asarray(predicted[k])
        residual = np.asarray(wrap(residual)) if channel.wraps else residual
        seen = reading.seen[:, k] & np.isfinite(residual)
        yield f"{name}.{channel.name}", np.stack([residual, source, block], axis=1)[seen]


def _ratio(residuals: Float[np.ndarray, "n 4"]) -> float | None:
    """The ratio of one channel; None of too few blocks."""
    if not len(residuals):
        return None
    about = residuals[:, 0] - np.median(residuals[:, 0])
    _, block, count = np.unique(residuals[:, 1:], axis=0, return_inverse=True, return_counts=True)
    means = (np.bincount(block.ravel(), about) / count)[count >= LEAST_ROWS]
    scatter = 1.4826 * float(np.median(np.abs(about)))
    if len(means) < LEAST_BLOCKS or scatter == 0.0:
        return None
    return float(np.sqrt(np.mean(means**2)) / scatter)
