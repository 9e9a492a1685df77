"""Posterior Cramér–Rao bound of the position errors on a recording, evaluated along its truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from trackwright.trackers.core.data.recording import Batch, stack
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import Kinematic
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.run.crlb import NoBoundError, posterior_bound
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracker_spec import TrackerBatch

MAX_RUNS = 256
"""Largest number of tags over which the information is averaged."""


def bounds_of(folder: RecordingFolder, batches: Sequence[TrackerBatch]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (t,), s, and bounds (t, 3), m, on the standard deviation of a recording's positions, over the known truth.

    The information is averaged over the tags of the recording if they share their times, else it is that of the first
    tag. True velocities are difference quotients of the truth. None without truth, and for a tracker without a bound:
    any but an extended Kalman filter of position and velocity at the times of its rows.
    """
    mine = [(b, trajectory) for b in batches for trajectory in b.trajectories if trajectory.folder.name == folder.name]
    if not mine or not isinstance(mine[0][0].tracker, Tracker) or mine[0][1].station:
        return None
    tracker, first = mine[0][0].tracker, mine[0][1].recording
    if not isinstance(tracker.filter, ExtendedKalman) or tracker.latency is not None:
        return None
    known = first.truth["position"][1]
    if known.sum() < 3:
        return None
    rows = slice(int(np.argmax(known)), len(known) - int(np.argmax(known[::-1])))
    same = [
        trajectory.recording
        for owner, trajectory in mine[:MAX_RUNS]
        if owner is mine[0][0]
        and np.array_equal(trajectory.recording.times, first.times)
        and np.array_equal(trajectory.recording.truth["position"][1], known)
    ]
    batch = stack(same).rows(rows)
    velocities = _velocities(tracker, batch)
    if velocities is None:
        return None
    positions = np.stack([r.truth["position"][0][rows] for r in same], axis=-1)
    times = first.times[rows]
    dimensions = 2 if mine[0][0].planar else 3
    step = np.maximum(np.gradient(times), 1e-3)[:, None, None]
    speeds = np.gradient(positions, axis=0) / step
    state = Kinematic(
        Vector.of(np.asarray(positions[:, k], batch.dt.dtype) for k in range(dimensions)),
        Vector.of(np.asarray(speeds[:, k], batch.dt.dtype) for k in range(velocities)),
    )
    try:
        bound = posterior_bound(tracker, batch, state)[:, :dimensions]
    except NoBoundError:
        return None
    return times, np.pad(bound, ((0, 0), (0, 3 - dimensions)), constant_values=np.nan)


def _velocities(tracker: Tracker, batch: Batch) -> int | None:
    """The number of velocities in a state of position and velocity alone; None for another state."""
    row = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)
    first = jax.tree_util.tree_map(lambda x: x[0, ..., 0], row)

    def initial_mean(first: Row) -> Any:
        return tracker.start.belief(tracker.start.candidate(tracker.sensors, first), first).mean

    mean = jax.eval_shape(initial_mean, first)
    return len(mean.velocity) if isinstance(mean, Kinematic) else None
