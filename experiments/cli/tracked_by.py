"""Which recordings `track` runs by which tracker, those named or that which fits, and readings too late for it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from trackers.catalogue import fitting, spec_of, split_name
from trackers.core.errors import UnusableInput
from trackers.recordings.checks.residuals import delay_against_truth
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.named_tracker import NamedTracker

LATE_S = 0.1
"""Delay of readings against truth, beyond the latency that the tracker assumes, that is worth a notice."""


class TrackedBy(NamedTuple):
    """A tracker and the recordings that it runs on; `short`: its name as that of a folder."""

    tracker: str
    folders: list[RecordingFolder]

    @property
    def short(self) -> str:
        """The name of the tracker, of one in a file without the file."""
        return split_name(self.tracker)[1] or self.tracker


def tracker_names(trackers: str | None, noise: Path | None = None) -> list[str]:
    """The names in a text with commas, none for None.

    Raises UnusableInput for a repeated name, and for several with a file of one tracker's values, `noise`.
    """
    names = [] if trackers is None else [name.strip() for name in trackers.split(",")]
    # By which the folder of each is named.
    shorts = [split_name(name)[1] or name for name in names]
    repeated = next((name for k, name in enumerate(shorts) if name in shorts[:k]), None)
    if repeated is not None:
        raise UnusableInput(f"--tracker {trackers}: '{repeated}' twice; expected different names; remove one")
    if len(names) > 1 and noise is not None:
        raise UnusableInput(
            f"--noise {noise}: belongs to one tracker, found {', '.join(names)}; name one with --tracker"
        )
    return names


def tracked_by(
    folders: Sequence[RecordingFolder], trackers: str | None, noise: Path | None = None
) -> tuple[list[TrackedBy], list[str]]:
    """The runs, and a line for each recording that a tracker does not fit.

    `trackers`: names separated by commas, each of which runs on all recordings that it fits; None: each recording is
    run by the tracker that fits it. `noise`: a file of one tracker's values. Raises UnusableInput where nothing can be
    run, and for unknown, repeated or too many names.
    """
    names = tracker_names(trackers, noise)
    runs: dict[str, list[RecordingFolder]] = {}
    refused: list[str] = []
    for name in names:
        spec, runs[name] = spec_of(name), []
        for folder in folders:
            missing = spec.missing(folder)
            if missing is None:
                runs[name].append(folder)
            else:
                where, tables = folder.path or folder.name, ", ".join(folder.tables)
                refused.append(f"{where}: tracker '{name}' needs {missing}; its tables: {tables}")
    if not names:
        for folder in folders:
            try:
                runs.setdefault(fitting(folder), []).append(folder)
            except UnusableInput as problem:
                refused.append(str(problem))
    found = [TrackedBy(name, own) for name, own in runs.items() if own]
    if not found:
        raise UnusableInput(refused[0])
    return found, refused


def late_readings(named: NamedTracker, folders: Sequence[RecordingFolder]) -> list[str]:
    """A line for each recording whose readings come later against truth than the tracker assumes."""
    read = [name for name in ("ranges", "fixes", "bearings") if name in named.spec.table.replace(",", " ").split()]
    lines = []
    for folder in folders:
        for table in (name for name in read if name in folder.tables):
            tunable, delay = f"sensors.{table}.latency", delay_against_truth(folder, table)
            latency = named.tunables.get(tunable)
            if not abs(delay - (0.0 if latency is None else float(latency.value))) > LATE_S:
                continue
            what = f"{folder.path or folder.name}: {table} come {abs(delay):.2f} s {'late' if delay > 0 else 'early'}"
            fix = "compare the clocks" if latency is None or delay < 0 else f"allow for it: --set {tunable}={delay:.2f}"
            lines.append(f"{what} against truth; {fix}")
    return lines
