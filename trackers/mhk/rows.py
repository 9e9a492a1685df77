"""Trajectories of MH-K, and how it is built: table `fixes`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.mhk.tracker import mhk_tracker
from trackwright.trackers.parts.fixes import FIXES, fix_trajectories, lacks_fixes
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import TrackerSpec
from trackwright.trackers.recordings.tracks import Trajectories


def spatial_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's fixes in three dimensions, one row per table row; a known height replaces z where x and y are seen."""
    trajectories = fix_trajectories(folder, free_height=True)
    if free_height or np.isnan(trajectories.heights).all():
        return trajectories
    fixes, heights = trajectories.columns.readings[FIXES], trajectories.columns.of_each(trajectories.heights)
    known = np.isfinite(heights)
    values, seen = fixes.values.copy(), fixes.seen.copy()
    values[:, 2] = np.where(known, heights, values[:, 2])
    seen[:, 2] = np.where(known, seen[:, 0] & seen[:, 1], seen[:, 2])
    return trajectories.replaced({FIXES: Readings(values, seen, fixes.reported)})


_mhk = partial(
    TrackerSpec,
    trajectories=spatial_trajectories,
    lacks=lacks_fixes,
    planar=lambda trajectory, free_height: False,
    every_row=(FIXES,),
)

TRACKERS: Mapping[str, Callable[..., TrackerSpec]] = {
    "mhk": partial(_mhk, build=lambda trajectory, planar: mhk_tracker()),
    "mhk-stamped": partial(_mhk, build=lambda trajectory, planar: mhk_tracker(stamped=True)),
}
"""How each tracker is built; `trackers.catalogue` has its table and its line in lists."""
