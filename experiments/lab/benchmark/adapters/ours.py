"""Our tracker as a user gets it: chosen for the recording, with default noise levels."""

from __future__ import annotations

from collections.abc import Callable

import polars as pl

from trackwright.experiments.lab.benchmark.problems import tracker_of, without_path
from trackwright.trackers.recordings.folder import RecordingFolder


def filtered(folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    """A function that returns the estimates of all tags."""
    tracker = tracker_of(folder)
    return lambda: tracker.run(without_path(folder)).to_polars()


def smoothed(folder: RecordingFolder) -> Callable[[], pl.DataFrame]:
    """As `filtered`, of smoothed estimates; raises UnusableInput for a tracker that has no smoother."""
    tracker = tracker_of(folder).smoothing()
    return lambda: tracker.run(without_path(folder)).to_polars()
