"""One chunk of a condition: draw its trajectories, run every tracker on them, and score the estimates.

All in one program where the tracker's rows are the drawn numbers (`program.py`), else by way of recordings.
"""

from __future__ import annotations

import fnmatch
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from threading import Lock
from typing import Any

import jax
import numpy as np

from trackwright.experiments.monte_carlo.declaration import WORLD, Condition, Study, TrackerConfig
from trackwright.experiments.monte_carlo.program import ChunkProgram, UnfitError, compiled, part_of, piece_of
from trackwright.experiments.monte_carlo.tracked import TrackedRuns, numbered_rows, scored
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.model.tunable import tunables, with_values
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.evaluation.bounds import posterior_bound
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import TrackerBatch, Trajectories, track

BOUNDED = 256  # trajectories at most over which the information of a Cramér–Rao bound is averaged


def run_chunk(study: Study, condition: Condition, ids: np.ndarray, first: bool) -> list[dict[str, np.ndarray]]:
    """The sums, histograms and measures of these trajectories by tracker; of the `first` chunk bounds and times, too.
    Raises UnusableInput where world, trackers and values do not fit each other."""
    # Simulated where the first tracker asks for recordings, for all of them.
    folder, results = cache(partial(_folder, study, condition, ids)), []
    for name, config in study.trackers.items():
        program = _program_of(study, condition, name)
        batches = cache(lambda name=name: _batches(study, condition, name, folder()))
        recordings = partial(_scored, study, config, batches, ids)
        run = partial(program.run, part_of(study.seed, ids)) if program else recordings
        arrays = run()
        if first:
            if "us_per_row" in study.metrics:
                began = time.perf_counter()
                run()  # again: the first run also compiled
                us_per_row = 1e6 * (time.perf_counter() - began) / max(np.sum(arrays["sum n_rows"]), 1)
                arrays["us_per_row"] = np.array(us_per_row)
            if any(metric.startswith("bound") for metric in study.metrics):
                arrays["bounds"] = _bounds(batches())
        results.append(arrays)
    return results


def _scored(
    study: Study, config: TrackerConfig, batches: Callable[[], list[TrackerBatch]], ids: np.ndarray
) -> dict[str, np.ndarray]:
    """The sums, histograms and measures of a tracker's estimates of recordings."""
    groups = [_of_ids(batch, ids) for batch in batches()]
    if not groups:
        raise UnusableInput("the world has no tag to track; expected one for each id")
    folder = groups[0].trajectories[0].folder
    rows = numbered_rows(track(groups, seed=study.seed).table, folder, ids, config.every)
    arrays, runs = scored(rows, len(ids)), cache(partial(TrackedRuns.of, rows, folder))
    for measure, function in study.measures.items():
        values = arrays[f"measure {measure}"] = np.asarray(function(runs()), float)
        if values.shape != ids.shape:
            found = f"measure '{measure}' returns shape {values.shape}; expected {ids.shape}"
            raise UnusableInput(f"study '{study.name}': {found}, one number for each trajectory")
    return arrays


_building = Lock()


def _program_of(study: Study, condition: Condition, name: str) -> ChunkProgram | None:
    """The program of a tracker in a condition, made at its first chunk; None where recordings are needed."""
    if study.measures:
        return None
    with _building:
        key = condition.index, name, bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]
        if key not in study.programs:
            ids, batches = np.zeros(piece_of(study.chunk), int), partial(_batches, study, condition, name)
            folder, part = _folder(study, condition, ids[:1]), part_of(study.seed, ids)
            try:
                study.programs[key] = compiled(folder, batches, study.trackers[name].every, part)
            except UnfitError:
                study.programs[key] = None
        return study.programs[key]


def require_fitting_parts(study: Study) -> None:
    """Refuse a study whose worlds, trackers and values do not fit, by one trajectory of every world."""
    for world in study.worlds:
        condition = next(c for c in study.conditions if c.world == world)
        folder = _folder(study, condition, np.zeros(1, int))
        every = [batch for name in study.trackers for batch in _batches(study, condition, name, folder)]
        known = {tunable for batch in every for tunable in tunables(batch.tracker)}
        for pattern in (k for k in condition.numbers if not k.startswith(WORLD)):
            if not fnmatch.filter(known, pattern):
                fix = f"expected 'world.' and a parameter of the worlds, or one of {', '.join(sorted(known))}"
                raise UnusableInput(f"study '{study.name}': grid '{pattern}': no tracker has such a tunable; {fix}")


def _folder(study: Study, condition: Condition, ids: np.ndarray) -> RecordingFolder:
    """The simulated folder of these trajectories; raises UnusableInput for numbers that do not fit the world."""
    try:
        return study.worlds[condition.world].make(ids, study.seed, **study.numbers(condition))
    except (TypeError, ValueError) as error:
        raise UnusableInput(f"study '{study.name}', world '{condition.world}': {error}") from error


def _batches(study: Study, condition: Condition, name: str, folder: RecordingFolder) -> list[TrackerBatch]:
    """The batches of a folder for a tracker, with the values of its own and of the grid."""
    of, config, batches = f"study '{study.name}', tracker '{name}'", study.trackers[name], []
    grid = {k: v for k, v in condition.numbers.items() if not k.startswith(WORLD)}
    for batch in config.spec.batches([folder], name, config.free_height):
        names = list(tunables(batch.tracker))
        own = {pattern: value for pattern, value in grid.items() if fnmatch.filter(names, pattern)}
        tracker: Any = with_values(with_values(batch.tracker, dict(config.tunables), of), own, of)
        try:
            tracker = Smoothed(tracker, None) if config.smooth else tracker
        except TypeError as error:
            raise UnusableInput(f"{of}: smooth: {error}; remove `smooth`") from error
        batches.append(replace(batch, tracker=tracker))
    return batches


def _of_ids(batch: TrackerBatch, ids: np.ndarray) -> TrackerBatch:
    """The batch without further tags of a body, which are no trajectories of their own."""
    trajectories = Trajectories.of(batch.trajectories)
    own = np.flatnonzero(np.isin(trajectories.tags, ids.astype(str)))
    return replace(batch, trajectories=trajectories.chosen(own))


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
    if len(same[0].times) < 2:
        return np.full(2, np.nan)
    batch, d = stack(same), tracker.motion.dimensions
    positions = np.stack([one.truth["position"][0] for one in same], axis=-1)
    speeds = np.gradient(positions, axis=0) / np.gradient(same[0].times)[:, None, None]
    states = (Vector.of(np.asarray(x[:, k], batch.dt.dtype) for k in range(d)) for x in (positions, speeds))
    sigmas = posterior_bound(tracker, batch, Kinematic(*states))[len(batch.dt) // 2 :, :d]
    squares = (sigmas**2).mean(axis=0)
    return np.sqrt([squares[:2].sum(), squares.sum() if d == 3 else np.nan])
