"""One chunk of a condition: simulate its trajectories, run every tracker on them, and score the estimates."""

from __future__ import annotations

import fnmatch
import time
from typing import Any

import numpy as np

from trackwright.experiments.monte_carlo.declaration import WORLD, Condition, Study, TrackerConfig
from trackwright.experiments.monte_carlo.tracked import TrackedRuns, scored, tracked_runs
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.model.tunable import tunables, with_values
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.evaluation.bounds import posterior_bound
from trackwright.trackers.recordings.tracks import TrackerBatch, rounded
from trackwright.trackers.recordings.trajectories import Trajectories

BOUNDED = 256
"""Largest number of trajectories over which the information of a Cramér–Rao bound is averaged."""


def run_chunk(study: Study, condition: Condition, ids: np.ndarray, first: bool) -> list[dict[str, np.ndarray]]:
    """The sums, histograms and measures of these trajectories by tracker; of the `first` chunk bounds and times, too.
    Raises UnusableInput where world, trackers and values do not fit each other."""
    prepared = _prepared(study, condition, ids)
    results = []
    for name, config in study.trackers.items():
        batches = prepared[name]
        runs, seconds = _track(batches, ids, study, config)
        arrays = scored(runs)
        for measure, function in study.measures.items():
            values = arrays[f"measure {measure}"] = np.asarray(function(runs), float)
            if values.shape != ids.shape:
                found = f"measure '{measure}' returns shape {values.shape}; expected {ids.shape}"
                raise UnusableInput(f"study '{study.name}': {found}, one number for each trajectory")
        if first:
            if "us_per_row" in study.metrics:
                # A second run: the first one also compiled.
                seconds = _track(batches, ids, study, config)[1]
                arrays["us_per_row"] = np.array(1e6 * seconds / max(np.sum(runs.status != Status.PADDING), 1))
            if any(metric.startswith("bound") for metric in study.metrics):
                arrays["bounds"] = _bounds(batches)
        results.append(arrays)
    return results


def require_fitting_parts(study: Study) -> None:
    """Refuse a study whose worlds, trackers and values do not fit, by one trajectory of every world."""
    for world in study.worlds:
        _prepared(study, next(c for c in study.conditions if c.world == world), np.zeros(1, int))


def _prepared(study: Study, condition: Condition, ids: np.ndarray) -> dict[str, list[TrackerBatch]]:
    """The batches of every tracker of the simulated trajectories with these ids, with the values of its own and of the
    grid. Raises UnusableInput for a name in the grid that matches no tunable of any tracker."""
    where = f"study '{study.name}'"
    try:
        folder = study.worlds[condition.world].make(ids, study.seed, **study.numbers(condition))
    except (TypeError, ValueError) as error:
        raise UnusableInput(f"{where}, world '{condition.world}': {error}") from error
    grid, known = {k: v for k, v in condition.numbers.items() if not k.startswith(WORLD)}, set[str]()
    prepared: dict[str, list[TrackerBatch]] = {}
    for name, config in study.trackers.items():
        for batch in config.spec.batches([folder], name, config.free_height):
            of = f"{where}, tracker '{name}'"
            names = list(tunables(batch.tracker))
            known.update(names)
            own = {pattern: value for pattern, value in grid.items() if fnmatch.filter(names, pattern)}
            tracker: Any = with_values(with_values(batch.tracker, dict(config.tunables), of), own, of)
            try:
                tracker = Smoothed(tracker, None) if config.smooth else tracker
            except TypeError as error:
                raise UnusableInput(f"{of}: smooth: {error}; remove `smooth`") from error
            prepared.setdefault(name, []).append(TrackerBatch(tracker, batch.trajectories, batch.planar))
    for pattern in grid:
        if not fnmatch.filter(known, pattern):
            fix = f"expected 'world.' and a parameter of the worlds, or one of {', '.join(sorted(known))}"
            raise UnusableInput(f"{where}: grid '{pattern}': no tracker has such a tunable; {fix}")
    return prepared


def _track(
    batches: list[TrackerBatch], ids: np.ndarray, study: Study, config: TrackerConfig
) -> tuple[TrackedRuns, float]:
    """The estimates of all trajectories, and the computing time of the trackers, s."""
    tracked, seconds = [], 0.0
    for batch in batches:
        trajectories = Trajectories.of(batch.trajectories)
        # Further tags of a body are no trajectories of their own.
        trajectories = trajectories.chosen(np.flatnonzero(np.isin(trajectories.tags, ids.astype(str))))
        longest = int(np.diff(trajectories.columns.starts).max())
        stacked = trajectories.columns.batch(rounded(longest), seed=study.seed, truth=False)
        # Padded to whole chunks, so that the bits depend neither on the number of trajectories nor of devices.
        whole = stacked.columns(0, study.chunk * -(-stacked.size // study.chunk))
        began = time.perf_counter()
        tracked.append((trajectories, batch.tracker.run(whole, study.chunk)))
        seconds += time.perf_counter() - began
    return tracked_runs(ids, tracked, all(batch.planar for batch in batches), config.every), seconds


def _bounds(batches: list[TrackerBatch]) -> np.ndarray:
    """The Cramér–Rao bound, m, horizontal and 3-D: root mean square over the second half of the rows; NaN without one.
    The first half is left out, since the bound of the first rows is the prior of the tracker's start. An extended
    Kalman filter of position and velocity at the times of its rows has one, for tags that share the first's times."""
    tracker, recordings = batches[0].tracker, [t.recording for t in batches[0].trajectories[:BOUNDED]]
    same = [one for one in recordings if np.array_equal(one.times, recordings[0].times)]
    if not isinstance(tracker, Tracker) or tracker.latency is not None or "position" not in same[0].truth:
        return np.full(2, np.nan)
    if type(tracker.motion) is not ConstantVelocity or not isinstance(tracker.filter, ExtendedKalman):
        return np.full(2, np.nan)
    batch, d = stack(same), tracker.motion.dimensions
    positions = np.stack([one.truth["position"][0] for one in same], axis=-1)
    speeds = np.gradient(positions, axis=0) / np.gradient(same[0].times)[:, None, None]
    states = (Vector.of(np.asarray(x[:, k], batch.dt.dtype) for k in range(d)) for x in (positions, speeds))
    sigmas = posterior_bound(tracker, batch, Kinematic(*states))[len(batch.dt) // 2 :, :d]
    squares = (sigmas**2).mean(axis=0)
    return np.sqrt([squares[:2].sum(), squares.sum() if d == 3 else np.nan])
