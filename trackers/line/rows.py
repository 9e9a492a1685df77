"""System B on the command line: trackers of a tag on a known path, from ranges or fixes, and when it left the line."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator

import numpy as np
import polars as pl

from trackers.baselines.fixes import fix_tracker
from trackers.core.errors import UnusableInput
from trackers.core.recording import Readings, Recording
from trackers.core.sensor import AbstractSensor
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.line.fixes import FIXES, FloorFixes
from trackers.line.leaving import absences
from trackers.line.motion import HaltingMotion, LineMotion
from trackers.line.polyline import Polyline
from trackers.line.tracker import line_grid_tracker, line_motion, line_tracker
from trackers.parts.ranges import RANGES, RangeSensor
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec, on_request
from trackers.recordings.trajectories import Trajectory, by_tag, known_height, trajectory_of, true_paths, values_of
from trackers.recordings.truth import numbers
from trackers.uwb_imu.range_rows import range_trajectories

SIGMA_FIX = 0.3
"""Metres per axis of a fix of unknown origin: the thesis's raw error is 0.39 m over both."""

SIGMA_RANGE, POSITIVE_SKEW, TAIL = 0.1, 3.0, 3.0
"""Metres for ranges too short, three times that for ranges too long: what suits other rooms, without a path, too."""

LEFT_SLACK, LEFT_LIMIT = 1.0, 2.0
"""Metres by which a free estimate may be off, and metre seconds beyond that after which the tag has left the line."""

REDUNDANT, HEARD_S = 4, 2.0
"""Anchors that must be heard within so many seconds: with fewer, a tag away is like a range that is too long."""


CLOSED = 0.05
"""Ends of a path nearer to each other than this part of its longest segment close it: a tag may go round and round."""


def floor_fix_trajectories(folder: RecordingFolder) -> Iterator[Trajectory]:
    """Each tag's fixes, x and y, one row per table row."""
    paths = true_paths(folder)
    for tag, table in by_tag(folder.tables["fixes"]):
        values, seen = values_of(table, ["x_m", "y_m"])
        reported = np.nan_to_num(np.stack([numbers(table, f"{a}_std_m") for a in "xy"], axis=1)) ** 2
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


def left_the_line(trajectory: Trajectory, tracks: pl.DataFrame) -> list[tuple[float, str, str]]:
    """Rows (t_s, event, detail) of when the trajectory's tag left the line and came back, from its constrained estimates.

    `tracks`: the rows of a line tracker for this tag. The free estimate is a Kalman filter on fixes, or the place where
    recent ranges meet.
    """
    times, free = _free_places(trajectory)
    known = tracks.filter(pl.all_horizontal(pl.col("x_m", "y_m").is_finite()))
    if known.is_empty():
        return []
    held = np.stack([np.interp(times, known["t_s"].to_numpy(), numbers(known, f"{a}_m")) for a in "xy"], axis=1)
    apart = np.sqrt(((free - held) ** 2).sum(axis=1))
    rows: list[tuple[float, str, str]] = []
    for start, end, farthest in absences(times, apart, LEFT_SLACK, LEFT_LIMIT):
        rows.append(
            (float(times[start]), "left the line", f"up to {farthest:.2f} m between free and constrained estimate")
        )
        if end < len(times):
            rows.append((float(times[end]), "back on the line", f"after {times[end] - times[start]:.1f} s"))
    return rows


def raw_places(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and places (T, 2), NaN where there is none: fixes as they are, or where recent ranges meet."""
    whole = trajectory.recording
    if RANGES in whole.readings:
        nearby = whole.inputs["nearby"]
        return whole.times, np.where(nearby[:, 3:] > 0.5, nearby[:, :2], np.nan)
    fixes = whole.readings[FIXES]
    return whole.times, np.where(np.all(fixes.seen, axis=1)[:, None], fixes.values, np.nan)


def _free_places(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and places (T, 2) that know nothing of the path, NaN where there is none."""
    whole = trajectory.recording
    if RANGES in whole.readings:
        times, places = raw_places(trajectory)
        return times, np.where(_heard(whole)[:, None] >= REDUNDANT, places, np.nan)
    fixes = whole.readings[FIXES]
    missing = np.zeros((len(whole), 1))
    reported = np.zeros((len(whole), 3)) if fixes.reported is None else np.hstack([fixes.reported, missing])
    readings = {FIXES: Readings(np.hstack([fixes.values, missing]), np.hstack([fixes.seen, missing > 0]), reported)}
    free = fix_tracker(planar=True).run(Recording(whole.times, readings, whole.inputs, name=whole.name))
    places = np.stack([np.asarray(x) for x in free.mean.position], axis=1)
    return whole.times, np.where(free.usable[:, None], places, np.nan)


def _heard(recording: Recording) -> np.ndarray:
    """How many different anchors were heard in the last `HEARD_S` seconds, at each row."""
    times, seen = recording.times, recording.readings[RANGES].seen[:, 0]
    number = recording.inputs["anchor"][:, 0]
    heard = np.zeros(len(times), int)
    for anchor in np.unique(number):
        mine = np.flatnonzero(seen & (number == anchor))
        last = np.searchsorted(mine, np.arange(len(times)), side="right") - 1
        heard += (last >= 0) & (times - times[mine[np.maximum(last, 0)]] <= HEARD_S if len(mine) else False)
    return heard


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
            sensors = {RANGES: RangeSensor(1, len(trajectory.folder.rig.anchors), SIGMA_RANGE, POSITIVE_SKEW, TAIL)}
        return make(motion, sensors)

    return build


TRACKERS = {
    "line-grid": TrackerSpec(
        "position on a known path, by a grid of arclength and speed", "ranges or fixes, and [path]", _lacks,
        line_trajectories, _assembled(line_grid_tracker), _geometry, lambda trajectory, free_height: True,
        automatic=_loses_no_height, events=left_the_line,
    ),
    "line-pf": TrackerSpec(
        "position on a known path, by 1,000 particles (the thesis's)", "ranges or fixes, and [path]", _lacks,
        line_trajectories, _assembled(line_tracker), _geometry, lambda trajectory, free_height: True, automatic=on_request,
        events=left_the_line,
    ),
}  # fmt: skip
