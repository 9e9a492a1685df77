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
from trackers.core.estimates import Estimates, Status, is_usable
from trackers.core.smoother import Smoothed
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import tunables, with_values
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks import angles, rounded
from trackers.recordings.trajectories import Trajectories
from trackers.recordings.truth import TruthStatus
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
    groups = [Trajectories.of(batch.trajectories) for batch in batches]
    if not groups:
        raise UnusableInput("the world has no tag to track; expected one for each id")
    folder, stations = groups[0].folders[0], sorted({station for own in groups for station in own.stations})
    number = {str(k): at for at, k in enumerate(ids)}
    shape = (len(ids), max(int(np.diff(own.columns.starts).max()) for own in groups), len(stations))
    width = 2 if stations[0] else 3
    axes = 2 if stations[0] else max(2 if batch.planar else 3 for batch in batches)
    times = np.full(shape[:2], np.nan)
    estimates, truth = np.full((*shape, width), np.nan), np.full((*shape, width), np.nan)
    covariance = np.full((*shape, axes, axes), np.nan)
    known, status = np.zeros(shape, bool), np.full(shape, int(Status.PADDING))
    nis, dof = np.zeros(shape), np.zeros(shape)
    seconds = 0.0
    for batch, own in zip(batches, groups, strict=True):
        columns = own.columns
        rows = columns.padded(columns.times)
        stacked = columns.batch(rounded(rows.shape[1]), seed=study.seed)
        # Padded to whole chunks, so that the bits depend neither on the number of trajectories nor of devices.
        whole = stacked.columns(0, study.chunk * -(-stacked.size // study.chunk))
        began = time.perf_counter()
        found = batch.tracker.run(whole, study.chunk)
        seconds += time.perf_counter() - began
        found = found[: len(own)].rows(slice(0, rows.shape[1]))
        tag, station = [number[tag] for tag in own.tags], [stations.index(station) for station in own.stations]
        every = tag == list(range(len(ids))) and len(stations) == 1
        # Slices where they do: an index for each trajectory takes five times as long.
        at: Any = (slice(None) if every else tag, slice(0, rows.shape[1]), 0 if every else station)
        times[tag, : rows.shape[1]] = found.valid_times(rows)
        position, P = _moments(own, found)
        estimates[at], covariance[at + (slice(0, P.shape[-1]),) * 2] = position, P
        status[at], nis[at], dof[at] = found.status, found.nis, found.nis_dof
        truth[at], has_truth = _truth(own, found.valid_times(rows))
        known[at] = _scored_rows(found, rows, has_truth & np.isfinite(position[..., :2]).all(axis=-1), config.every)
    values = (estimates, covariance, truth, known, status, nis, dof)
    if not stations[0]:
        values = tuple(x[:, :, 0] for x in values)  # type: ignore[assignment]
    return TrackedRuns(times, *values, folder), seconds


def _moments(own: Trajectories, found: Estimates) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, T, 3) m or angles (n, T, 2) rad, with the covariance of the estimated axes; NaN where unusable."""
    usable = found.usable
    if own.stations[0]:
        angle = angles(found)
        position = np.stack([angle["azimuth_rad"], angle["elevation_rad"]], axis=-1)
        deviations = np.stack([angle["std_azimuth_rad"], angle["std_elevation_rad"]], axis=-1)
        P = deviations[..., None] ** 2 * np.eye(2)
    else:
        axes = [np.asarray(x, float) for x in found.mean.position]
        heights = np.broadcast_to(own.heights[:, None], usable.shape)
        position = np.stack(axes if len(axes) == 3 else [*axes, heights], axis=-1)
        P = found.marginal("position")
    position[~usable], P[~usable] = np.nan, np.nan
    return position, P


def _truth(own: Trajectories, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The truth at `times` (n, T), (n, T, 3) m or (n, T, 2) rad, and the rows that have one; heights may be NaN."""
    columns = own.columns
    if own.stations[0]:
        values, known = columns.truth["direction"]
    else:
        rows = np.arange(times.shape[1]) < np.diff(columns.starts)[:, None]
        values, status = own.folders[0].paths.at(own.tags, columns.starts, times[rows])
        known = status == TruthStatus.SCORED
    return columns.padded(values), columns.padded(known)


def _scored_rows(found: Estimates, rows: np.ndarray, known: np.ndarray, every: float | None) -> np.ndarray:
    """The rows (n, T) that are scored, of the `known` ones: the last of each time `rows` (n, T) and of `every` seconds.

    A time counts where it has an estimate: see `Estimates.status_per_time`.
    """
    last = found.last_rows(rows)
    usable = np.zeros(last.shape, bool)
    usable[last] = is_usable(found.status_per_time(last))
    track = np.broadcast_to(np.arange(len(last))[:, None], last.shape)
    times = found.valid_times(rows)
    return last_of_intervals(times.ravel(), (known & usable).ravel(), every, track.ravel()).reshape(last.shape)


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
