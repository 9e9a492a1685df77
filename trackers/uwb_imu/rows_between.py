"""Rows of readings to anchors, and further ones between them at the times of an IMU or of wheels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.data.recording import Columns, Readings
from trackwright.trackers.parts.range_rows import room_of_anchors
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.trajectories import Trajectories, trajectories_of


class RowsBetween(NamedTuple):
    """Rows of readings and of other times: the first of each tag, then N; `times` (N,) s; `number` (N,): of the former.

    Rows without a reading have the number after the last.
    """

    starts: np.ndarray
    times: np.ndarray
    number: np.ndarray

    def trajectories(
        self,
        folder: RecordingFolder,
        tags: Sequence[str],
        readings: Mapping[str, Readings],
        inputs: Mapping[str, np.ndarray],
        further: Mapping[str, np.ndarray],
    ) -> Trajectories:
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
