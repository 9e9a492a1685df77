"""Trajectories of the tracker of several kinds of readings: tables `ranges`, `tdoa`, `bearings` and `fixes`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import equinox as eqx
import numpy as np

from trackwright.trackers.aoa.fusion import BEARINGS
from trackwright.trackers.aoa.rows import TRACKERS as OF_ANGLES
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.model.rig import room_rows
from trackwright.trackers.core.run.track_loss import ROOM
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.fusion.tracker import fused_tracker
from trackwright.trackers.parts.fixes import FIXES, fix_trajectories, lacks_fixes
from trackwright.trackers.parts.joint_positions import joint_positions
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.parts.start_nearby import NEARBY
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import Trajectories, Trajectory, known_heights, trajectories_of
from trackwright.trackers.uwb_imu import difference_rows
from trackwright.trackers.uwb_imu import rows as range_rows
from trackwright.trackers.uwb_imu.fusion import TDOA


def _placed_fixes(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """The rows of fixes, with those that are complete as the input `nearby`."""
    trajectories = fix_trajectories(folder, free_height)
    fixes, heights = trajectories.columns.readings[FIXES], trajectories.columns.of_each(trajectories.heights)
    known = np.isfinite(heights) & (not free_height)
    place = np.column_stack([fixes.values[:, :2], np.where(known, heights, fixes.values[:, 2])])
    complete = fixes.seen[:, :2].all(axis=1) & (fixes.seen[:, 2] | known)
    return trajectories.replaced(
        trajectories.columns.readings,
        {NEARBY.name: np.where(complete[:, None], np.column_stack([place, complete]), 0.0)},
    )


def _tracker_of_fixes(trajectory: Trajectory, planar: bool) -> Tracker:
    tracker = fix_tracker(planar=planar)
    # An unknown latency is considered where it delays the whole estimate, which other kinds keep from here.
    return eqx.tree_at(lambda tracker: tracker.sensors[FIXES].latency_std, tracker, None)


BIASES = 4
"""The numbers of biases of ranges and of differences are multiples of this; with eight four anchors take half again."""

KINDS: Mapping[str, TrackerSpec] = {
    RANGES: range_rows.TRACKERS["uwb"](
        about="", table=RANGES, build=partial(range_rows.tracker_of_ranges, together=BIASES)
    ),
    TDOA: difference_rows.TRACKERS["tdoa"](
        about="", table=TDOA, build=partial(difference_rows.tracker_of_differences, together=BIASES)
    ),
    BEARINGS: OF_ANGLES["bearings"](about="", table=BEARINGS),
    FIXES: TrackerSpec("", FIXES, _placed_fixes, _tracker_of_fixes, lacks=lacks_fixes),
}
"""How the readings of each kind are read and tracked alone; the motion is the first one's."""


def kinds_of(folder: RecordingFolder) -> list[str]:
    """The kinds of readings that a folder has."""
    return [name for name in KINDS if name in folder.tables and len(folder.tables[name])]


def fused_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's readings of all kinds, of one time side by side in a row, as far as their numbers go.

    With the inputs of every kind: in a row without a reading of the kind from the reading before.
    """
    parts = {name: Trajectories.of(KINDS[name].trajectories(folder, free_height)) for name in kinds_of(folder)}
    tags = list(dict.fromkeys(tag for part in parts.values() for tag in part.tags))
    keys = np.concatenate([_keys(part, tags) for part in parts.values()], axis=1)
    order = np.lexsort(keys)
    new = np.append(True, (np.diff(keys[:, order], axis=1) != 0).any(axis=0))
    row = np.empty(len(order), int)
    row[order] = np.cumsum(new) - 1
    (_, times, tag), count = keys[:, order[new]], int(new.sum())
    starts = np.searchsorted(tag, np.arange(len(tags) + 1))
    readings, inputs, nearby, first = dict[str, Readings](), dict[str, np.ndarray](), np.zeros((count, 4)), 0
    for name, part in parts.items():
        size = len(part.columns.times)
        here = np.full(count, -1)
        here[row[first : first + size]] = np.arange(size)
        first, has = first + size, (here >= 0)[:, None]
        last, own = _latest(here, starts), part.columns.readings[name]
        assert own.reported is not None
        readings[name] = Readings(own.values[last] * has, own.seen[last] & has, own.reported[last] * has)
        given = dict(part.columns.inputs)
        nearby = np.where((nearby[:, 3:] == 0) & has, given.pop(NEARBY.name)[last], nearby)
        inputs |= {key: x[last] for key, x in given.items()}
    rig = folder.rig
    heights = np.full(len(tags), np.nan) if free_height else known_heights(folder, tags)
    inputs[ROOM.name] = room_rows(np.stack(rig.places()), rig.outline, count)
    inputs[NEARBY.name] = joint_positions(folder, list(parts), tags, starts, times, heights, nearby)
    return trajectories_of(folder, tags, starts, times, readings, inputs)


def _keys(part: Trajectories, tags: list[str]) -> np.ndarray:
    """Of each row (3, N): its number among the rows of its tag and time, its time, and the number of its tag."""
    columns = part.columns
    numbers = {tag: number for number, tag in enumerate(tags)}
    tag = columns.of_each(np.array([numbers[name] for name in part.tags]))
    begins = np.append(True, (np.diff(columns.times) != 0) | (np.diff(tag) != 0))
    at = np.arange(len(tag))
    return np.stack([at - np.maximum.accumulate(np.where(begins, at, 0)), columns.times, tag])


def _latest(here: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The last of the rows `here` (N,), −1 for none, up to each row of its tag, or else the tag's first one."""
    has = here >= 0
    before = np.repeat(np.append(0, np.cumsum(has))[starts[:-1]], np.diff(starts))
    return here[has][np.clip(np.cumsum(has) - 1, before, has.sum() - 1)]


def lacks_two_kinds(folder: RecordingFolder) -> str | None:
    """What a folder lacks for the tracker of several kinds of readings, in words; None if nothing."""
    kinds = kinds_of(folder)
    if len(kinds) < 2:
        found = f"the table {kinds[0]} alone" if kinds else "none of them"
        return f"two of the tables {', '.join(KINDS)}, found {found}"
    missing = [KINDS[name].missing(folder) for name in kinds]
    return None if None in missing else missing[0]


def _fused(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    trackers = dict[str, Tracker]()
    for name in trajectory.recording.readings:
        tracker = KINDS[name].build(trajectory, planar)
        assert isinstance(tracker, Tracker)
        trackers[name] = tracker
    return fused_tracker(trackers, planar)


TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "fusion": partial(
        TrackerSpec,
        trajectories=fused_trajectories,
        build=_fused,
        lacks=lacks_two_kinds,
        geometry=lambda one: tuple((name, KINDS[name].geometry(one)) for name in one.recording.readings),
        # A system may have computed fixes from the other kinds.
        automatic=lambda folder: FIXES not in folder.tables and len(kinds_of(folder)) > 1,
        every_row=(BEARINGS,),
    )
}
"""How the tracker is built; `trackers.catalogue` has its table and its line in lists."""
