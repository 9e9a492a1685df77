"""Trajectories of trackers that read position fixes: one fix per row."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from trackers.core.recording import Readings
from trackers.parts.fixes import FIXES
from trackers.recordings.columns import by_tag, float_column, values_of
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.trajectories import Trajectory, known_height, trajectory_of
from trackers.recordings.truth import truth_by_tag


def fix_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's fixes, one row per table row; z is masked where the tag's height is known and used."""
    paths = truth_by_tag(folder)
    for tag, table in by_tag(folder.tables["fixes"]):
        values, seen = values_of(table, [f"{a}_m" for a in "xyz"])
        if not free_height and known_height(folder, tag) is not None:
            seen[:, 2] = False
        # Zeros where no standard deviations are reported, so that trajectories with and without them share a batch.
        reported = np.nan_to_num(np.stack([float_column(table, f"{a}_std_m") for a in "xyz"], axis=1)) ** 2
        readings = {FIXES: Readings(values, seen, reported)}
        yield trajectory_of(folder, tag, "", table["t_s"].to_numpy(), readings, {}, paths)


def lacks_fixes(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker of fixes, in words: the table, or the height of a tag; None if nothing."""
    if "fixes" not in folder.tables:
        return "a fixes table, found no such table"
    for tag, table in by_tag(folder.tables["fixes"]):
        if table["x_m"].count() and not table["z_m"].count() and known_height(folder, tag) is None:
            return f"z_m of tag {tag!r} in fixes, or its height_m in rig.toml, found neither"
    return None
