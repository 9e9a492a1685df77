"""`trackwright check` and `calibrate`: data quality, systematic errors."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import asdict

from trackwright.experiments.cli.options import File, ReadingOptions, Recording, Tracker, require_new, run_tracker_files
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
    from trackwright.trackers.recordings.checks import format_results
    from trackwright.trackers.recordings.checks.all_checks import check as check_recording
    from trackwright.trackers.recordings.folder import read_recording

    run_tracker_files(tracker)
    failed, by_folder = False, {}
    for path in recordings:
        results = check_recording(read_recording(path))
        failed |= any(result.level == "error" for result in results)
        by_folder[str(path)] = [asdict(result) for result in results]
        if not json:
            print(f"{printable(path)}\n{format_results(results)}")
    if json:
        print(json_text(by_folder), end="")
    return int(failed)


def calibrate_recordings(*recordings: Recording, out: File, force: bool = False, json: bool = False) -> int:
    """Fit systematic errors of stations and anchors against truth.

    Writes a file for `--calibration` of other commands, and beside it a page with charts. Recordings to be tracked or
    tuned with the result should be others than these.

    Args:
        recordings: recording folders with truth, and bearings, ranges or tdoa; each has the same weight.
        out: the file to write, as calibration.toml; the page goes beside it.
        force: replace a file that exists, and take recordings in spite of the errors that `trackwright check` finds.
        json: print the content of that file as JSON instead of tables.
    """
    require_new(out, "calibration.toml", force)
    from trackwright.experiments.cli.console import checked, json_alone, output_folder, prepared
    from trackwright.trackers.recordings.folder import read_recordings

    folders = prepared(checked(read_recordings(recordings), force, calibrated=True), ReadingOptions())
    # scipy and matplotlib take a second to import, which the help and a refused recording need not wait for.
    from trackwright.experiments.pages.reports.calibration import WIDTH, report_on, write_calibration_report
    from trackwright.experiments.text.tables import sections_text
    from trackwright.trackers.recordings.calibration import write_calibration
    from trackwright.tuning.calibrating import calibrate

    calibration = calibrate(folders)
    output_folder(out.parent)
    report = report_on(calibration, folders)
    write_calibration(calibration, out)
    page = write_calibration_report(out, calibration, report, sys.argv)
    with json_alone(json) as put:
        print(sections_text([*report.tables.values()], WIDTH, report.note), end="")
        print(f"wrote {out} and {page.name}")
        put(tomllib.loads(out.read_text("utf-8")))
    return 0
