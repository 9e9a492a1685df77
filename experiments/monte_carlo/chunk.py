"""One chunk of a condition: simulate its trajectories, run every tracker on them, and score the estimates."""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.monte_carlo.declaration import WORLD, Condition, Study, TrackerConfig
from experiments.monte_carlo.errors import TrackedRuns, scored
from trackers.bounds import bounds_of
from trackers.core.errors import UnusableInput
from trackers.core.estimates import Estimates, Status
from trackers.core.recording import stack
from trackers.core.smoother import Smoothed
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import tunables, with_values
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks import angles, rounded
from trackers.recordings.trajectories import Trajectory, known_heights
from trackers.recordings.truth import TruthPath, TruthStatus, interpolate_truth, truth_by_tag
from trackers.scoring import last_of_intervals


def run_chunk(study: Study, condition: Condition, ids: np.ndarray, first: bool) -> list[dict[str, np.ndarray]]:
    """The accumulators and measures of the trajectories with these ids, one dictionary per tracker.

    `first`: whether this is a condition's first chunk, which also gives bounds and computing times. Raises
    UnusableInput where world, trackers and values do not fit each other.
    """
    folder, prepared = _prepared(study, condition, ids)
    results = []
    for name, config in study.trackers.items():
        batches = prepared[name]
        tracked, seconds = _track(batches, ids, study, config)
        arrays = scored(tracked)
        for measure, function in study.measures.items():
            arrays[f"measure {measure}"] = _measured(study, measure, function(tracked), len(ids))
        if first:
            if "us_per_row" in study.metrics:
                # A second run: the first one also compiled.
                seconds = _track(batches, ids, study, config)[1]
                arrays["us_per_row"] = np.array(1e6 * seconds / max(int((tracked.status != Status.PADDING).sum()), 1))
            if any(metric.startswith("bound") for metric in study.metrics):
                arrays["bounds"] = _bounds(folder, batches)
        results.append(arrays)
    return results


def tracked_runs(study: Study, world: str, ids: np.ndarray, **point: float) -> dict[str, TrackedRuns]:
    """The estimates of every tracker of a study for the trajectories with these ids, at a point of the grid."""
    (condition,) = [c for c in study.conditions if c.world == world and point.items() <= c.point.items()]
    prepared = _prepared(study, condition, ids)[1]
    return {name: _track(prepared[name], ids, study, c)[0] for name, c in study.trackers.items()}


def require_fitting_parts(study: Study) -> None:
    """Refuse a study whose worlds, trackers and values do not fit each other, by one trajectory of every world.

    Raises UnusableInput. Values of the grid beyond the first of each world are checked when their chunks run.
    """
    for world in study.worlds:
        _prepared(study, next(c for c in study.conditions if c.world == world), np.zeros(1, int))


def _prepared(
    study: Study, condition: Condition, ids: np.ndarray
) -> tuple[RecordingFolder, dict[str, list[TrackerBatch]]]:
    """The simulated recording of the trajectories with these ids, and the batches of every tracker."""
    folder = _simulated(study, condition, ids)
    untuned = {name: c.spec.batches([folder], name, c.free_height) for name, c in study.trackers.items()}
    _require_grid_is_used(study, condition, untuned)
    return folder, {
        name: _configured(study, condition, name, config, untuned[name]) for name, config in study.trackers.items()
    }


def _simulated(study: Study, condition: Condition, ids: np.ndarray) -> RecordingFolder:
    try:
        return study.worlds[condition.world].make(ids, study.seed, **study.numbers(condition))
    except (TypeError, ValueError) as error:
        raise UnusableInput(f"study '{study.name}', world '{condition.world}': {error}") from error


def _configured(
    study: Study, condition: Condition, name: str, config: TrackerConfig, batches: list[TrackerBatch]
) -> list[TrackerBatch]:
    where = f"study '{study.name}', tracker '{name}'"
    made = []
    for batch in batches:
        tracker = with_values(batch.tracker, dict(config.tunables), where)
        tracker = with_values(tracker, _grid_values(condition, tracker), where)
        if config.smooth:
            if not isinstance(tracker, Tracker):
                raise UnusableInput(f"{where}: smooth: this tracker has no smoother; remove `smooth`")
            try:
                tracker = Smoothed(tracker, None)
            except TypeError as error:
                raise UnusableInput(f"{where}: smooth: {error}; remove `smooth`") from error
        made.append(TrackerBatch(tracker, batch.trajectories, batch.planar))
    return made


def _grid_values(condition: Condition, tracker: AbstractTracker) -> dict[str, Any]:
    """The values of the grid for tunables of this tracker."""
    own = list(tunables(tracker))
    return {k: v for k, v in condition.numbers.items() if not k.startswith(WORLD) and fnmatch.filter(own, k)}


def _require_grid_is_used(study: Study, condition: Condition, untuned: Mapping[str, list[TrackerBatch]]) -> None:
    """Refuse a grid name that matches no tunable of any tracker."""
    own = {name for batches in untuned.values() for batch in batches for name in tunables(batch.tracker)}
    for pattern in condition.numbers:
        if not pattern.startswith(WORLD) and not fnmatch.filter(own, pattern):
            raise UnusableInput(
                f"study '{study.name}': grid '{pattern}': no tracker has such a tunable; expected 'world.' and a "
                f"parameter of the worlds, or one of {', '.join(sorted(own))}"
            )


