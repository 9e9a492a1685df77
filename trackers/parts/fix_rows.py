"""Trajectories of trackers that read position fixes: one fix per row."""

from __future__ import annotations

import numpy as np

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.recordings.checks.geometry import without_height
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.trajectories import Trajectories, known_heights, trajectories_of

AXES_M, AXES_STD_M = ([f"{axis}_{what}" for axis in "xyz"] for what in ("m", "std_m"))


def fix_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's fixes, one row per table row; z is masked where the tag's height is known and used."""
    rows = folder.rows("fixes")
    values, seen = rows.values(AXES_M)
    if not free_height:
        seen[:, 2] &= rows.of_each(np.isnan(known_heights(folder, rows.tags)))
    # Zeros where no standard deviations are reported, so that trajectories with and without them share a batch.
    readings = {FIXES: Readings(values, seen, rows.variances(AXES_STD_M))}
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, readings, {})


def lacks_fixes(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker of fixes, in words: the table, or the height of a tag; None if nothing."""
    if "fixes" not in folder.tables:
        return "a fixes table, found no such table"
    lacking = without_height(folder.rig, folder.rows("fixes"))
    return f"z_m of tag {lacking[0]!r} in fixes, or its height_m in rig.toml, found neither" if lacking else None
