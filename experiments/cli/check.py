"""`trackwright check`."""

from __future__ import annotations

from dataclasses import asdict

from trackwright.experiments.cli.options import Recording, Tracker, run_tracker_files
from trackwright.trackers.core.errors import printable


def check(*recordings: Recording, tracker: Tracker | None = None, json: bool = False) -> int:
    """Check the data: time base, gaps, outliers, ids, units, geometry.

    Truth is checked too, if there is any.

    The exit code is 1 if there are errors.

    Args:
        recordings: recording folders (rig.toml and tables).
        tracker: one of your own, FILE.py:NAME, whose file adds a kind of measurement.
        json: print JSON instead of lines: by folder, the results with level, where and message.
    """
    from trackwright.trackers.recordings.atomic import json_text
    from trackwright.trackers.recordings.checks import check as check_recording
    from trackwright.trackers.recordings.checks import format_results
    from trackwright.trackers.recordings.folder import read_recording

    run_tracker_files(tracker)
    failed, found = False, {}
    for path in recordings:
        results = check_recording(read_recording(path))
        failed |= any(result.level == "error" for result in results)
        found[str(path)] = [asdict(result) for result in results]
        if not json:
            print(f"{printable(path)}\n{format_results(results)}")
    if json:
        print(json_text(found), end="")
    return int(failed)
