"""Trajectories of the latest ranges of all anchors at each time, and the trackers that solve each time by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import combinations

import numpy as np

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.model.inputs import HEIGHT_LIMITS
from trackwright.trackers.parts.multilaterate import recent_rows
from trackwright.trackers.parts.ranges import RANGES, anchor_positions, range_rows
from trackwright.trackers.parts.start_nearby import last_of_times
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import Trajectories, known_height, known_heights, trajectories_of
from trackwright.trackers.uwb_imu.rows import anchors_of, lacks_ranges
from trackwright.trackers.uwb_imu.trilateration import multilateration_tracker, trilateration_tracker

WINDOWS = (0.1, 0.25, 0.5, 1.0)
"""Candidate times, s, for which a range stays valid in a snapshot of the latest ranges."""


def snapshot_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's ranges, one row per time, with the latest range of every anchor in a slot of its own."""
    rows, anchors = folder.rows("ranges"), anchor_positions(folder)
    readings, number = range_rows(folder, rows)
    last, number_of_time = last_of_times(rows.starts, rows.times)
    latest, windows = (
        x[..., 0] for x in recent_rows(last, rows.starts, rows.times, number, readings.seen[:, 0], len(anchors), most=1)
    )
    times, starts = rows.times[last], np.append(number_of_time[rows.starts[:-1]], len(last))
    age = np.where(windows > 0, times[:, None] - rows.times[latest], np.inf)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    windows = _snapshot_windows(starts, age, np.where(np.isnan(heights), 4, 3))
    fresh = age <= np.repeat(windows, np.diff(starts))[:, None]
    values = {RANGES: Readings(np.where(fresh, readings.values[latest, 0], 0.0), fresh)}
    of_row = {"anchors": anchors.ravel(), HEIGHT_LIMITS.name: folder.rig.height_limits()}
    inputs = {name: np.tile(row, (len(times), 1)) for name, row in of_row.items()}
    return trajectories_of(folder, rows.tags, starts, times, values, inputs)


def triple_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """As `snapshot_trajectories`, with the three anchors of each row that span the largest triangle."""
    anchors, snapshots = anchor_positions(folder), snapshot_trajectories(folder, free_height)
    latest = snapshots.columns.readings[RANGES]
    triples = np.array(list(combinations(range(len(anchors)), 3)))
    legs = anchors[triples][:, 1:, :2] - anchors[triples][:, :1, :2]
    areas = np.abs(legs[:, 0, 0] * legs[:, 1, 1] - legs[:, 0, 1] * legs[:, 1, 0])
    patterns, which = np.unique(latest.seen, axis=0, return_inverse=True)
    complete = patterns[:, triples].all(axis=2)
    best = triples[np.argmax(np.where(complete, areas, -1.0), axis=1)][which.ravel()]
    readings = Readings(*(np.take_along_axis(x, best, axis=1) for x in (latest.values, latest.seen)))
    return snapshots.replaced({RANGES: readings}, {"anchors": anchors[best].reshape(len(best), 9)})


def _snapshot_windows(starts: np.ndarray, age: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Of each tag (n,): the shortest of the `WINDOWS`, s, in which half of its times have at least `least` anchors."""
    windows = np.full(len(least), WINDOWS[-1])
    for window in reversed(WINDOWS):
        enough = (age <= window).sum(axis=1) >= np.repeat(least, np.diff(starts))
        windows[np.add.reduceat(enough, starts[:-1], dtype=float) / np.diff(starts) >= 0.5] = window
    return windows


def _lacks_known_height(folder: RecordingFolder) -> str | None:
    """What a folder lacks for trilateration, in words."""
    lacking = lacks_ranges(folder)
    if lacking is not None:
        return lacking
    free = sorted(tag for tag in folder.rows("ranges").tags if known_height(folder, tag) is None)
    return f"height_m in rig.toml for every tag, found none for {', '.join(free)}" if free else None


def _trilateration(compensated: bool) -> Callable[..., TrackerSpec]:
    return partial(
        TrackerSpec,
        trajectories=triple_trajectories,
        build=lambda trajectory, planar: trilateration_tracker(compensated),
        lacks=_lacks_known_height,
        planar=lambda trajectory, free_height: True,
        every_row=(RANGES,),
    )


TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "multilateration": partial(
        TrackerSpec,
        trajectories=snapshot_trajectories,
        build=lambda trajectory, planar: multilateration_tracker(planar),
        lacks=lacks_ranges,
        geometry=anchors_of,
        every_row=(RANGES,),
    ),
    "trilateration": _trilateration(compensated=False),
    "trilateration-compensated": _trilateration(compensated=True),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
