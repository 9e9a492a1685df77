"""`trackwright check`, `calibrate`, `survey` and `trackers`: data, systematic errors, anchors, what can be run."""

from __future__ import annotations

import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import File, Name, Recording
from trackwright.trackers.catalogue import ENTRIES, run_file_of
from trackwright.trackers.core.errors import UnusableInput, printable

Names = Annotated[str, Parameter(metavar="A1,A2,…")]


def check(*recordings: Recording, tracker: Name | None = None) -> int:
    """Check the data: time base, gaps, outliers, ids, units, geometry.

    Truth is checked too, if there is any. The exit code is 1 if there are errors.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of these.
        tracker: one of your own, FILE.py:NAME, whose file adds a kind of measurement.
    """
    from trackwright.experiments.text.tables import checks_text
    from trackwright.trackers.recordings.checks.all_checks import check as check_recording
    from trackwright.trackers.recordings.folder import read_recording, recordings_under

    run_file_of(tracker)
    failed = False
    for path in (path for given in recordings for path in recordings_under(given)):
        results = check_recording(read_recording(path))
        failed |= any(result.level == "error" for result in results)
        print(f"{printable(path)}\n{checks_text(results)}")
    return int(failed)


def calibrate_recordings(*recordings: Recording, out: File, force: bool = False) -> int:
    """Fit systematic errors of stations and anchors against truth.

    Writes a file for `--calibration` of other commands, to be used with other recordings, and a page beside it.

    Args:
        recordings: recording folders with truth, and bearings or ranges; each has the same weight.
        out: the file to write, as calibration.toml; the page and its figures go beside it.
        force: replace a file that exists, and take recordings in spite of the errors that `trackwright check` finds.
    """
    from trackwright.trackers.recordings.tracks_table import require_new

    require_new(out, "calibration.toml", force)
    from trackwright.experiments.cli.console import notices, output_folder
    from trackwright.experiments.text.terminal import stages
    from trackwright.trackers.recordings.checks.all_checks import require_sound
    from trackwright.trackers.recordings.folder import read_recordings

    with stages("calibrate"):
        folders = read_recordings(recordings)
        for folder in folders:
            notices([*require_sound(folder, force, True), *folder.notices])
        # scipy and matplotlib take a second to import, which the help and a refused recording need not wait for.
        from trackwright.experiments.pages import calibration as pages
        from trackwright.experiments.text.tables import sections_text
        from trackwright.trackers.recordings.calibration import write_calibration
        from trackwright.tuning.calibrating import calibrate

        calibration = calibrate(folders)
        output_folder(out.parent)
        report = pages.report_on(calibration, folders)
        write_calibration(calibration, out)
        page = pages.write_calibration_report(out, calibration, report, sys.argv)
        print(sections_text([*report.tables.values()], pages.WIDTH, report.note), end="")
        print(f"wrote {out} and {page.name}")
    return 0


def survey(
    *recordings: Recording, out: File, given: Names | None = None, sigma: float = 0.0, frame: Names | None = None,
    height: float | None = None, force: bool = False,
) -> int:  # fmt: skip
    """Survey anchors: their positions and delays, from walks with ranges, without truth.

    Writes a rig.toml that `track` takes, and beside it a page. Anchors that rig.toml of the walks lacks are found, too.

    Args:
        recordings: recording folders with ranges to the same anchors; truth, if there is any, is not used.
        out: the file to write, as rig.toml; the page goes beside it.
        given: anchors whose positions in rig.toml are known, or all.
        sigma: their standard deviation, m, as 0.05 by tape; default: exact.
        frame: without given anchors: origin, x axis, and one to the left of it; default: the first.
        height: of the tags, m; default: as in rig.toml, else estimated.
        force: replace a file that exists, and take ranges in spite of the errors that `trackwright check` finds.
    """
    from trackwright.trackers.recordings.tracks_table import require_new

    require_new(out, "rig.toml", force)
    from trackwright.experiments.cli.console import notices
    from trackwright.experiments.text.terminal import stages
    from trackwright.trackers.recordings.checks.all_checks import require_sound
    from trackwright.trackers.recordings.folder import read_recording, refuse_repeated

    refuse_repeated(recordings)
    folders = [read_recording(path, placed=False) for path in recordings]
    for folder in (folder for folder in folders if "ranges" in folder.tables):
        # No other table is used, and positions in rig.toml may be wrong.
        unplaced = replace(folder.rig, anchors={})
        notices(require_sound(replace(folder, rig=unplaced, tables={"ranges": folder.tables["ranges"]}), force, True))
    from trackwright.experiments.pages.calibration import write_survey_page
    from trackwright.trackers.recordings.files import write_whole
    from trackwright.trackers.recordings.rig_file import rig_text
    from trackwright.tuning.survey import survey as survey_walks

    with stages("survey") as begin:
        begin("fitting positions and paths")
        result = survey_walks(folders, given or (), sigma, frame or (), height)
        notices(result.notes)
        write_whole(out, rig_text(result.rig))
        page = write_survey_page(out, result, sys.argv)
        print(f"{result}\nwrote {out} and {page.name}")
    return 0


def trackers(tracker: Name | None = None, folder: Path | None = None, /) -> int:
    """List the trackers and the tables they read; the tunables of one for a recording.

    Without --tracker the first that fits is chosen. Tunables have the names of --set, --tune, --bound and --over.

    Args:
        tracker: one of the list, or FILE.py:NAME of a TrackerSpec of your own, whose tunables are listed.
        folder: a recording folder with the stations or anchors that it gets.
    """
    for name, entry in () if tracker else ENTRIES.items():
        about = f"{name:<26} {entry.about} ({entry.table})"
        print(textwrap.fill(about, 80, subsequent_indent=" " * 27, break_on_hyphens=False))
    if tracker is None:
        return 0
    if folder is None:
        raise UnusableInput(f"trackers {tracker}: its tunables belong to an installation; give a recording FOLDER, too")
    from trackwright.trackers.recordings.folder import read_recording

    run_file_of(tracker)
    recording = read_recording(folder)
    # jax takes a second to import, which a refused recording need not wait for.
    import numpy as np

    from trackwright.trackers.catalogue import build
    from trackwright.trackers.core.model.tunable import meanings

    named = build(tracker, recording)
    for name, meaning in meanings(named.tracker).items():
        node = named.tunables[name]
        numbers = ", ".join(f"{x:.6g}" for x in np.ravel(node.value))
        value = f"{numbers} {node.unit.removeprefix('1')}".rstrip() + f" ({node.bounds})" * bool(node.bounds)
        print(textwrap.fill(f"{name} = {value}: {meaning}", 120, subsequent_indent=" " * 4, break_on_hyphens=False))
    return 0
