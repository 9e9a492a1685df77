"""Trajectories of ranges, one a row, and how their tracker is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.ranges import anchor_positions, lacks_anchors, range_places, range_trajectories
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import Trajectory
from trackwright.trackers.uwb_imu.fusion import range_levels, range_tracker

MAX_RANGE_RATIO = 20.0  # largest plausible median range, as a multiple of the anchors' extent


def lacks_ranges(folder: RecordingFolder, rows: TagRows | None = None) -> str | None:
    """What a folder lacks for a tracker of ranges, in words: enough anchors, not collinear, and ranges in metres.

    `rows`: the ranges of each trajectory, by default of each tag.
    """
    if "ranges" not in folder.tables:
        return "a ranges table with at least 3 anchors, found no such table"
    rows, ids = folder.rows("ranges") if rows is None else rows, sorted(folder.rig.anchors)
    ranges = rows.floats(["range_m"])[:, 0]
    positive, number = ranges > 0, rows.codes("anchor", ids)
    if lacking := lacks_anchors(folder, rows, positive, number[:, None], 3, "positive ranges from a tag to"):
        return lacking
    extent = float(np.ptp(anchor_positions(folder)[np.unique(number[positive])], axis=0).max())
    median = float(np.median(ranges[positive]))
    if median > MAX_RANGE_RATIO * extent:
        return (
            f"ranges in metres, found a median of {median:.4g} among anchors {extent:.4g} m apart; "
            "are they in centimetres or millimetres?"
        )
    return None


def anchors_of(trajectory: Trajectory) -> int:
    """The number of anchors of a trajectory's installation."""
    return len(trajectory.folder.rig.anchors)


def bias_slots(trajectory: Trajectory, together: int = 8) -> int:
    """The number of biases of anchors in a state: a multiple of `together`, so that installations share a program."""
    return -(-anchors_of(trajectory) // together) * together


def tracker_of_ranges(trajectory: Trajectory, planar: bool, together: int = 8) -> Tracker:
    """The tracker of a trajectory's ranges, with `bias_slots`."""
    levels = range_levels(trajectory.folder.calibration)
    return replace(range_tracker(bias_slots(trajectory, together), planar, **levels), lasting_errors=not levels)


TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "uwb": partial(
        TrackerSpec,
        trajectories=range_trajectories,
        build=tracker_of_ranges,
        lacks=lacks_ranges,
        geometry=lambda trajectory: (bias_slots(trajectory), *range_levels(trajectory.folder.calibration).values()),
        places=range_places,
    )
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
