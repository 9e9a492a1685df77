"""The posterior Cramér–Rao bound of a tracked recording, from its truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from trackers.core.algebra import Vector
from trackers.core.crlb import posterior_bound
from trackers.core.ekf import ExtendedKalman
from trackers.core.motion import Kinematic
from trackers.core.recording import Batch, Row, stack
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch

RUNS = 256
"""Runs over which the information is averaged at most."""


def bounds_of(folder: RecordingFolder, groups: Sequence[TrackerBatch]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times (t,) s and bounds (t, 3) m of a recording's positions; None where there is no such bound.

    Averaged over the recording's tags where they share their times, else of its first tag; over the rows at which the
    truth is known. The true velocity is the truth's difference quotient.
    """
    mine = [(g, trajectory) for g in groups for trajectory in g.trajectories if trajectory.folder is folder]
    if not mine or not isinstance(mine[0][0].tracker, Tracker) or mine[0][1].station:
        return None
    tracker, first = mine[0][0].tracker, mine[0][1].recording
    # A bound is of one filter's position and velocity at the rows' own times.
    if (
        not isinstance(tracker.filter, ExtendedKalman)
        or type(tracker).at_valid_time is not AbstractTracker.at_valid_time
    ):
        return None
    known = first.truth["position"][1]
    if known.sum() < 3:
        return None
    rows = slice(int(np.argmax(known)), len(known) - int(np.argmax(known[::-1])))
    same = [
        trajectory.recording
        for group, trajectory in mine[:RUNS]
        if group is mine[0][0]
        and np.array_equal(trajectory.recording.times, first.times)
        and np.array_equal(trajectory.recording.truth["position"][1], known)
    ]
    batch = stack(same).rows(rows)
    if not _is_kinematic(tracker, batch):
        return None
    places = np.stack([r.truth["position"][0][rows] for r in same], axis=-1)
    times = first.times[rows]
    dimensions = 2 if mine[0][0].planar else 3
    step = np.maximum(np.gradient(times), 1e-3)[:, None, None]
    speeds = np.gradient(places, axis=0) / step
    velocities = getattr(tracker.start, "velocities", dimensions)
    state = Kinematic(
        Vector.of(np.asarray(places[:, k], batch.dt.dtype) for k in range(dimensions)),
        Vector.of(np.asarray(speeds[:, k], batch.dt.dtype) for k in range(velocities)),
    )
    bound = posterior_bound(tracker, batch, state)[:, :dimensions]
    return times, np.pad(bound, ((0, 0), (0, 3 - dimensions)), constant_values=np.nan)


def _is_kinematic(tracker: Tracker, batch: Batch) -> bool:
    """Whether position and velocity, which the truth gives, are all that the tracker estimates."""
    row = Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)
    first = jax.tree_util.tree_map(lambda x: x[0, ..., 0], row)

    def initial_mean(first: Row) -> Any:
        return tracker.start.belief(tracker.start.candidate(tracker.sensors, first), first).mean

    return isinstance(jax.eval_shape(initial_mean, first), Kinematic)
