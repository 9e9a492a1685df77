"""The estimates of a chunk beside their truth, for any part of its trajectories: the arrays that are scored."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.monte_carlo.errors import TrackedRuns, joined, scored
from trackwright.trackers.core.data.estimates import Estimates, Status, is_usable
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.rows import last_of_intervals
from trackwright.trackers.recordings.columns import TruthStatus
from trackwright.trackers.recordings.tracks import angles
from trackwright.trackers.recordings.trajectories import Trajectories

ROWS_AT_ONCE = 65_536  # rows that are scored together: their numbers fit the processor's cache


class Group(NamedTuple):
    """Estimates of trajectories that one tracker ran, beside their rows. `number`, `station` (n,): of each trajectory,
    the place of its id in the chunk and of its station among the chunk's. `rows` (n, T) s: the times of the rows;
    `truth` (n, T, 3) m or (n, T, 2) rad and `known` (n, T), whether there is one, at the times for which the estimates
    are valid."""

    trajectories: Trajectories
    estimates: Estimates
    number: np.ndarray
    station: np.ndarray
    rows: np.ndarray
    truth: np.ndarray
    known: np.ndarray


class TrackedChunk:
    """The estimates of all trajectories of a chunk. `planar`: whether all positions are. `every`: the interval, s, in
    which only a trajectory's last row is scored."""

    def __init__(self, ids: np.ndarray, tracked: Sequence[tuple[Trajectories, Estimates]], planar: bool, every: Any):
        if not tracked:
            raise UnusableInput("the world has no tag to track; expected one for each id")
        stations = sorted({station for trajectories, _ in tracked for station in trajectories.stations})
        number = {str(k): at for at, k in enumerate(ids)}
        self.groups = []
        for trajectories, estimates in tracked:
            rows = trajectories.columns.padded(trajectories.columns.times)
            estimates = estimates[: len(trajectories)].rows(slice(0, rows.shape[1]))
            both = zip(trajectories.tags, trajectories.stations, strict=True)
            tag, station = np.array([(number[tag], stations.index(station)) for tag, station in both]).T
            truth = _truth(trajectories, estimates, rows)
            self.groups.append(Group(trajectories, estimates, tag, station, rows, *truth))
        self.folder, self.every = self.groups[0].trajectories.folders[0], every
        self.bearing, self.size, self.stations = bool(stations[0]), len(ids), len(stations)
        self.axes = 2 if self.bearing or planar else 3
        self.rows = max(group.rows.shape[1] for group in self.groups)

    @property
    def count(self) -> int:
        """The number of rows."""
        return sum(int((group.estimates.status != Status.PADDING).sum()) for group in self.groups)

    def scored(self) -> dict[str, np.ndarray]:
        """The arrays of `errors.scored`, of as many trajectories at a time as fit the processor's cache."""
        step = max(1, ROWS_AT_ONCE // (self.rows * self.stations))
        firsts = range(0, self.size, step)
        return joined([scored(self.runs(first, min(first + step, self.size))) for first in firsts])

    def runs(self, first: int, stop: int) -> TrackedRuns:
        """The trajectories `first` … `stop` − 1 of the chunk."""
        shape, width = (stop - first, self.rows, self.stations), 2 if self.bearing else 3
        times = np.full(shape[:2], np.nan)
        # Each component is contiguous.
        estimates, truth = (np.moveaxis(np.full((width, *shape), np.nan), 0, -1) for _ in range(2))
        covariance = np.moveaxis(np.full((self.axes, self.axes, *shape), np.nan), (0, 1), (-2, -1))
        known, status = np.zeros(shape, bool), np.full(shape, Status.PADDING, np.int8)
        nis, dof = np.zeros(shape), np.zeros(shape)
        for group in self.groups:
            which = np.flatnonzero((group.number >= first) & (group.number < stop))
            if not len(which):
                continue
            tag, station = group.number[which] - first, group.station[which]
            own, rows, truth_known = group.estimates[which], group.rows[which], group.known[which]
            at: Any = (tag, slice(0, rows.shape[1]), station)
            times[at[:2]] = own.valid_times(rows)
            status[at], nis[at], dof[at], truth[at] = own.status, own.nis, own.nis_dof, group.truth[which]
            usable, position = own.usable, _position(group.trajectories, own, which)
            for k, values in enumerate(position):
                estimates[(*at, k)] = np.where(usable, values, np.nan)
            entries = _covariance(self.bearing, own)
            for i, j in np.ndindex(len(entries), len(entries)):
                covariance[(*at, i, j)] = np.where(usable, entries[i][j], np.nan)
            comparable = truth_known & usable & np.isfinite(position[0]) & np.isfinite(position[1])
            known[at] = _scored_rows(own, rows, comparable, self.every)
        runs = TrackedRuns(times, estimates, covariance, truth, known, status, nis, dof, self.folder)
        return runs if self.bearing else runs.at_station(0)


def _position(trajectories: Trajectories, estimates: Estimates, which: Any) -> list[np.ndarray]:
    """Positions x, y, z, m, or azimuth and elevation, rad, (n, T) each."""
    if trajectories.stations[0]:
        angle = angles(estimates)
        return [angle["azimuth_rad"], angle["elevation_rad"]]
    axes = [np.asarray(x) for x in estimates.mean.position]
    height = [np.broadcast_to(trajectories.heights[which, None], estimates.status.shape)] if len(axes) < 3 else []
    return axes + height


def _covariance(bearing: bool, estimates: Estimates) -> list[list[np.ndarray]]:
    """The covariance of the estimated axes: rows of entries (n, T)."""
    if not bearing:
        return estimates.entries("position")
    angle = angles(estimates)
    squares = [angle["std_azimuth_rad"] ** 2, angle["std_elevation_rad"] ** 2]
    return [[square * float(i == j) for j in range(2)] for i, square in enumerate(squares)]


def _truth(trajectories: Trajectories, estimates: Estimates, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The truth (n, T, 3) m or (n, T, 2) rad where the estimates of `rows` (n, T) are valid, and where it is known."""
    columns = trajectories.columns
    if trajectories.stations[0]:
        values, known = columns.truth["direction"]
    else:
        times = columns.times
        if estimates.age is not None:
            times = estimates.valid_times(rows)[np.arange(rows.shape[1]) < np.diff(columns.starts)[:, None]]
        values, status = trajectories.folders[0].paths.at(trajectories.tags, columns.starts, times)
        known = status == TruthStatus.SCORED
    return columns.padded(values), columns.padded(known)


def _scored_rows(estimates: Estimates, rows: np.ndarray, known: np.ndarray, every: float | None) -> np.ndarray:
    """The rows (n, T) that are scored, of the `known` ones: the last of each time `rows` (n, T) and of `every` seconds.
    A time counts where it has an estimate: see `Estimates.status_per_time`."""
    last, usable = estimates.last_rows(rows), estimates.usable
    if not np.array_equal(last, estimates.status != Status.PADDING):
        usable = np.zeros(last.shape, bool)
        usable[last] = is_usable(estimates.status_per_time(last))
    known = known & usable
    if every is None:
        return known
    track = np.broadcast_to(np.arange(len(last))[:, None], last.shape)
    times = estimates.valid_times(rows).ravel()
    return last_of_intervals(times, known.ravel(), every, track.ravel()).reshape(last.shape)
