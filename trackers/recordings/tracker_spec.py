"""What the command line knows of a tracker: its name's entry, and the trajectories that one tracker runs together."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

from trackers.core.tracker import AbstractTracker
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.trajectories import Trajectory, known_height


@dataclass(frozen=True)
class TrackerBatch:
    """Trajectories that one tracker runs as a batch; `planar`: in the floor plane at known heights, or in an array's plane."""

    tracker: AbstractTracker
    trajectories: list[Trajectory]
    planar: bool


def at_known_height(trajectory: Trajectory, free_height: bool) -> bool:
    """Whether a tag's height is known and to be used, so that it is tracked over the floor alone."""
    return not free_height and known_height(trajectory.folder, trajectory.tag) is not None


def on_request(folder: RecordingFolder) -> bool:
    """Never: such a tracker is taken only where it is named."""
    return False


@dataclass(frozen=True)
class TrackerSpec:
    """A tracker by name.

    `table`: what it reads. `lacks`: what a folder lacks for it, in words, or None where it fits. `trajectories`: the trajectories of
    a folder; the flag is --free-height. `build`: the tracker of a trajectory; the flag is `planar` of that trajectory. `geometry`:
    what of a trajectory is part of its tracker; trajectories that agree in it, and in `planar`, share one. `automatic`: whether it
    is taken for a folder that it fits where no tracker is named. `bearing_only`: whether it estimates directions.
    `on_path`: whether its estimates lie on the rig's known path, so that leaving the path is an event.
    """

    about: str
    table: str
    lacks: Callable[[RecordingFolder], str | None]
    trajectories: Callable[[RecordingFolder, bool], Iterator[Trajectory]]
    build: Callable[[Trajectory, bool], AbstractTracker]
    geometry: Callable[[Trajectory], Hashable] = lambda trajectory: ()
    planar: Callable[[Trajectory, bool], bool] = at_known_height
    automatic: Callable[[RecordingFolder], bool] = lambda folder: True
    bearing_only: bool = False
    on_path: bool = False
