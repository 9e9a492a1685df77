"""Our tracker as a user gets it: chosen for the recording, with default noise levels."""

from __future__ import annotations

from collections.abc import Callable

import polars as pl

from trackwright.experiments.lab.benchmark.problems import NotRead, tracker_of, without_path
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker


def filtered(folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    """A function that returns the estimates of all tags."""
    return _of(tracker_of(folder), folder)


def smoothed(folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    """As `filtered`, of smoothed estimates; raises UnusableInput for a tracker that has no smoother."""
    return _of(tracker_of(folder).smoothing(), folder)


def motion(folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    """As `filtered`, at several levels of motion; raises NotRead where the tracker has no process noise of motion."""
    return _of(_at_levels(tracker_of(folder)), folder)


def motion_smoothed(folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    """As `motion`, of smoothed estimates."""
    return _of(_at_levels(tracker_of(folder)).smoothing(), folder)


def _at_levels(tracker: NamedTracker) -> NamedTracker:
    try:
        return tracker.with_motion_levels()
    except UnusableInput as error:
        raise NotRead(str(error)) from error


def _of(tracker: NamedTracker, folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    return lambda: tracker.run(without_path(folder)).to_polars()