def _track(
    batches: list[TrackerBatch], ids: np.ndarray, study: Study, config: TrackerConfig
) -> tuple[TrackedRuns, float]:
    """The estimates of all trajectories beside their truth, and the computing time of the trackers, s."""
    trajectories = [trajectory for batch in batches for trajectory in batch.trajectories]
    if not trajectories:
        raise UnusableInput("the world has no tag to track; expected one for each id")
    stations = sorted({trajectory.station for trajectory in trajectories})
    number = {str(k): at for at, k in enumerate(ids)}
    rows = max(len(trajectory.recording) for trajectory in trajectories)
    shape = (len(ids), rows, len(stations))
    width = 2 if stations[0] else 3
    axes = 2 if stations[0] else max(2 if batch.planar else 3 for batch in batches)
    times = np.full(shape[:2], np.nan)
    estimates, truth = np.full((*shape, width), np.nan), np.full((*shape, width), np.nan)
    covariance = np.full((*shape, axes, axes), np.nan)
    known, status = np.zeros(shape, bool), np.full(shape, int(Status.PADDING))
    nis, dof = np.zeros(shape), np.zeros(shape)
    seconds, paths = 0.0, truth_by_tag(trajectories[0].folder)
    for batch in batches:
        padded = rounded(max(len(trajectory.recording) for trajectory in batch.trajectories))
        stacked = stack([trajectory.recording for trajectory in batch.trajectories], rows=padded, seed=study.seed)
        # Padded to whole chunks, so that the bits depend neither on the number of trajectories nor of devices.
        whole = stacked.columns(0, study.chunk * -(-stacked.size // study.chunk))
        began = time.perf_counter()
        found = batch.tracker.run(whole, study.chunk)
        seconds += time.perf_counter() - began
        for k, trajectory in enumerate(batch.trajectories):
            one, size = found[k], len(trajectory.recording)
            at = number[trajectory.tag], slice(0, size), stations.index(trajectory.station)
            own = one.rows(slice(0, size))
            at_valid_time = own.valid_times(trajectory.recording.times)
            position, P = _moments(trajectory, own)
            times[at[0], :size] = at_valid_time
            estimates[at], status[at], nis[at], dof[at] = position, own.status, own.nis, own.nis_dof
            covariance[at][..., : P.shape[-1], : P.shape[-1]] = P
            truth[at], counts = _truth(trajectory, at_valid_time, paths)
            last, merged = own.per_time(trajectory.recording.times)
            scored_rows = counts & np.isfinite(position[:, :2]).all(axis=1)
            scored_rows[last] &= merged.usable
            known[at] = last_of_intervals(at_valid_time, scored_rows & last, config.every)
    values = (estimates, covariance, truth, known, status, nis, dof)
    if not stations[0]:
        values = tuple(x[:, :, 0] for x in values)  # type: ignore[assignment]
    return TrackedRuns(times, *values, batches[0].trajectories[0].folder), seconds


def _moments(trajectory: Trajectory, own: Estimates) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) m or angles (T, 2) rad, with the covariance of the estimated axes; NaN where unusable."""
    usable = own.usable
    if trajectory.station:
        found = angles(own)
        position = np.stack([found["azimuth_rad"], found["elevation_rad"]], axis=-1)
        deviations = np.stack([found["std_azimuth_rad"], found["std_elevation_rad"]], axis=-1)
        P = deviations[:, :, None] ** 2 * np.eye(2)
    else:
        axes = [np.asarray(x, float) for x in own.mean.position]
        d = len(axes)
        position = np.stack(axes if d == 3 else [*axes, known_heights(trajectory)], axis=-1)
        P = own.marginal("position")
    return np.where(usable[:, None], position, np.nan), np.where(usable[:, None, None], P, np.nan)


def _truth(trajectory: Trajectory, times: np.ndarray, paths: Mapping[str, TruthPath]) -> tuple[np.ndarray, np.ndarray]:
    """The truth at `times`, (T, 3) m or (T, 2) rad, and the rows that have one; heights may be missing (NaN)."""
    if trajectory.station or trajectory.tag not in paths:
        values, known = next(iter(trajectory.recording.truth.values()))
        return values, known.copy()
    position, status = interpolate_truth(times, *paths[trajectory.tag])
    return position, status == TruthStatus.SCORED


def _measured(study: Study, name: str, found: Any, n: int) -> np.ndarray:
    values = np.asarray(found, float)
    if values.shape != (n,):
        raise UnusableInput(
            f"study '{study.name}': measure '{name}' returns shape {values.shape}; expected ({n},), one number "
            "for each trajectory"
        )
    return values


def _bounds(folder: RecordingFolder, batches: list[TrackerBatch]) -> np.ndarray:
    """The Cramér–Rao bound, m, horizontal and 3-D: root mean square over the second half of the rows; NaN without one.

    The first half is left out, since the bound of the first rows is the prior of the tracker's start.
    """
    found = bounds_of(folder, batches)
    if found is None:
        return np.full(2, np.nan)
    squares = (found[1][len(found[1]) // 2 :] ** 2).mean(axis=0)
    return np.sqrt([squares[:2].sum(), squares.sum()])
