"""`trackwright check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from trackers.core.errors import UnusableInput
from trackers.recordings.checks import check as check_recording
from trackers.recordings.checks import format_results
from trackers.recordings.folder import read_recording


def check(recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]) -> int:
    """Check the data quality of recordings: time base, gaps, outliers, ids, units, truth, geometry.

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
