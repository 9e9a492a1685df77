"""The baselines on the command line: trackers of position fixes, and their trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from trackers.baselines.fixes import fix_tracker, singer_tracker
from trackers.baselines.switching import mirror_tracker, switching_tracker
from trackers.baselines.windows import MovingWindow
from trackers.core.recording import Readings
from trackers.parts.fix_rows import fix_trajectories, lacks_fixes
from trackers.parts.fixes import FIXES
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec, on_request
from trackers.recordings.trajectories import Trajectory

FLAT = 0.5
"""Metres between the heights of anchors up to which they count as lying in one plane."""

WINDOW = 9
"""Rows of the moving windows: the paper's choice for its median (Huang et al. 2018, section 4)."""


def side_trajectories(folder: RecordingFolder, free_height: bool) -> Iterator[Trajectory]:
    """Each tag's fixes with the distance from the anchors' plane for z, and the floor's 0.

    Inputs `plane`, its height, and `shown`, the z of the row's fix, m.
    """
    plane = float(np.mean([p[2] for p in folder.rig.anchors.values()]))
    for trajectory in fix_trajectories(folder, free_height=True):
        recording = trajectory.recording
        fixes = recording.readings[FIXES]
        assert fixes.reported is not None
        values = np.column_stack([fixes.values[:, :2], np.abs(fixes.values[:, 2] - plane), np.zeros(len(recording))])
        readings = {FIXES: Readings(values, fixes.seen[:, [0, 1, 2, 2]], fixes.reported)}
        shown = np.where(fixes.seen[:, 2], fixes.values[:, 2], plane)
        inputs = {**recording.inputs, "plane": np.full(len(recording), plane), "shown": shown}
        yield replace(trajectory, recording=replace(recording, readings=readings, inputs=inputs))


def lacks_plane(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker that knows of mirrored heights."""
    heights = [p[2] for p in folder.rig.anchors.values()]
    if len(heights) < 3 or np.ptp(heights) > FLAT:
        found = f"{len(heights)} anchors" + (f" over {np.ptp(heights):.2f} m of height" if heights else "")
        return f"at least 3 anchors within {FLAT} m of one height, found {found}"
    return lacks_fixes(folder)


TRACKERS = {
    "fix-kf": TrackerSpec(
        "position from fixes, Kalman filter, constant velocity over the floor",
        table="fixes",
        trajectories=fix_trajectories,
        build=lambda trajectory, planar: fix_tracker(planar=planar),
        lacks=lacks_fixes,
    ),
    "fix-singer": TrackerSpec(
        "position from fixes, Singer's fading acceleration",
        table="fixes",
        trajectories=fix_trajectories,
        build=lambda trajectory, planar: singer_tracker(planar=planar),
        lacks=lacks_fixes,
        automatic=on_request,
    ),
    "imm": TrackerSpec(
        "position from fixes, interacting constant-velocity models from calm to brisk",
        table="fixes",
        trajectories=fix_trajectories,
        build=lambda trajectory, planar: switching_tracker(planar=planar),
        lacks=lacks_fixes,
        automatic=on_request,
    ),
    "fix-mirror": TrackerSpec(
        "position from fixes that may be mirrored at the plane of the anchors, two branches",
        table="fixes",
        trajectories=side_trajectories,
        build=lambda trajectory, planar: mirror_tracker(),
        lacks=lacks_plane,
        planar=lambda trajectory, free_height: False,
        automatic=on_request,
    ),
    "moving-average": TrackerSpec(
        f"mean of the last {WINDOW} fixes",
        table="fixes",
        trajectories=fix_trajectories,
        build=lambda trajectory, planar: MovingWindow(WINDOW, median=False, planar=planar),
        lacks=lacks_fixes,
        automatic=on_request,
    ),
    "median": TrackerSpec(
        f"median of the last {WINDOW} fixes, axis by axis",
        table="fixes",
        trajectories=fix_trajectories,
        build=lambda trajectory, planar: MovingWindow(WINDOW, median=True, planar=planar),
        lacks=lacks_fixes,
        automatic=on_request,
    ),
}
