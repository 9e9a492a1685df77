"""`trackwright check`."""

from __future__ import annotations

from experiments.cli.arguments import Folders
from trackers.core.errors import UnusableInput
from trackers.recordings.checks import check as check_recording
from trackers.recordings.checks import format_results
from trackers.recordings.folder import read_recording


def check(recordings: Folders) -> int:
    """Check the data: time base, gaps, outliers, ids, units, geometry.

    Truth is checked too, if there is any.

    The exit code is 1 if there are errors.

    Args:
        recordings: recording folders (rig.toml and tables).
    """
    if not recordings:
        raise UnusableInput("no recording given; expected one or more recording folders")
    failed = False
    for path in recordings:
        results = check_recording(read_recording(path))
        failed |= any(result.level == "error" for result in results)
        print(f"{path}\n{format_results(results)}")
    return int(failed)
