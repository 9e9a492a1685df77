"""A floor with walls on the command line: fixes by particles that walls kill."""

from __future__ import annotations

from collections.abc import Hashable, Iterator

import numpy as np

from trackers.baselines.floor import floor_tracker
from trackers.core.errors import UnusableInput
from trackers.core.tracker import AbstractTracker
from trackers.parts.fix_rows import fix_trajectories
from trackers.parts.fixes import FIXES
from trackers.parts.walls import Walls
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec
from trackers.recordings.trajectories import Trajectory


def flat_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's fixes, x and y alone: one row per table row."""
    walls_of(folder)
    for trajectory in fix_trajectories(folder, free_height):
        trajectory.recording.readings[FIXES].seen[:, 2] = False
        yield trajectory


def walls_of(folder: RecordingFolder) -> Walls:
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


def _lacks(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker between walls."""
    if folder.rig.walls is None and folder.rig.outline is None:
        return "a floor plan, [floor] with walls_m or outline_m in rig.toml, found none"
    return None if "fixes" in folder.tables else "a fixes table, found no such table"


def _geometry(trajectory: Trajectory) -> Hashable:
    walls = walls_of(trajectory.folder)
    return np.asarray(walls.segments).tobytes(), np.asarray(walls.outline).tobytes()


def _build(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    return floor_tracker(walls_of(trajectory.folder))


TRACKERS = {
    "floor-pf": TrackerSpec(
        "position from fixes on a floor with walls, by 1,000 particles",
        table="fixes, and [floor]",
        trajectories=flat_trajectories,
        build=_build,
        lacks=_lacks,
        geometry=_geometry,
        planar=lambda trajectory, free_height: True,
    ),
}
"""Taken before the Kalman filter on fixes where the rig has a floor plan."""
