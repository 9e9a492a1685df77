"""Trajectories of the baselines, and how each is built: table `fixes`, and the floor plan in `rig.toml`."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from trackwright.trackers.baselines.fixes import MovingWindow, fix_tracker, singer_tracker
from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.parts.fixes import FIXES, fix_trajectories, lacks_fixes
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import Trajectories, Trajectory

# The trackers beside fix-kf, which most recordings get, are imported where one is built.
if TYPE_CHECKING:
    from trackwright.trackers.baselines.floor import Walls

COPLANAR = 0.5  # largest difference between the heights of anchors that count as coplanar, m
# Standard deviation about zero, s, of a latency of fixes that nobody measured: as of delays from 0 to 0.35 s. Of
# positions that another system computes, autopilots allow for 0 to 0.25 s (ArduPilot, `EK3_BCN_DELAY`) or 0 to 0.3 s
# (PX4, `EKF2_GPS_DELAY`, by default 0.11 s). A maker's manual (Marvelmind, 9.4) has 0.01 to 0.15 s, 2 s with
# averaging.
LATENCY_STD = 0.2

WINDOW = 9  # rows of the moving windows, as in the paper's median (Huang et al. 2018, section 4)


def mirror_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's fixes for `MirrorSensor`: x, y, the distance of z from the anchors' plane, and 0 for the floor.

    Inputs: `plane`, its height, m, and `fix_z`, the z of the row's fix, m.
    """
    plane = float(np.mean([p[2] for p in folder.rig.anchors.values()]))
    trajectories = fix_trajectories(folder, free_height=True)
    fixes = trajectories.columns.readings[FIXES]
    values = np.column_stack([fixes.values[:, :2], np.abs(fixes.values[:, 2] - plane), np.zeros(len(fixes.values))])
    readings = {FIXES: Readings(values, fixes.seen[:, [0, 1, 2, 2]], fixes.reported)}
    fix_z = np.where(fixes.seen[:, 2], fixes.values[:, 2], plane)
    return trajectories.replaced(readings, {"plane": np.full(len(fix_z), plane), "fix_z": fix_z})


def lacks_coplanar_anchors(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker of mirrored heights, in words; None if nothing."""
    heights = [p[2] for p in folder.rig.anchors.values()]
    if len(heights) < 3 or np.ptp(heights) > COPLANAR:
        anchors = f"{len(heights)} anchors" + (f" over {np.ptp(heights):.2f} m of height" if heights else "")
        return f"at least 3 anchors within {COPLANAR} m of one height, found {anchors}"
    return lacks_fixes(folder)


def floor_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's fixes with z masked, one row per table row."""
    trajectories = fix_trajectories(folder, free_height)
    fixes = trajectories.columns.readings[FIXES]
    return trajectories.replaced({FIXES: Readings(fixes.values, fixes.seen & [True, True, False], fixes.reported)})


def walls_of(folder: RecordingFolder) -> Walls:
    """The folder's floor plan; raises UnusableInput if it is invalid."""
    from trackwright.trackers.baselines.floor import Walls

    rig = folder.rig
    try:
        return Walls(() if rig.walls is None else rig.walls, () if rig.outline is None else rig.outline)
    except ValueError as problem:
        raise UnusableInput(f"{folder.path}: rig.toml, [floor]: {problem}") from problem


def lacks_floor_plan(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker with walls, in words; None if nothing."""
    if folder.rig.walls is None and folder.rig.outline is None:
        return "a floor plan, [floor] with walls_m or outline_m in rig.toml, found none"
    return None if "fixes" in folder.tables else "a fixes table, found no such table"


def _floor_geometry(trajectory: Trajectory) -> Hashable:
    walls = walls_of(trajectory.folder)
    return np.asarray(walls.segments).tobytes(), np.asarray(walls.outline).tobytes()


def _floor(trajectory: Trajectory, planar: bool) -> Tracker:
    from trackwright.trackers.baselines.floor import floor_tracker

    return floor_tracker(walls_of(trajectory.folder))


def _switching(trajectory: Trajectory, planar: bool) -> Tracker:
    from trackwright.trackers.baselines.switching import switching_tracker

    return switching_tracker(planar=planar)


def _mirror(trajectory: Trajectory, planar: bool) -> Tracker:
    from trackwright.trackers.baselines.switching import mirror_tracker

    return replace(mirror_tracker(), lasting_errors=True)


def _unknown_latency(build: Callable[[Trajectory, bool], Tracker]) -> Callable[[Trajectory, bool], AbstractTracker]:
    return lambda trajectory, planar: build(trajectory, planar).with_values(
        {f"sensors.{FIXES}.latency_std": LATENCY_STD}
    )


_of_fixes = partial(TrackerSpec, lacks=lacks_fixes, trajectories=fix_trajectories)
_window = partial(_of_fixes, every_row=(FIXES,))

TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "floor-pf": partial(
        TrackerSpec,
        lacks=lacks_floor_plan,
        trajectories=floor_trajectories,
        build=_unknown_latency(_floor),
        geometry=_floor_geometry,
        planar=lambda trajectory, free_height: True,
    ),
    "fix-kf": partial(_of_fixes, build=_unknown_latency(lambda trajectory, planar: fix_tracker(planar=planar))),
    "fix-singer": partial(_of_fixes, build=_unknown_latency(lambda trajectory, planar: singer_tracker(planar=planar))),
    "imm": partial(_of_fixes, build=_unknown_latency(_switching)),
    "fix-mirror": partial(
        TrackerSpec,
        lacks=lacks_coplanar_anchors,
        trajectories=mirror_trajectories,
        build=_unknown_latency(_mirror),
        planar=lambda trajectory, free_height: False,
    ),
    "moving-average": partial(_window, build=lambda trajectory, planar: MovingWindow(WINDOW, False, planar)),
    "median": partial(_window, build=lambda trajectory, planar: MovingWindow(WINDOW, True, planar)),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
