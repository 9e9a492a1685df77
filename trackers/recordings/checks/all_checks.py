"""Data-quality checks of a recording: time base, gaps, outliers, ids, units, geometry, errors against truth.

for result in check(read_recording("hall")):
    print(result.level, result.where, result.message)
"""

from __future__ import annotations

from collections.abc import Iterable

from trackwright.trackers.recordings.checks import LEVELS, CheckResult
from trackwright.trackers.recordings.checks.anomalies import anomalies
from trackwright.trackers.recordings.checks.compared import Compared, compared
from trackwright.trackers.recordings.checks.coverage import (
    check_clocks,
    check_ids,
    check_overlap,
    check_rates,
    check_stamps,
    check_time_base,
    check_time_unit,
    check_truth,
)
from trackwright.trackers.recordings.checks.geometry import (
    check_fix_heights,
    check_geometry,
    check_heights,
    check_offsets,
)
from trackwright.trackers.recordings.checks.mistakes import check_against_truth
from trackwright.trackers.recordings.checks.readings import check_readings
from trackwright.trackers.recordings.checks.residuals import check_marks, check_quality, check_residuals
from trackwright.trackers.recordings.checks.units import check_units
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS


def check(recording: RecordingFolder) -> list[CheckResult]:
    """Errors, warnings and notes on a recording, the most severe first."""
    tables, rig = recording.tables, recording.rig
    measured = {name: tables[name] for name in KINDS if name in tables}
    notices = dict.fromkeys((*recording.notices, *anomalies(tables, rig)))
    results = [CheckResult("warning", *notice.partition(": ")[::2]) for notice in notices]
    if not measured:
        results.append(CheckResult("error", "tables", "no measurements, only truth; expected a table to track"))
    results += check_time_unit(measured or tables)
    results += check_time_base(measured or tables)
    results += check_clocks(measured)
    results += check_rates(tables)
    results += check_ids(rig, measured)
    results += check_units(rig, tables)
    results += check_stamps(tables)
    results += check_heights(rig, tables) if "truth" not in tables else ()
    results += check_fix_heights(rig, recording.rows("fixes")) if "fixes" in tables else ()
    results += check_truth(tables["truth"], measured) if measured and "truth" in tables else ()
    results += check_geometry(rig, tables)
    # Wrong units are a mistake that is named already.
    sound = all(result.level != "error" for result in results)
    if "imu" in tables and sound:
        from trackwright.trackers.recordings.checks.imu import check_imu

        results += check_imu(tables)
    for name in measured:
        results += check_readings(recording, name)
        view = compared(recording, name)
        mistakes = list(_mistakes(recording, name, view)) if sound else []
        against_truth = [] if view is None else [*check_residuals(view), *check_quality(recording, name)]
        if any(mistake.level == "error" for mistake in mistakes):
            # A mistake has one cause: what errors with it look like is no second one.
            against_truth = [result for result in against_truth if result.level == "info"]
        results += [*against_truth, *check_marks(recording, name), *mistakes]
    results += _heights(recording, results)
    results += _of_motion(recording, results)
    return sorted(results, key=lambda result: LEVELS.index(result.level))


def quick_check(recording: RecordingFolder, calibrated: bool = False) -> list[CheckResult]:
    """The errors alone that `check` finds, and its warnings of units and of an IMU, in a fraction of its time.

    `calibrated`: what a calibration of anchors and stations removes is no mistake, nor are readings of one moment that
    contradict each other, as uncalibrated ones do.
    """
    tables, rig = recording.tables, recording.rig
    measured = {name: tables[name] for name in KINDS if name in tables}
    results = list(check_time_unit(measured or tables))
    results += check_clocks(measured)
    results += [result for result in check_units(rig, tables) if result.level != "info"]
    results += check_stamps(tables)
    results += check_heights(rig, tables) if "truth" not in tables else ()
    results += check_overlap(tables["truth"], measured) if measured and "truth" in tables else ()
    if any(result.level == "error" for result in results):
        return results
    if "imu" in tables:
        from trackwright.trackers.recordings.checks.imu import check_imu

        results += check_imu(tables)
    for name in measured:
        results += _mistakes(recording, name, compared(recording, name), calibrated)
    results += _heights(recording, results)
    return [*results, *_of_motion(recording, results)]


def _heights(recording: RecordingFolder, results: Iterable[CheckResult]) -> list[CheckResult]:
    """Heights that contradict the truth, unless that is in another frame, of which heights are a part."""
    if "truth" not in recording.tables:
        return []
    known = any(one.level == "error" and ("the truth" in one.message or "positions" in one.message) for one in results)
    return [] if known else list(check_heights(recording.rig, recording.tables))


def _of_motion(recording: RecordingFolder, results: Iterable[CheckResult]) -> list[CheckResult]:
    """Mistakes in places of tags on bodies and in odometry, unless one of the truth may be the cause."""
    if any(result.level == "error" for result in results):
        return []
    found = list(check_offsets(recording.rig, recording.paths))
    if "odometry" in recording.tables and "truth" in recording.tables and not found:
        from trackwright.trackers.recordings.checks.odometry import check_odometry

        found += check_odometry(recording)
    return found


def _mistakes(
    recording: RecordingFolder, name: str, view: Compared | None, calibrated: bool = False
) -> Iterable[CheckResult]:
    """The most likely mistake in a table: against the truth, or where there is none, of readings among themselves."""
    if view is not None:
        return check_against_truth(view, calibrated)
    if calibrated:
        return []
    from trackwright.trackers.recordings.checks.closing import check_closing

    return check_closing(recording, name)
