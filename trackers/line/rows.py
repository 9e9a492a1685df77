"""Trajectories of trackers on a known path, and how each is built: table `ranges` or `fixes`, and `[path]`."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.line.tracker import FloorFixes, line_grid_tracker, line_motion, line_tracker
from trackwright.trackers.line.truth import KnotTimes, knot_times
from trackwright.trackers.parts.fixes import AXES_M, AXES_STD_M, FIXES
from trackwright.trackers.parts.ranges import RANGES, RangeSensor, range_trajectories
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import (
    Trajectories,
    Trajectory,
    known_height,
    known_heights,
    trajectories_of,
)

SIGMA_FIX = 0.3  # standard deviation of a fix per axis, m; the raw error in the thesis is 0.39 m over both axes
# Scale, m, skew and degrees of freedom of range errors at sites with and without a calibration. Where no calibration
# has taken it, obstruction makes an anchor's ranges too long by decimetres for as long as the tag stays at a place. A
# skew that takes all these ranges for independent has to be wide.
CALIBRATED, OBSTRUCTED = (0.1, 3.0, 3.0), (0.06, 10.0, 4.0)

CLOSING_GAP = 0.05  # largest gap between the ends of a closed path, as a fraction of its longest segment


def path_of(folder: RecordingFolder) -> Polyline:
    """The folder's known path, closed if its ends nearly meet; raises UnusableInput if there is none."""
    if folder.rig.path_knots is None:
        raise UnusableInput(f"{folder.path}: no [path] in rig.toml, expected its knots_m = [[x, y], …]; add them")
    knots = np.asarray(folder.rig.path_knots, float)
    gap = float(np.linalg.norm(knots[-1] - knots[0]))
    if 0.0 < gap <= CLOSING_GAP * np.linalg.norm(np.diff(knots, axis=0), axis=1).max():
        knots = np.vstack([knots, knots[:1]])
    return Polyline(knots)


def planar_fix_trajectories(folder: RecordingFolder) -> Trajectories:
    """Each tag's fixes in x and y, one row per table row."""
    rows = folder.rows("fixes")
    values, seen = rows.values(AXES_M[:2])
    readings = {FIXES: Readings(values, seen, rows.variances(AXES_STD_M[:2]))}
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, readings, {})


def line_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's ranges if the rig has all heights, else its fixes."""
    return range_trajectories(folder, False) if _reads_ranges(folder) else planar_fix_trajectories(folder)


def raw_positions(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) s and unfiltered positions (T, 2) m, NaN if missing: fixes, or the input `nearby` of ranges."""
    recording = trajectory.recording
    if RANGES in recording.readings:
        nearby = recording.inputs["nearby"]
        return recording.times, np.where(nearby[:, 3:] > 0.5, nearby[:, :2], np.nan)
    fixes = recording.readings[FIXES]
    return recording.times, np.where(np.all(fixes.seen, axis=1)[:, None], fixes.values, np.nan)


def fit_path_truth(folder: RecordingFolder) -> tuple[RecordingFolder, dict[str, KnotTimes]]:
    """The recording with a truth table fitted along its known path by least squares, and the knot times of each tag.

    Every tag travels once from the first to the last knot, at a constant speed on each segment, with rests at the
    knots. Raises UnusableInput for a rig without a path, without fixes or ranges, and for too short a recording.
    """
    path_of(folder)
    where = folder.path or folder.name
    if not {"fixes", "ranges"} & set(folder.tables):
        raise UnusableInput(
            f"{where}: tables {', '.join(folder.tables)}, expected fixes or ranges to fit a truth to; add one"
        )
    tables, fitted = [], {}
    for trajectory in line_trajectories(folder, False):
        times, measured = raw_positions(trajectory)
        known = np.isfinite(measured).all(axis=1)
        try:
            knots = knot_times(np.asarray(folder.rig.path_knots), times[known], measured[known])
        except ValueError as problem:
            raise UnusableInput(f"{where}: tag '{trajectory.tag}': {problem}; record for longer") from problem
        fitted[trajectory.tag] = knots
        # Rows at the knot times, too: interpolation between measurement times would cut the corners of the path.
        at = np.unique(np.concatenate([times, knots.departed, knots.arrived]))
        x, y = knots.positions(at).T
        height = pl.lit(known_height(folder, trajectory.tag), pl.Float64)
        tables.append(
            pl.DataFrame({"t_s": at, "tag": [trajectory.tag] * len(at), "x_m": x, "y_m": y}).with_columns(z_m=height)
        )
    truth = pl.concat(tables).sort("t_s", maintain_order=True)
    return replace(folder, path=None, tables={**folder.tables, "truth": truth}, notices=()), fitted


def _reads_ranges(folder: RecordingFolder) -> bool:
    return "ranges" in folder.tables and bool(np.isfinite(known_heights(folder, folder.rows("ranges").tags)).all())


def _lacks(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker on a known path, in words; None if nothing."""
    if folder.rig.path_knots is None:
        return "a known path, [path] with knots_m in rig.toml, found none"
    if _reads_ranges(folder) or "fixes" in folder.tables:
        return None
    if "ranges" in folder.tables:
        return "height_m of every tag in rig.toml to read ranges, or a fixes table, found neither"
    return "a ranges or fixes table, found none"


def _no_height_to_estimate(folder: RecordingFolder) -> bool:
    """Whether all heights are known or not measured, so that a planar estimate loses nothing."""
    if _reads_ranges(folder):
        return True
    rows = folder.rows("fixes")
    no_height = rows.of_each(np.isnan(known_heights(folder, rows.tags)))
    return not (no_height & np.isfinite(rows.floats(["z_m"])[:, 0])).any()


def _geometry(trajectory: Trajectory) -> Hashable:
    return (
        np.asarray(trajectory.folder.rig.path_knots).tobytes(),
        *trajectory.recording.readings,
        len(trajectory.folder.rig.anchors) if RANGES in trajectory.recording.readings else 0,
        _calibrated(trajectory),
    )


def _calibrated(trajectory: Trajectory) -> bool:
    calibration = trajectory.folder.calibration
    return calibration is not None and bool(calibration.anchors)


def _builder(make: Callable[..., Tracker]) -> Callable[[Trajectory, bool], AbstractTracker]:
    def build(trajectory: Trajectory, planar: bool) -> AbstractTracker:
        line, anchors = path_of(trajectory.folder), len(trajectory.folder.rig.anchors)
        if RANGES not in trajectory.recording.readings:
            return make(line_motion(line), {FIXES: FloorFixes(SIGMA_FIX)})
        if _calibrated(trajectory):
            return make(line_motion(line), {RANGES: RangeSensor(1, anchors, *CALIBRATED)})
        # A speed that never falls would carry a tag at rest on along ranges that are too long.
        return make(line_motion(line, anywhere=True), {RANGES: RangeSensor(1, anchors, *OBSTRUCTED)})

    return build


_on_path = partial(
    TrackerSpec,
    trajectories=line_trajectories,
    lacks=_lacks,
    geometry=_geometry,
    planar=lambda trajectory, free_height: True,
    automatic=_no_height_to_estimate,
)

TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "line-grid": partial(_on_path, build=_builder(line_grid_tracker)),
    "line-pf": partial(_on_path, build=_builder(line_tracker)),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
