"""Data-quality checks of a recording: time base, rates, gaps, duplicates, outliers, ids, units, truth, geometry.

for result in check(read_recording("hall")):
    print(result.level, result.where, result.message)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trackers.recordings.checks.anomalies import anomalies
from trackers.recordings.checks.check_result import LEVELS, CheckResult, Level, format_results
from trackers.recordings.checks.coverage import check_ids, check_truth
from trackers.recordings.checks.geometry import check_geometry
from trackers.recordings.checks.sampling import check_rates, check_time_base
from trackers.recordings.checks.units import check_units
from trackers.recordings.tables import MEASUREMENTS

if TYPE_CHECKING:  # the folder's module imports `anomalies`
    from trackers.recordings.folder import RecordingFolder

__all__ = ["CheckResult", "Level", "check", "format_results"]


def check(recording: RecordingFolder) -> list[CheckResult]:
    """Errors, warnings and notes on a recording, the most severe first."""
    tables, rig = recording.tables, recording.rig
    measured = {name: tables[name] for name in MEASUREMENTS if name in tables}
    results = []
    for notice in dict.fromkeys((*recording.notices, *anomalies(tables, rig))):
        where, _, message = notice.partition(": ")
        results.append(CheckResult("warning", where, message))
    if not measured:
        results.append(CheckResult("error", "tables", "no measurements, only truth; expected a table to track"))
    results += check_time_base(measured or tables)
    results += check_rates(tables)
    results += check_ids(rig, measured)
    results += check_units(rig, tables)
    if measured and "truth" in tables:
        results += check_truth(tables["truth"], measured)
    results += check_geometry(rig, tables)
    return sorted(results, key=lambda result: LEVELS.index(result.level))
