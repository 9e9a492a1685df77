"""Which of the recordings given to `track` can be tracked: those that can be read, and without errors of `check`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.text.terminal import notice
from trackers.core.errors import UnusableInput
from trackers.recordings.checks import quick_check
from trackers.recordings.folder import RecordingFolder, read_recordings


def usable_recordings(paths: Sequence[Path], force: bool, calibrated: bool) -> tuple[list[RecordingFolder], list[str]]:
    """The recordings that can be tracked, and a line for each other one; with `force` those with errors, too.

    `calibrated`: systematic errors against truth are no mistakes, since a calibration removes them.

    Raises UnusableInput as `read_recordings`, and where no recording can be tracked.
    """
    refused: list[str] = []
    usable = []
    for recording in read_recordings(paths, refused):
        try:
            for line in errors_of(recording, force, calibrated):
                notice(f"notice: {line}")
        except UnusableInput as problem:
            refused.append(str(problem))
            continue
        usable.append(recording)
    if not usable:
        for line in refused[1:]:
            notice(f"not tracked: {line}")
        raise UnusableInput(refused[0])
    return usable, refused


def errors_of(recording: RecordingFolder, force: bool, calibrated: bool) -> list[str]:
    """A line for each mistake of `quick_check`; raises UnusableInput for errors without `force`."""
    found = quick_check(recording, not calibrated)
    lines = [f"{recording.path}: {one.where}: {one.message}" for one in found]
    errors = [line for line, one in zip(lines, found, strict=True) if one.level == "error"]
    if errors and not force:
        more = f" (and {len(errors) - 1} more: `trackwright check {recording.path}`)" if len(errors) > 1 else ""
        raise UnusableInput(f"{errors[0]}{more}; --force tracks it as it is")
    return lines
