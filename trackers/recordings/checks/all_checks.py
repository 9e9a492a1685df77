"""Data-quality checks of a recording: time base, gaps, outliers, ids, units, geometry, errors against truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.checks import mistakes, rules
from trackwright.trackers.recordings.checks.readings import compared
from trackwright.trackers.recordings.checks.rules import LEVELS, CheckResult
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, MANY_REPEATS


def check(recording: RecordingFolder) -> list[CheckResult]:
    """Errors, warnings and notes on a recording, the most severe first."""
    return sorted(_results(recording, True), key=lambda result: LEVELS.index(result.level))


def quick_check(recording: RecordingFolder, calibrated: bool = False) -> list[CheckResult]:
    """Its errors and likely mistakes alone; of readings `calibrated` not those that a calibration removes."""
    return [result for result in _results(recording, False, calibrated) if result.level != "info"]


def _results(recording: RecordingFolder, full: bool, calibrated: bool = False) -> list[CheckResult]:
    tables, rig = recording.tables, recording.rig
    measured = {name: tables[name] for name in KINDS if name in tables}
    results = [*_of_tables(recording, measured)] if full else []
    results += rules.check_times(measured or tables, base=full)
    results += rules.check_clocks(measured, tables.get("truth")) if measured else ()
    results += rules.check_units(rig, tables)
    # Wrong units or times are a mistake that is named already.
    sound = all(one.level != "error" for one in results)
    for name in (name for name in measured if sound and not KINDS[name].numbered):
        view, kind, before = compared(recording, name), KINDS[name], len(results)
        if view is not None and view.large().any():
            results += mistakes.check_mistakes(view, calibrated)
        # A height that is wrong contradicts all kinds.
        quiet = len(results) == before and all(one.level != "error" for one in results) and not calibrated
        if quiet and kind.sensors and kind.predicted:
            results += mistakes.check_contradictions(recording, name)
    # Heights are a part of the frame.
    if "truth" in tables and not any(one.level == "error" and "the truth" in one.message for one in results):
        results += rules.check_heights(rig, tables["truth"])
    return results


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
    yield from rules.check_geometry(rig, measured)
    alone = {"bearings": ("azimuth_rad", "elevation_rad")} if {*measured} == {"bearings"} else {}
    for name, (seen, height) in ({"fixes": ("x_m", "z_m")} | alone).items():
        if name in tables and (tags := rules.without_height(rig, tables[name], seen, height)):
            message = f"neither {height} nor height_m in rig.toml: {len(tags)} of the tags ({listed(map(repr, tags))})"
            yield CheckResult("warning", name, f"{message}; track needs one: give height_m under [tags.{tags[0]}]")
    for name in measured:
        if (share := recording.streams(name).repeated_share) >= 0.01:
            message = f"repeated readings: {share:.0%} of the rows equal the previous row of the same tag and sensor"
            yield CheckResult("warning" if share >= MANY_REPEATS else "info", name, message)


def require_sound(recording: RecordingFolder, force: bool | None, calibrated: bool) -> list[str]:
    """A line for each mistake of `quick_check`; raises UnusableInput for errors without `force`, None for no option."""
    lines = [(one.level, f"{recording.path}: {one.where}: {one.message}") for one in quick_check(recording, calibrated)]
    errors = [line for level, line in lines if level == "error"]
    if errors and not force:
        more = f" (and {len(errors) - 1} more: `trackwright check {recording.path}`)" if len(errors) > 1 else ""
        raise UnusableInput(f"{errors[0]}{more}{'' if force is None else '; --force takes it as it is'}")
    return [line for _, line in lines]
