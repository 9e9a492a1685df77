"""A tracker's estimates beside their truth, as sums and histograms of each trajectory; metrics are as in `evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.monte_carlo.scores import Scores, arrays_of, cells, sums
from trackwright.trackers.core.data.estimates import Estimates, Status, is_usable
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.columns import TruthStatus
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Trajectories, angles


class TrackedRuns(NamedTuple):
    """A tracker's estimates of n trajectories of T rows beside their truth: the argument of a study's measures.
    Positions: `times` (n, T) s, `estimates` and `truth` (n, T, 3) m, `covariance` (n, T, d, d) of the d estimated axes;
    NaN without an estimate, and a known height filled in. Bearings have an axis of S stations: `estimates` and `truth`
    (n, T, S, 2) rad, azimuth and elevation, `covariance` (n, T, S, 2, 2). `known`: rows with both truth and a usable
    estimate. `status` (codes of `Status`), `nis`, `dof`: per row, and per station for bearings."""

    times: np.ndarray
    estimates: np.ndarray
    covariance: np.ndarray
    truth: np.ndarray
    known: np.ndarray
    status: np.ndarray
    nis: np.ndarray
    dof: np.ndarray
    folder: RecordingFolder

    @property
    def error(self) -> np.ndarray:
        """Estimates less truth, m or rad; NaN for rows that are not scored."""
        return np.where(self.known[..., None], self.estimates - self.truth, np.nan)


def scored(tracked: TrackedRuns) -> dict[str, np.ndarray]:
    """The sums, largest errors and histograms of n trajectories; rows of all stations count as their trajectory's."""
    n, d = len(tracked.estimates), tracked.covariance.shape[-1]
    entries = {(i, j): tracked.covariance[..., i, j] for i in range(d) for j in range(i, d)}
    steps = tracked.status, tracked.nis, tracked.dof

    def total(x: np.ndarray) -> np.ndarray:
        return x.reshape(n, -1).sum(axis=1, dtype=float)

    found, sizes = sums(tracked.estimates, tracked.truth, entries, tracked.known, steps, total)
    rows = {kind: size.reshape(n, -1) for kind, size in sizes.items()}
    tops = {kind: size.max(axis=1) for kind, size in rows.items()}
    of_rows = {kind: cells(size, np.arange(n)[:, None], n) for kind, size in rows.items()}
    return arrays_of([Scores(found, tops, of_rows)], n)


def tracked_runs(
    ids: np.ndarray, tracked: Sequence[tuple[Trajectories, Estimates]], planar: bool, every: float | None
) -> TrackedRuns:
    """The estimates of all trajectories of a chunk beside their truth. `planar`: whether all positions are. `every`: an
    interval, s, in which only a trajectory's last row is scored."""
    if not tracked:
        raise UnusableInput("the world has no tag to track; expected one for each id")
    stations = sorted({station for trajectories, _ in tracked for station in trajectories.stations})
    number, bearing = {str(k): at for at, k in enumerate(ids)}, bool(stations[0])
    times_of = [trajectories.columns.padded(trajectories.columns.times) for trajectories, _ in tracked]
    shape, width = (len(ids), max(rows.shape[1] for rows in times_of), len(stations)), 2 if bearing else 3
    times, axes = np.full(shape[:2], np.nan), 2 if bearing or planar else 3
    # Each component is contiguous.
    estimates, truth = (np.moveaxis(np.full((width, *shape), np.nan), 0, -1) for _ in range(2))
    covariance = np.moveaxis(np.full((axes, axes, *shape), np.nan), (0, 1), (-2, -1))
    known, status = np.zeros(shape, bool), np.full(shape, Status.PADDING, np.int8)
    nis, dof = np.zeros(shape), np.zeros(shape)
    for (trajectories, every_row), rows in zip(tracked, times_of, strict=True):
        own = every_row[: len(trajectories)].rows(slice(0, rows.shape[1]))
        both = zip(trajectories.tags, trajectories.stations, strict=True)
        tag, station = np.array([(number[tag], stations.index(station)) for tag, station in both]).T
        at: Any = (tag, slice(0, rows.shape[1]), station)
        times[at[:2]] = own.valid_times(rows)
        truth[at], truth_known = _truth(trajectories, own, rows)
        status[at], nis[at], dof[at] = own.status, own.nis, own.nis_dof
        usable, position = own.usable, _position(trajectories, own)
        for k, values in enumerate(position):
            estimates[(*at, k)] = np.where(usable, values, np.nan)
        entries = _covariance(bearing, own)
        for i, j in np.ndindex(len(entries), len(entries)):
            covariance[(*at, i, j)] = np.where(usable, entries[i][j], np.nan)
        comparable = truth_known & usable & np.isfinite(position[0]) & np.isfinite(position[1])
        known[at] = _scored_rows(own, rows, comparable, every)
    of_station = [estimates, covariance, truth, known, status, nis, dof]
    folder = tracked[0][0].folders[0]
    return TrackedRuns._make([times, *(x if bearing else x[:, :, 0] for x in of_station), folder])


def _position(trajectories: Trajectories, estimates: Estimates) -> list[np.ndarray]:
    """Positions x, y, z, m, or azimuth and elevation, rad, (n, T) each."""
    if trajectories.stations[0]:
        angle = angles(estimates)
        return [angle["azimuth_rad"], angle["elevation_rad"]]
    axes = [np.asarray(x) for x in estimates.mean.position]
    height = [np.broadcast_to(trajectories.heights[:, None], estimates.status.shape)] if len(axes) < 3 else []
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
    # 0.3 s belongs to the interval that starts there although 0.3 / 0.1 is 2.9999999999999996.
    interval = np.where(known, np.floor(estimates.valid_times(rows) / every + 1e-6), -np.inf)
    later = np.minimum.accumulate(np.where(known, interval, np.inf)[:, ::-1], axis=1)[:, ::-1]
    return known & np.append(later[:, 1:] > interval[:, :-1], np.ones((len(known), 1), bool), axis=1)
