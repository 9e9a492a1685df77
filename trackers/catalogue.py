"""The trackers that the command line knows, by name, and the groups of trajectories that they run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence

from trackers.aoa import rows as aoa
from trackers.baselines import floor_rows as floor
from trackers.baselines import rows as baselines
from trackers.core.errors import UnusableInput
from trackers.line import rows as line
from trackers.mhk import rows as mhk
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch, TrackerSpec
from trackers.recordings.trajectories import Trajectory
from trackers.uwb_imu import inertial_rows as uwb_imu
from trackers.uwb_imu import range_rows as uwb

TRACKERS: dict[str, TrackerSpec] = {
    **aoa.TRACKERS,
    **line.TRACKERS,
    **uwb_imu.TRACKERS,
    **uwb.TRACKERS,
    **floor.TRACKERS,
    **baselines.TRACKERS,
    **mhk.TRACKERS,
}
"""In the order in which they are tried where none is named."""


def fitting(folder: RecordingFolder) -> str:
    """The name of the tracker that fits the folder's tables; raises UnusableInput where none does."""
    for name, entry in TRACKERS.items():
        if entry.lacks(folder) is None and entry.automatic(folder):
            return name
    needs = ", ".join(sorted({e.table for e in TRACKERS.values()}))
    raise UnusableInput(
        f"{folder.path}: tables {', '.join(folder.tables)}: no tracker fits; expected one of {needs} "
        "with its geometry in rig.toml; see `trackwright track --help`"
    )


def groups(folders: Sequence[RecordingFolder], name: str, free_height: bool) -> list[TrackerBatch]:
    """The trajectories of all folders for the named tracker, batched where one tracker serves them; raises UnusableInput."""
    entry = TRACKERS.get(name)
    if entry is None:
        raise UnusableInput(f"--tracker {name}: unknown; expected one of {', '.join(TRACKERS)}")
    return grouped(folders, entry, name, free_height)


def grouped(folders: Sequence[RecordingFolder], entry: TrackerSpec, name: str, free_height: bool) -> list[TrackerBatch]:
    """The trajectories of all folders for a tracker's entry, batched where one tracker serves them; raises UnusableInput."""
    batches: dict[tuple[bool, Hashable], list[Trajectory]] = defaultdict(list)
    for folder in folders:
        lacking = entry.lacks(folder)
        if lacking is not None:
            raise UnusableInput(
                f"{folder.path or folder.name}: tracker '{name}' needs {lacking}; its tables: "
                f"{', '.join(folder.tables)}"
            )
        for trajectory in entry.trajectories(folder, free_height):
            batches[entry.planar(trajectory, free_height), entry.geometry(trajectory)].append(trajectory)
    return [
        TrackerBatch(entry.build(trajectories[0], planar), trajectories, planar)
        for (planar, _), trajectories in batches.items()
    ]
