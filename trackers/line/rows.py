"""System B on the command line: trackers of a tag on a known path, from ranges or fixes, and when it left the line."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator

import numpy as np
import polars as pl

from trackers.core.errors import UnusableInput
from trackers.core.polyline import Polyline
from trackers.core.recording import Readings
from trackers.core.sensor import AbstractSensor
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.line.fixes import FIXES, FloorFixes
from trackers.line.motion import HaltingMotion, LineMotion
from trackers.line.tracker import line_grid_tracker, line_motion, line_tracker
from trackers.parts.range_rows import range_trajectories
from trackers.parts.ranges import RANGES, RangeSensor
from trackers.recordings.columns import by_tag, float_column, values_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec, on_request
from trackers.recordings.trajectories import Trajectory, known_height, trajectory_of
from trackers.recordings.truth import truth_by_tag

SIGMA_FIX = 0.3
"""Metres per axis of a fix of unknown origin: the thesis's raw error is 0.39 m over both."""

SIGMA_RANGE, POSITIVE_SKEW, DOF = 0.1, 3.0, 3.0
"""Metres for ranges too short, three times that for ranges too long: what suits other rooms, without a path, too."""


CLOSED = 0.05
"""Ends of a path nearer to each other than this part of its longest segment close it: a tag may go round and round."""


def floor_fix_trajectories(folder: RecordingFolder) -> Iterator[Trajectory]:
    """Each tag's fixes, x and y, one row per table row."""
    paths = truth_by_tag(folder)
    for tag, table in by_tag(folder.tables["fixes"]):
        values, seen = values_of(table, ["x_m", "y_m"])
        reported = np.nan_to_num(np.stack([float_column(table, f"{a}_std_m") for a in "xy"], axis=1)) ** 2
        yield trajectory_of(
            folder, tag, "", table["t_s"].to_numpy(), {FIXES: Readings(values, seen, reported)}, {}, paths
        )


def line_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's ranges where the folder has some and the tags' heights, else their fixes; raises UnusableInput."""
    path_of(folder)
    return range_trajectories(folder, False) if _reads_ranges(folder) else floor_fix_trajectories(folder)


def path_of(folder: RecordingFolder) -> Polyline:
    """The folder's known path, closed where its ends nearly meet; raises UnusableInput where there is none."""
    if folder.rig.path_knots is None:
        raise UnusableInput(f"{folder.path}: no [path] in rig.toml, expected its knots_m = [[x, y], …]; add them")
    knots = np.asarray(folder.rig.path_knots, float)
    gap = float(np.linalg.norm(knots[-1] - knots[0]))
    if 0.0 < gap <= CLOSED * np.linalg.norm(np.diff(knots, axis=0), axis=1).max():
        knots = np.vstack([knots, knots[:1]])
    return Polyline(knots)


def raw_places(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and places (T, 2), NaN where there is none: fixes as they are, or where recent ranges meet."""
    whole = trajectory.recording
    if RANGES in whole.readings:
        nearby = whole.inputs["nearby"]
        return whole.times, np.where(nearby[:, 3:] > 0.5, nearby[:, :2], np.nan)
    fixes = whole.readings[FIXES]
    return whole.times, np.where(np.all(fixes.seen, axis=1)[:, None], fixes.values, np.nan)


def _reads_ranges(folder: RecordingFolder) -> bool:
    return "ranges" in folder.tables and all(
        known_height(folder, str(tag)) is not None for tag in folder.tables["ranges"]["tag"].unique()
    )


def _lacks(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker on a line."""
    if folder.rig.path_knots is None:
        return "a known path, [path] with knots_m in rig.toml, found none"
    if _reads_ranges(folder) or "fixes" in folder.tables:
        return None
    if "ranges" in folder.tables:
        return "height_m of every tag in rig.toml to read ranges, or a fixes table, found neither"
    return "a ranges or fixes table, found none"


def _loses_no_height(folder: RecordingFolder) -> bool:
    """Whether a place on the floor is all there is to know: no fix tells of a height that the rig does not give."""
    if _reads_ranges(folder):
        return True
    tags = folder.tables["fixes"].filter(pl.col("z_m").is_not_null())["tag"].unique()
    return all(known_height(folder, str(tag)) is not None for tag in tags)


def _geometry(trajectory: Trajectory) -> Hashable:
    return (
        np.asarray(trajectory.folder.rig.path_knots).tobytes(),
        *trajectory.recording.readings,
        len(trajectory.folder.rig.anchors) if RANGES in trajectory.recording.readings else 0,
    )


def _assembled(make: Callable[..., Tracker]) -> Callable[[Trajectory, bool], AbstractTracker]:
    def build(trajectory: Trajectory, planar: bool) -> AbstractTracker:
        motion: LineMotion | HaltingMotion = line_motion(path_of(trajectory.folder))
        sensors: dict[str, AbstractSensor] = {FIXES: FloorFixes(SIGMA_FIX)}
        if RANGES in trajectory.recording.readings:
            sensors = {RANGES: RangeSensor(1, len(trajectory.folder.rig.anchors), SIGMA_RANGE, POSITIVE_SKEW, DOF)}
        return make(motion, sensors)

    return build


TRACKERS = {
    "line-grid": TrackerSpec(
        "position on a known path, by a grid of arclength and speed",
        table="ranges or fixes, and [path]",
        trajectories=line_trajectories,
        build=_assembled(line_grid_tracker),
        lacks=_lacks,
        geometry=_geometry,
        planar=lambda trajectory, free_height: True,
        automatic=_loses_no_height,
        on_path=True,
    ),
    "line-pf": TrackerSpec(
        "position on a known path, by 1,000 particles (the thesis's)",
        table="ranges or fixes, and [path]",
        trajectories=line_trajectories,
        build=_assembled(line_tracker),
        lacks=_lacks,
        geometry=_geometry,
        planar=lambda trajectory, free_height: True,
        automatic=on_request,
        on_path=True,
    ),
}
