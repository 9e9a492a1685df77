"""What travels to other processes as text and numbers: users' files, and a tracker by name."""

from __future__ import annotations

import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from trackwright.experiments.jobs.run import finished
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracker_spec import TrackerSpec
from trackwright.trackers.recordings.tracks import Tracks

Files = tuple[tuple[str, str], ...]
"""Users' files: the path of each, as it was given, and its text."""


@contextmanager
def copied(files: Files) -> Iterator[dict[str, str]]:
    """The files in a temporary folder: the place of each by its path."""
    places = {}
    with tempfile.TemporaryDirectory(prefix="trackwright-") as folder:
        for k, (path, text) in enumerate(files):
            copy = Path(folder) / f"{k}" / Path(path).name
            copy.parent.mkdir()
            copy.write_text(text, "utf-8")
            places[path] = str(copy)
        yield places


def file_of(name: str) -> str:
    """The text of the user's file of a tracker given as `FILE.py:NAME`; empty for one of the catalogue."""
    file, _ = split_name(name)
    return Path(file).read_text("utf-8") if file else ""


@functools.lru_cache(maxsize=8)
def spec_here(name: str, text: str) -> TrackerSpec:
    """The entry of the catalogue, or that of a user's file with this text; kept, since its programs are compiled."""
    file, attribute = split_name(name)
    if not file:
        return spec_of(name)
    with copied(((file, text),)) as places:
        return spec_of(f"{places[file]}:{attribute}")


class PortableTracker(NamedTuple):
    """A `NamedTracker` as it travels; `text`: of the user's file, for a tracker given as `FILE.py:NAME`."""

    name: str
    text: str
    free_height: bool
    values: dict[str, Any]
    source: str
    smoothed: bool
    lag: float | None
    motion_levels: bool
    error_levels: bool | None

    @classmethod
    def of(cls, tracker: NamedTracker) -> PortableTracker:
        """The name, file and numbers of a tracker of the catalogue or of a user's file."""
        numbers = dict(tracker.values), tracker.source, tracker.smoothed, tracker.lag
        levels = tracker.motion_levels, tracker.error_levels
        return cls(tracker.name, file_of(tracker.name), tracker.free_height, *numbers, *levels)

    def tracks(self, folder: RecordingFolder, seed: int) -> tuple[pl.DataFrame, dict[str, int]]:
        """Of one recording: the table of estimates, and how many trajectories ended how."""
        tracks = self.named(folder).run(folder, seed=seed)
        return tracks.table, tracks.summaries

    def named(self, folder: RecordingFolder) -> NamedTracker:
        """The tracker for one recording; raises UnusableInput as `NamedTracker.of` and where values do not fit."""
        tracker = NamedTracker.of(self.name, spec_here(self.name, self.text), folder, self.free_height)
        if self.values:
            tracker = tracker.with_values(self.values, self.source)
        if self.smoothed:
            tracker = tracker.smoothing(self.lag)
        if self.motion_levels:
            tracker = tracker.with_motion_levels()
        return tracker if self.error_levels is None else tracker.with_error_levels(self.error_levels)


def run_on(
    executor: Executor,
    tracker: NamedTracker,
    folders: Sequence[RecordingFolder],
    advance: Callable[[int], None] = lambda done: None,
    seed: int = 0,
) -> Tracks:
    """The estimates of all recordings, each tracked by itself on the executor, to the bits of tracking it alone.

    `advance` is called with the number of trajectories done. Raises UnusableInput as `NamedTracker.run`.
    """
    portable = PortableTracker.of(tracker)
    by_name: dict[str, tuple[pl.DataFrame, dict[str, int]]] = {}
    for folder, part in finished(lambda f: executor.submit(portable.tracks, f, seed), folders):
        by_name[folder.name] = part
        advance(sum(part[1].values()))
    summaries: Counter[str] = Counter()
    for folder in folders:
        summaries.update(by_name[folder.name][1])
    table = pl.concat([by_name[name][0] for name in sorted(by_name)], how="diagonal")
    return Tracks(table, dict(summaries), tracker.batches(folders))
