"""What every estimator is given: the readings of a tag, row by row as our trackers read them, and a common start.

No estimator sees the truth, the known path or a calibration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from trackwright.experiments.lab.benchmark.readings import CHANNELS, predicted
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.trajectories import Trajectory

START_S = (1.0, 3.0, 10.0, np.inf)
"""Seconds of readings from which a start is computed: the first span with more readings than the place has numbers."""

LEAST = 6
"""Least number of readings of a start."""

EPOCH_S = 5e-3
"""Readings that are no farther apart in time are of one state, where an estimator has a state for every time."""

POSITION_STD, VELOCITY_STD = 1.0, 1.0
"""Standard deviations of a start, m and m/s; its velocity is zero."""


class NotRead(Exception):  # noqa: N818 - no fault: there is no estimate to compare
    """A recording has not the readings that an estimator takes."""


@dataclass(frozen=True)
class Problem:
    """The N readings of one tag in the order of time.

    `kind`: of readings, as `ranges`. `times` (N,) s; `values` (N, m), `seen` (N, m); `geometry` (N, g): as of
    `readings.WIDTHS`. `height`: m, of a tag whose height is known; None where it is estimated.
    """

    folder: RecordingFolder
    tag: str
    kind: str
    times: np.ndarray
    values: np.ndarray
    seen: np.ndarray
    geometry: np.ndarray
    height: float | None

    @property
    def dimensions(self) -> int:
        """Coordinates that are estimated: 2 at a known height."""
        return 3 if self.height is None else 2

    def places(self, positions: np.ndarray) -> np.ndarray:
        """Positions (…, d) as places (…, 3), m, at the known height if there is one."""
        if self.height is None:
            return positions
        return np.concatenate([positions, np.full((*positions.shape[:-1], 1), self.height)], axis=-1)

    @cached_property
    def epochs(self) -> tuple[np.ndarray, np.ndarray]:
        """The times (T,) of states, s, and the state (N,) of each reading."""
        new = np.zeros(len(self.times), bool)
        last = -np.inf
        for row, time in enumerate(self.times):
            if time > last + EPOCH_S:
                new[row], last = True, time
        return self.times[new], np.cumsum(new) - 1

    @cached_property
    def start(self) -> np.ndarray:
        """The start (d,), m, of all estimators: robust least squares over the first readings, from the middle below
        anchors and stations.
        """
        spans = (np.flatnonzero(self.times <= self.times[0] + span) for span in START_S)
        rows = next(rows for rows in spans if len(rows) >= LEAST or len(rows) == len(self.times))
        z, seen, geometry = self.values[rows], self.seen[rows], self.geometry[rows]
        if self.kind == "fixes":
            return np.array([np.median(z[seen[:, k], k]) for k in range(self.dimensions)])
        middle = np.mean(geometry[:, :3], axis=0) - [0.0, 0.0, 1.0]

        def residuals(position: np.ndarray) -> np.ndarray:
            return (z - predicted(self.kind, self.places(position), geometry, z))[seen]

        return np.asarray(least_squares(residuals, middle[: self.dimensions], loss="soft_l1", f_scale=0.3).x)


def steps(problem: Problem) -> np.ndarray:
    """Seconds (N,) from the reading before each; 0 before the first."""
    return np.diff(problem.times, prepend=problem.times[0])


def beginning(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """State (2d,) and covariance (2d, 2d) before the first reading."""
    d = problem.dimensions
    variances = np.repeat([POSITION_STD**2, VELOCITY_STD**2], d)
    return np.concatenate([problem.start, np.zeros(d)]), np.diag(variances)


def tracker_of(folder: RecordingFolder) -> NamedTracker:
    """The tracker that a user gets for a recording whose path is not known, since other estimators do not use one."""
    pathless = without_path(folder)
    return build(fitting(pathless), pathless)


def without_path(folder: RecordingFolder) -> RecordingFolder:
    """The recording without a known path."""
    return replace(folder, rig=replace(folder.rig, path_knots=None))


def problems(folder: RecordingFolder) -> list[Problem]:
    """The readings of every tag as our default tracker has them, averaged and without repeated values where it does so.

    None of a recording with other readings, as phases.
    """
    batches = tracker_of(folder).batches(without_path(folder))
    return [
        problem
        for batch in batches
        for trajectory in batch.trajectories
        for problem in _problems(folder, trajectory, batch.planar)
    ]


def _problems(folder: RecordingFolder, trajectory: Trajectory, planar: bool) -> Iterator[Problem]:
    recording = trajectory.recording
    kind = next((name for name in CHANNELS if name in recording.readings), None)
    if kind is None:
        return
    readings, rows = recording.readings[kind], len(recording)
    geometry = np.concatenate([np.zeros((rows, 0)), *(recording.inputs[name] for name in INPUTS[kind])], axis=1)
    values, seen, times = readings.values, readings.seen, recording.times
    if kind == "tdoa":  # A row has the differences of a message in slots.
        slots = values.shape[1]
        geometry, times = geometry.reshape(rows * slots, -1), np.repeat(times, slots)
        values, seen = values.reshape(-1, 1), seen.reshape(-1, 1)
    some = seen.any(axis=1)
    height = float(recording.inputs["height"][0]) if planar else None
    yield Problem(
        folder, trajectory.tag, kind, times[some], values[some].astype(float), seen[some],
        geometry[some].astype(float), height,
    )  # fmt: skip


INPUTS = {"ranges": ("anchors",), "tdoa": ("pairs",), "bearings": ("origin", "axes"), "fixes": ()}
"""The inputs of a row that are the geometry of its reading."""
