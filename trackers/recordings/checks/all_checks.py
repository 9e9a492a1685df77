"""Data-quality checks of a recording: time base, gaps, outliers, ids, units, geometry, errors against truth.

for result in check(tw.read("hall")):
    print(result.level, result.where, result.message)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.checks import LEVELS, CheckResult, rules
from trackwright.trackers.recordings.checks.compared import compared, moments
from trackwright.trackers.recordings.checks.geometry import check_fix_heights, check_geometry
from trackwright.trackers.recordings.checks.mistakes import check_against_truth, check_closing
from trackwright.trackers.recordings.checks.readings import check_readings
from trackwright.trackers.recordings.checks.residuals import check_residuals
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS


def check(recording: RecordingFolder) -> list[CheckResult]:
    """Errors, warnings and notes on a recording, the most severe first."""
    return sorted(_results(recording, True), key=lambda result: LEVELS.index(result.level))


def quick_check(recording: RecordingFolder, calibrated: bool = False) -> list[CheckResult]:
    """The errors alone that `check` finds, and its warnings of units and of an IMU, in a fraction of its time.

    `calibrated`: what a calibration of anchors and stations removes is no mistake, nor are readings of one moment that
    contradict each other, as uncalibrated ones do.
    """
    return _results(recording, False, calibrated)


def _results(recording: RecordingFolder, full: bool, calibrated: bool = False) -> list[CheckResult]:
    tables, rig = recording.tables, recording.rig
    measured = {name: tables[name] for name in KINDS if name in tables}
    results = [*_of_tables(recording, measured)] if full else []
    results += rules.check_times(measured or tables, base=full)
    results += rules.check_clocks(tables)
    results += (result for result in rules.check_units(rig, tables) if full or result.level != "info")
    if "truth" not in tables:
        results += rules.check_heights(rig, tables)
    elif measured:
        results += rules.check_cover(tables["truth"], measured, full)
    # Wrong units or times are a mistake that is named already.
    sound = not _errors(results)
    if not sound and not full:
        return results
    if "imu" in tables and sound:
        from trackwright.trackers.recordings.checks.imu import check_imu

        results += check_imu(recording)
    for name in measured:
        results += _of_readings(recording, name, full, sound, calibrated)
    # Heights are a part of the frame.
    if "truth" in tables and not any("the truth" in line or "positions" in line for line in _errors(results)):
        results += rules.check_heights(rig, tables)
    # The truth may be the cause of what places of tags on bodies and odometry look like.
    if not _errors(results):
        results += rules.check_offsets(rig, recording.paths)
        if "odometry" in tables and "truth" in tables and not _errors(results):
            from trackwright.trackers.recordings.checks.imu import check_odometry

            results += check_odometry(recording)
    return results


def _errors(results: Iterable[CheckResult]) -> list[str]:
    return [result.message for result in results if result.level == "error"]


def _of_tables(recording: RecordingFolder, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """What tables and the rig alone tell."""
    tables, rig = recording.tables, recording.rig
    found = [f"{one.where}: {one.message}" for one in rules.check_rows(rig, tables)]
    for notice in dict.fromkeys((*recording.notices, *found)):
        yield CheckResult("warning", *notice.partition(": ")[::2])
    if not measured:
        yield CheckResult("error", "tables", "no measurements, only truth; expected a table to track")
    yield from rules.check_rates(tables)
    yield from rules.unobserved(rig, measured, "anchor", "station")
    if "fixes" in tables:
        yield from check_fix_heights(rig, recording.rows("fixes"))
    yield from check_geometry(rig, tables)


def _of_readings(
    recording: RecordingFolder, name: str, full: bool, sound: bool, calibrated: bool
) -> Iterator[CheckResult]:
    """The likely mistakes in a table, against truth or of readings among themselves, and how readings are."""
    view, mistakes = compared(recording, name), list[CheckResult]()
    if view is not None and sound:
        mistakes += check_against_truth(view, calibrated)
    elif sound and not calibrated and (of_moments := moments(recording, name)) is not None:
        mistakes += check_closing(of_moments)
    yield from mistakes
    yield from check_readings(recording, name) if full else ()
    # A mistake has one cause: what errors with it look like is no second one.
    found = check_residuals(view) if full and view is not None else ()
    yield from (one for one in found if one.level == "info" or not _errors(mistakes))


def require_sound(recording: RecordingFolder, force: bool | None, calibrated: bool) -> list[str]:
    """A line for each mistake of `quick_check`; raises UnusableInput for errors without `force`, None for no option."""
    mistakes = quick_check(recording, calibrated)
    lines = [f"{recording.path}: {mistake.where}: {mistake.message}" for mistake in mistakes]
    errors = [line for line, mistake in zip(lines, mistakes, strict=True) if mistake.level == "error"]
    if errors and not force:
        more = f" (and {len(errors) - 1} more: `trackwright check {recording.path}`)" if len(errors) > 1 else ""
        raise UnusableInput(f"{errors[0]}{more}{'' if force is None else '; --force takes it as it is'}")
    return lines
