"""Rows of readings to anchors, and further ones between them at the times of an IMU or of wheels.

IMU samples become inputs of rows on the host: sample and hold, detection of rest, rotation to level axes, tilts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Columns, Readings
from trackwright.trackers.parts.ranges import room_of_anchors
from trackwright.trackers.recordings.columns import QUATERNION, TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.trackers.recordings.tracks import Trajectories, known_height, trajectories_of


class RowsBetween(NamedTuple):
    """Rows of readings and of other times: the first of each tag, then N; `times` (N,) s; `number` (N,): of the former.

    Rows without a reading have the number after the last.
    """

    starts: np.ndarray
    times: np.ndarray
    number: np.ndarray

    def trajectories(
        self, folder: RecordingFolder, tags: Sequence[str], readings: Mapping[str, Readings],
        inputs: Mapping[str, np.ndarray], further: Mapping[str, np.ndarray],
    ) -> Trajectories:  # fmt: skip
        """The trajectories with `readings` and `inputs` of their rows, zeros between them, and `further` inputs."""
        given = {name: _with_zeros(values)[self.number] for name, values in inputs.items()}
        given |= {**further, **room_of_anchors(folder, len(self.times))}
        between = {
            name: Readings(*(_with_zeros(x)[self.number] for x in (r.values, r.seen, r.reported) if x is not None))
            for name, r in readings.items()
        }
        return trajectories_of(folder, tags, self.starts, self.times, between, given)


def with_rows_between(tags: Sequence[str], rows: TagRows | Columns, sampled: Mapping[str, np.ndarray]) -> RowsBetween:
    """Of `tags` the rows of the tags in `sampled`, and further ones at its times, s, where a tag has none."""
    measured, times, index = {tag: np.arange(*rows.starts[k : k + 2]) for k, tag in enumerate(tags)}, [], []
    for tag, samples in sampled.items():
        between = samples[~np.isin(samples, rows.times[measured[tag]])]
        both = np.concatenate([rows.times[measured[tag]], between])
        order = np.argsort(both, kind="stable")
        times.append(both[order])
        index.append(np.concatenate([measured[tag], np.full(len(between), len(rows.times))])[order])
    starts = np.cumsum([0, *map(len, times)])
    return RowsBetween(starts, np.concatenate(times), np.concatenate(index))


def _with_zeros(values: np.ndarray) -> np.ndarray:
    """The rows followed by a row of zeros."""
    return np.concatenate([values, np.zeros((1, *values.shape[1:]), values.dtype)])


HOLD_S = 0.2  # longest time for which a sample is held, s; after it the row has no IMU

REST_WINDOW_S = 1.0  # window of the test for rest, s
# Largest standard deviations at rest, m/s² and rad/s: several times the noise of a MEMS IMU, below hand motion.
REST_ACCEL_STD, REST_GYRO_STD = 0.15, 0.02
# Typical tilt within a second, rad, that doubles the errors of `uwb-imu` at a known height.
TILTING = np.radians(3.0)


def imu_inputs(times: np.ndarray, imu_times: np.ndarray, accel: np.ndarray, gyro: np.ndarray) -> dict[str, np.ndarray]:
    """The inputs `accel` (T, 3) m/s², `gyro` (T, 3) rad/s, `imu` (T, 2) and `rest` (T, 7) of rows at `times` (T,) s.

    Each row has the latest sample not after it. `accel`, `gyro` (n, 3): samples at `imu_times` (n,) s, sorted; NaN if
    missing. `imu`: whether accelerometer and gyro are available. `rest`: the mean of both over the last
    `REST_WINDOW_S`, or over the first window of the IMU, and 1 if the body was at rest; zeros without samples.
    """
    inputs = {"imu": np.zeros((len(times), 2))}
    for k, (name, values) in enumerate((("accel", accel), ("gyro", gyro))):
        known = np.isfinite(values).all(axis=1)
        sampled, samples = imu_times[known], values[known]
        last = np.searchsorted(sampled, times, side="right") - 1
        fresh = last >= 0
        fresh[fresh] = times[fresh] - sampled[last[fresh]] <= HOLD_S
        inputs["imu"][:, k] = fresh
        inputs[name] = np.where(fresh[:, None], samples[np.maximum(last, 0)] if len(sampled) else np.zeros((1, 3)), 0.0)
    measured = np.isfinite(accel).all(axis=1)
    sampled, pairs = imu_times[measured], np.concatenate([accel, np.nan_to_num(gyro)], axis=1)[measured]
    inputs["rest"] = _rests(times, sampled, pairs) if len(sampled) else np.zeros((len(times), 7))
    return inputs


def _rests(times: np.ndarray, sampled: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """The input `rest` of `imu_inputs`, by cumulative sums."""
    stop = np.searchsorted(sampled, np.maximum(times, sampled[0] + REST_WINDOW_S), side="right")
    start = np.minimum(np.searchsorted(sampled, sampled[stop - 1] - REST_WINDOW_S), stop - 1)
    # Deviations from the total mean: the squares of gravity would swamp the noise.
    centre = samples.mean(axis=0)
    sums, squares = (np.concatenate([np.zeros((1, 6)), np.cumsum((samples - centre) ** p, axis=0)]) for p in (1, 2))
    count = (stop - start)[:, None]
    mean = (sums[stop] - sums[start]) / count
    std = np.sqrt(np.maximum((squares[stop] - squares[start]) / count - mean**2, 0.0))
    quiet = (std[:, :3] < REST_ACCEL_STD).all(axis=1) & (std[:, 3:] < REST_GYRO_STD).all(axis=1)
    at_rest = quiet & (sampled[stop - 1] - sampled[start] > 0.5 * REST_WINDOW_S)
    recent = times - sampled[stop - 1] <= REST_WINDOW_S
    return np.where(recent[:, None], np.concatenate([mean + centre, at_rest[:, None]], axis=1), 0.0)


def to_level_axes(accel: np.ndarray, attitude: np.ndarray, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """Samples of an IMU that reports its attitude and gravity-free acceleration, rotated to its level axes.

    `accel` (n, 3) m/s² in body axes, without gravity; `attitude` (n, 4): quaternion from body to level axes. Returns
    the specific force in level axes and a turning rate of zero; the drift of these axes about the vertical is left to
    the filter's gyro noise and bias. NaN stays NaN.
    """
    w, q = np.split(attitude / np.linalg.norm(attitude, axis=1, keepdims=True), [1], axis=1)
    twice = 2.0 * np.cross(q, accel)
    force = accel + w * twice + np.cross(q, twice)
    force[:, 2] += gravity
    return force, np.where(np.isfinite(force), 0.0, np.nan)


def tilting_tags(
    folder: RecordingFolder, free_height: bool, read: str = "ranges", without: str = "uwb"
) -> Iterator[str]:
    """A line for each tag that tilts by its turn rates, while its known height has the tracker take it for level.

    `read`: the table of the tags' other readings. `without`: the tracker of these alone, which names that with an IMU.
    """
    table = folder.tables["imu"]
    columns, dt = KINDS["imu"].layout(table.columns).values, pl.col("t_s").diff().clip(0.0, HOLD_S).fill_null(0.0)
    for tag in () if QUATERNION[0] in table.columns else folder.rows(read).tags:
        if free_height or known_height(folder, tag) is None:
            continue
        rows = table.filter(pl.col("tag") == tag).select("t_s", *columns).drop_nulls().sort("t_s")
        seconds = rows.group_by(pl.col("t_s").floor()).agg((pl.col(columns[3:]) * dt).sum())
        # A mounting that leans turns about the mean specific force.
        up = rows.select(columns[:3]).mean().fill_null(0.0).to_numpy()[0]
        turns = np.cross(seconds.select(columns[3:]).to_numpy(), up / max(float(np.linalg.norm(up)), 1e-9))
        tilt = float(np.sqrt(np.sum(np.var(turns, axis=0)))) if len(turns) else 0.0
        if tilt > TILTING:
            tilts = f"{folder.name}: imu: tag {tag} typically tilts by {np.degrees(tilt):.0f}° in a second"
            do = f"use {without}, or leave out height_m (--free-height)"
            yield f"{tilts}, but {without}-imu takes a tag with height_m for level: {do}"
