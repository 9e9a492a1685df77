"""Data-quality checks of a recording: time base, gaps, outliers, ids, units, geometry, errors against truth.

for result in check(tw.read("hall")):
    print(result.level, result.where, result.message)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.checks import LEVELS, CheckResult
from trackwright.trackers.recordings.checks.compared import compared
from trackwright.trackers.recordings.checks.geometry import (
    check_fix_heights,
    check_geometry,
    check_heights,
    check_offsets,
)
from trackwright.trackers.recordings.checks.mistakes import check_against_truth
from trackwright.trackers.recordings.checks.readings import check_readings
from trackwright.trackers.recordings.checks.residuals import check_quality, check_residuals
from trackwright.trackers.recordings.checks.sampling import (
    anomalies,
    check_clocks,
    check_ids,
    check_overlap,
    check_rates,
    check_stamps,
    check_times,
    check_truth,
)
from trackwright.trackers.recordings.checks.units import check_units
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
    results += check_times(measured or tables, base=full)
    results += check_clocks(measured)
    results += (result for result in check_units(rig, tables) if full or result.level != "info")
    results += check_stamps(tables)
    if "truth" not in tables:
        results += check_heights(rig, tables)
    elif measured:
        results += (check_truth if full else check_overlap)(tables["truth"], measured)
    # Wrong units or times are a mistake that is named already.
    sound = not _errors(results)
    if not sound and not full:
        return results
    if "imu" in tables and sound:
        from trackwright.trackers.recordings.checks.imu import check_imu

        results += check_imu(tables)
    for name in measured:
        results += _of_readings(recording, name, full, sound, calibrated)
    # Heights are a part of the frame.
    if "truth" in tables and not any("the truth" in line or "positions" in line for line in _errors(results)):
        results += check_heights(rig, tables)
    # The truth may be the cause of what places of tags on bodies and odometry look like.
    if not _errors(results):
        results += check_offsets(rig, recording.paths)
        if "odometry" in tables and "truth" in tables and not _errors(results):
            from trackwright.trackers.recordings.checks.odometry import check_odometry

            results += check_odometry(recording)
    return results


def _errors(results: Iterable[CheckResult]) -> list[str]:
    return [result.message for result in results if result.level == "error"]


def _of_tables(recording: RecordingFolder, measured: Mapping[str, pl.DataFrame]) -> Iterator[CheckResult]:
    """What tables and the rig alone tell."""
    tables, rig = recording.tables, recording.rig
    for notice in dict.fromkeys((*recording.notices, *anomalies(tables, rig))):
        yield CheckResult("warning", *notice.partition(": ")[::2])
    if not measured:
        yield CheckResult("error", "tables", "no measurements, only truth; expected a table to track")
    yield from check_rates(tables)
    yield from check_ids(rig, measured)
    if "fixes" in tables:
        yield from check_fix_heights(rig, recording.rows("fixes"))
    yield from check_geometry(rig, tables)


def _of_readings(
    recording: RecordingFolder, name: str, full: bool, sound: bool, calibrated: bool
) -> Iterator[CheckResult]:
    """The most likely mistake in a table, against truth or of readings among themselves, and how readings are."""
    view, mistakes = compared(recording, name), list[CheckResult]()
    if view is not None and sound:
        mistakes = check_against_truth(view, calibrated)
    elif sound and not calibrated:
        from trackwright.trackers.recordings.checks.closing import check_closing

        mistakes = list(check_closing(recording, name))
    if full:
        yield from check_readings(recording, name)
        found = [] if view is None else [*check_residuals(view), *check_quality(recording, name)]
        # A mistake has one cause: what errors with it look like is no second one.
        yield from (one for one in found if one.level == "info" or not _errors(mistakes))
    yield from mistakes


def require_sound(recording: RecordingFolder, force: bool | None, calibrated: bool) -> list[str]:
    """A line for each mistake of `quick_check`; raises UnusableInput for errors without `force`, None for no option."""
    mistakes = quick_check(recording, calibrated)
    lines = [f"{recording.path}: {mistake.where}: {mistake.message}" for mistake in mistakes]
    errors = [line for line, mistake in zip(lines, mistakes, strict=True) if mistake.level == "error"]
    if errors and not force:
        more = f" (and {len(errors) - 1} more: `trackwright check {recording.path}`)" if len(errors) > 1 else ""
        raise UnusableInput(f"{errors[0]}{more}{'' if force is None else '; --force takes it as it is'}")
    return lines
