"""One scenario, some trajectories, every tracker: what is kept of each trajectory."""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.monte_carlo.declaration import WORLD, Condition, Study, TrackerConfig
from experiments.monte_carlo.errors import TrackedRuns, scored
from trackers.bounds import bounds_of
from trackers.core.algebra import triangle
from trackers.core.errors import UnusableInput
from trackers.core.estimates import Estimates, Status
from trackers.core.recording import stack
from trackers.core.rts import Smoothed
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import tunables, with_values
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks import angles, rounded
from trackers.recordings.trajectories import Trajectory, known_heights, true_paths
from trackers.recordings.truth import TruthStatus, interpolated


def run_chunk(study: Study, condition: Condition, ids: np.ndarray, first: bool) -> list[dict[str, np.ndarray]]:
    """For every tracker what is kept of the trajectories with these ids, by name; `first`: bounds and times too.

    Raises UnusableInput where world, tracker or numbers don't fit each other.
    """
    made = study.worlds[condition.world]
    try:
        folder = made.make(ids, study.seed, **study.numbers(condition))
    except (TypeError, ValueError) as error:
        raise UnusableInput(f"study '{study.name}', world '{condition.world}': {error}") from error
    plain = {name: e.spec.batches([folder], name, e.free_height) for name, e in study.trackers.items()}
    _all_taken(study, condition, plain)
    kept = []
    for name, config in study.trackers.items():
        batches = _with_numbers(study, condition, name, config, plain[name])
        tracked, seconds = _run(batches, ids, study.chunk, config)
        own = scored(tracked)
        for measure, function in study.measures.items():
            own[f"measure {measure}"] = _measured(study, measure, function(tracked), len(ids))
        if first:
            # Once more: the first time the program was compiled.
            if "us_per_row" in study.metrics:
                seconds = _run(batches, ids, study.chunk, config)[1]
                own["us_per_row"] = np.array(1e6 * seconds / max(int((tracked.status != Status.PADDING).sum()), 1))
            if any(f.startswith("bound") for f in study.metrics):
                own["bounds"] = _bounds(folder, batches)
        kept.append(own)
    return kept


def tracker_batches(
    study: Study, condition: Condition, name: str, config: TrackerConfig, folder: RecordingFolder
) -> list[TrackerBatch]:
    """The trajectories of a folder with the tracker as it enters a cell; raises UnusableInput where they don't fit."""
    return _with_numbers(study, condition, name, config, config.spec.batches([folder], name, config.free_height))


def _with_numbers(
    study: Study, condition: Condition, name: str, config: TrackerConfig, batches: list[TrackerBatch]
) -> list[TrackerBatch]:
    where = f"study '{study.name}', tracker '{name}'"
    made = []
    for batch in batches:
        tracker = with_values(batch.tracker, dict(config.tunables), where)
        tracker = with_values(tracker, _of_grid(condition, tracker), where)
        if config.smooth:
            if not isinstance(tracker, Tracker):
                raise UnusableInput(f"{where}: smooth: this tracker has no smoother; leave `smooth` out")
            try:
                tracker = Smoothed(tracker, None)
            except TypeError as error:
                raise UnusableInput(f"{where}: smooth: {error}; leave `smooth` out") from error
        made.append(TrackerBatch(tracker, batch.trajectories, batch.planar))
    return made


def _of_grid(condition: Condition, tracker: AbstractTracker) -> dict[str, Any]:
    """The numbers of the grid that this tracker has."""
    own = list(tunables(tracker))
    return {k: v for k, v in condition.numbers.items() if not k.startswith(WORLD) and fnmatch.filter(own, k)}


def _all_taken(study: Study, condition: Condition, plain: Mapping[str, list[TrackerBatch]]) -> None:
    """Refuse a number of the grid that no tracker has."""
    own = {name for batches in plain.values() for batch in batches for name in tunables(batch.tracker)}
    for pattern in condition.numbers:
        if not pattern.startswith(WORLD) and not fnmatch.filter(own, pattern):
            raise UnusableInput(
                f"study '{study.name}': grid '{pattern}': no tracker has it; expected 'world.' and a number of the "
                f"worlds, or one of {', '.join(sorted(own))}"
            )


