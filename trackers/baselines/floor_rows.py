"""A floor with walls on the command line: fixes by particles that walls kill."""

from __future__ import annotations

from collections.abc import Hashable, Iterator

import numpy as np

from trackers.baselines.floor import floor_tracker
from trackers.baselines.rows import fix_lanes
from trackers.core.errors import UnusableInput
from trackers.core.tracker import AbstractTracker
from trackers.parts.fixes import FIXES
from trackers.parts.walls import Walls
from trackers.recordings.folder import Folder
from trackers.recordings.tracker_spec import Entry
from trackers.recordings.trajectories import Lane


def flat_lanes(folder: Folder, free_height: bool) -> Iterator[Lane]:
    """Each tag's fixes, x and y alone: one row per table row."""
    walls_of(folder)
    for lane in fix_lanes(folder, free_height):
        lane.recording.readings[FIXES].seen[:, 2] = False
        yield lane


def walls_of(folder: Folder) -> Walls:
    """The folder's floor plan; raises UnusableInput where it has none or it is none."""
    rig = folder.rig
    if rig.walls is None and rig.outline is None:
        raise UnusableInput(
            f"{folder.path}: no [floor] in rig.toml, expected its walls_m = [[x1, y1, x2, y2], …]; add them"
        )
    try:
        return Walls(() if rig.walls is None else rig.walls, () if rig.outline is None else rig.outline)
    except ValueError as problem:
        raise UnusableInput(f"{folder.path}: rig.toml, [floor]: {problem}") from problem


def _lacks(folder: Folder) -> str | None:
    """What a folder lacks for a tracker between walls."""
    if folder.rig.walls is None and folder.rig.outline is None:
        return "a floor plan, [floor] with walls_m or outline_m in rig.toml, found none"
    return None if "fixes" in folder.tables else "a fixes table, found no such table"


def _geometry(lane: Lane) -> Hashable:
    walls = walls_of(lane.folder)
    return np.asarray(walls.segments).tobytes(), np.asarray(walls.outline).tobytes()


def _build(lane: Lane, planar: bool) -> AbstractTracker:
    return floor_tracker(walls_of(lane.folder))


TRACKERS = {
    "floor-pf": Entry(
        "position from fixes on a floor with walls, by 1,000 particles", "fixes, and [floor]", _lacks,
        flat_lanes, _build, _geometry, lambda lane, free_height: True,
    ),
}  # fmt: skip
"""Taken before the Kalman filter on fixes where the rig has a floor plan."""
