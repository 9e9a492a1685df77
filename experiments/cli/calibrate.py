"""`trackwright calibrate`."""

from __future__ import annotations

import sys
import tomllib

from trackwright.experiments.cli.options import File, Recording
from trackwright.trackers.core.errors import UnusableInput


def calibrate_recordings(*recordings: Recording, out: File, json: bool = False) -> int:
    """Fit systematic errors of stations and anchors against truth.

    Writes a file for `--calibration` of other commands, and beside it a page with figures. Recordings to be tracked or
    tuned with the result should be others than these.

    Args:
        recordings: recording folders with truth, and bearings or ranges; each has the same weight.
        out: the file to write, as calibration.toml; the page and its figures go beside it.
        json: print the content of that file as JSON instead of tables.
    """
    if out.suffix != ".toml" or out.is_dir():
        raise UnusableInput(f"--out {out}: expected a file with the ending .toml; give calibration.toml in a folder")
    from trackwright.experiments.cli.console import json_alone, output_folder, read_with_notices

    folders = read_with_notices(recordings)
    # scipy and matplotlib take a second to import, which the help and a refused recording need not wait for.
    from trackwright.experiments.pages.reports.calibration import (
        draw_report,
        report_on,
        report_text,
        write_calibration_report,
    )
    from trackwright.trackers.recordings.calibration import write_calibration
    from trackwright.tuning.calibrating import calibrate

    calibration = calibrate(folders)
    output_folder(out.parent)
    report = report_on(calibration, folders)
    write_calibration(calibration, out)
    drawn = draw_report(out, calibration, report)
    page = write_calibration_report(out, calibration, report, sys.argv)
    with json_alone(json) as put:
        print(report_text(report), end="")
        print(f"wrote {out}, {page.name} and {', '.join(drawn)}")
        put(tomllib.loads(out.read_text("utf-8")))
    return 0