def _run(batches: list[TrackerBatch], ids: np.ndarray, chunk: int, config: TrackerConfig) -> tuple[TrackedRuns, float]:
    """The estimates of all trajectories, trajectories first, and the seconds that the trackers took."""
    every = [trajectory for batch in batches for trajectory in batch.trajectories]
    if not every:
        raise UnusableInput("a world without a single tag to track; expected one for each id")
    stations = sorted({trajectory.station for trajectory in every})
    number = {str(k): at for at, k in enumerate(ids)}
    rows = max(len(trajectory.recording) for trajectory in every)
    shape = (len(ids), rows, len(stations))
    width = 2 if stations[0] else 3
    axes = 2 if stations[0] else max(2 if batch.planar else 3 for batch in batches)
    times = np.full(shape[:2], np.nan)
    estimates, truth = np.full((*shape, width), np.nan), np.full((*shape, width), np.nan)
    covariance = np.full((*shape, axes, axes), np.nan)
    known, status = np.zeros(shape, bool), np.full(shape, int(Status.PADDING))
    nis, dof = np.zeros(shape), np.zeros(shape)
    seconds = 0.0
    for batch in batches:
        padded = rounded(max(len(trajectory.recording) for trajectory in batch.trajectories))
        stacked = stack([trajectory.recording for trajectory in batch.trajectories], rows=padded)
        # Whole chunks only: then a trajectory's numbers don't depend on how many there are, nor on how many devices.
        whole = stacked.trajectories(0, chunk * -(-stacked.size // chunk))
        began = time.perf_counter()
        found = batch.tracker.run(whole, chunk)
        seconds += time.perf_counter() - began
        paths: Mapping[str, Any] = true_paths(batch.trajectories[0].folder) if _shifts(batch.tracker) else {}
        for k, trajectory in enumerate(batch.trajectories):
            one, size = found[k], len(trajectory.recording)
            at = number[trajectory.tag], slice(0, size), stations.index(trajectory.station)
            at_valid_time, own = batch.tracker.at_valid_time(trajectory.recording.times, one[:size])
            place, P = _moments(trajectory, own, size)
            times[at[0], :size] = at_valid_time
            estimates[at], status[at], nis[at], dof[at] = place, own.status, own.nis, own.nis_dof
            covariance[at][..., : P.shape[-1], : P.shape[-1]] = P
            (truth[at], counts) = _truth(trajectory, at_valid_time, paths)
            known[at] = counts & own.usable & _last(at_valid_time, config.every) & np.isfinite(place[:, :2]).all(axis=1)
    values = (estimates, covariance, truth, known, status, nis, dof)
    if not stations[0]:
        values = tuple(x[:, :, 0] for x in values)  # type: ignore[assignment]
    return TrackedRuns(times, *values, batches[0].trajectories[0].folder), seconds


def _moments(trajectory: Trajectory, own: Estimates, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Places (T, 3) m, or angles (T, 2) rad, with the covariance of what was estimated."""
    usable = own.usable
    if trajectory.station:
        found = angles(own)
        place = np.stack([found["azimuth_rad"], found["elevation_rad"]], axis=-1)
        deviations = np.stack([found["std_azimuth_rad"], found["std_elevation_rad"]], axis=-1)
        P = deviations[:, :, None] ** 2 * np.eye(2)
    else:
        parts = [np.asarray(x, float) for x in own.mean.position]
        d = len(parts)
        place = np.stack(parts if d == 3 else [*parts, known_heights(trajectory)], axis=-1)
        index = {pair: k for k, pair in enumerate(triangle(own.dimension))}
        P = np.stack(
            [np.stack([own.cov_upper[index[min(i, j), max(i, j)]] for j in range(d)], -1) for i in range(d)], -2
        )
    return np.where(usable[:, None], place, np.nan), np.where(usable[:, None, None], P, np.nan)


def _shifts(tracker: AbstractTracker) -> bool:
    """Whether the tracker's estimates are valid at other times than its rows'."""
    return type(tracker).at_valid_time is not AbstractTracker.at_valid_time


def _truth(trajectory: Trajectory, times: np.ndarray, paths: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    if trajectory.tag in paths:
        place, verdict = interpolated(times, *paths[trajectory.tag])
        return place, verdict == TruthStatus.COUNTS
    return next(iter(trajectory.recording.truth.values()))


def _last(times: np.ndarray, every: float | None) -> np.ndarray:
    """The last row of every time, or of every interval of so many seconds."""
    # A time such as 0.3 s belongs to the interval it opens although 0.3 / 0.1 is 2.9999999999999996.
    at = times if every is None else np.floor(times / every + 1e-6)
    return np.append(np.diff(at) > 0, True)


def _measured(study: Study, name: str, found: Any, n: int) -> np.ndarray:
    values = np.asarray(found, float)
    if values.shape != (n,):
        raise UnusableInput(
            f"study '{study.name}': measure '{name}' gives numbers of shape {values.shape}; expected ({n},), one for "
            "each trajectory"
        )
    return values


def _bounds(folder: RecordingFolder, batches: list[TrackerBatch]) -> np.ndarray:
    """The Cramér–Rao bound as root mean square over the second half of the rows, in the plane and in space.

    NaN where there is none. The first rows' bound is the width of the tracker's start, which nobody takes for a bound.
    """
    found = bounds_of(folder, batches)
    if found is None:
        return np.full(2, np.nan)
    squares = (found[1][len(found[1]) // 2 :] ** 2).mean(axis=0)
    return np.sqrt([squares[:2].sum(), squares.sum()])
