"""Data-quality checks of a recording: time base, gaps, outliers, ids, units, geometry, errors against truth.

for result in check(tw.read("hall")):
    print(result.level, result.where, result.message)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.checks import LEVELS, CheckResult, rules
from trackwright.trackers.recordings.checks.mistakes import check_mistakes
from trackwright.trackers.recordings.checks.readings import (
    MANY,
    Compared,
    compared,
    known_median,
    located,
    readings,
    repeated_share,
)
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

OUTLIER, SHOWN, FEW = 5.0, 24, 0.01
"""Robust standard deviations beyond which a reading is an outlier; most sensors with a line each; share of repeats that
is reported."""


def check(recording: RecordingFolder) -> list[CheckResult]:
    """Errors, warnings and notes on a recording, the most severe first."""
    return sorted(_results(recording, True), key=lambda result: LEVELS.index(result.level))


def quick_check(recording: RecordingFolder, calibrated: bool = False) -> list[CheckResult]:
    """The errors that `check` finds, and its warnings of units and likely mistakes, in a fraction of its time.

    `calibrated`: what a calibration of anchors and stations removes is no mistake.
    """
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
    for name in measured if sound or full else ():
        view, mistakes = compared(recording, name), list[CheckResult]()
        if sound and not KINDS[name].numbered:
            for of in (view, None if calibrated else located(recording, name)):
                mistakes += check_mistakes(of, calibrated) if of is not None and not mistakes else ()
                if of is not None and (of.sizes() > of.kind.sizes("large", len(of.columns))).any():
                    break
        results += mistakes
        results += _of_sensors(view) if full and view is not None else ()
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
    if "fixes" in tables and (tags := rules.without_height(rig, tables["fixes"])):
        message = f"neither z_m nor height_m in rig.toml: {len(tags)} of the tags ({listed(map(repr, tags))})"
        yield CheckResult("warning", "fixes", f"{message}; track refuses them: give height_m under [tags.{tags[0]}]")
    for name, kind in KINDS.items():
        if name in measured and (share := repeated_share(readings(recording, name))) >= FEW:
            of = "tag and pair of anchors" if kind.difference else " and ".join(kind.layout(()).ids)
            message = f"repeated readings: {100 * share:.2g} % of the rows equal the previous row of the same {of}"
            expected = "; expected one row per measurement" if share >= MANY else ""
            yield CheckResult("warning" if share >= MANY else "info", name, message + expected)


def _of_sensors(view: Compared) -> Iterator[CheckResult]:
    """Bias, spread and outliers against truth of each anchor, station or tag, of the first `SHOWN`."""
    errors, (unit, factor), digits = view.errors(), view.kind.shown, 1 if view.kind.angles else 2
    if view.kind.difference:
        errors = errors + view.medians(errors)[view.sensors.number[:, 1]]  # of the one anchor alone
    names = [column.rpartition("_")[0] for column in view.columns]
    for k, sensor in enumerate(view.ids[:SHOWN]):
        e = factor * errors[view.group == k]
        bias, away = known_median(e), np.abs(e - known_median(e))
        spread = 1.4826 * known_median(away)
        wild = np.sum(away > OUTLIER * spread, axis=0) / np.maximum(np.isfinite(e).sum(axis=0), 1)
        parts = [
            f"{name} bias {b:+.{digits}f}{unit}, spread {s:.{digits}f}{unit}, outliers {w:.2%}"
            for name, b, s, w in zip(names, bias, spread, wild, strict=True)
            if np.isfinite(b)
        ]
        if parts:
            yield CheckResult("info", view.kind.name, f"{view.kind.noun} {sensor} against truth: {'; '.join(parts)}")


def require_sound(recording: RecordingFolder, force: bool | None, calibrated: bool) -> list[str]:
    """A line for each mistake of `quick_check`; raises UnusableInput for errors without `force`, None for no option."""
    mistakes = quick_check(recording, calibrated)
    lines = [f"{recording.path}: {mistake.where}: {mistake.message}" for mistake in mistakes]
    errors = [line for line, mistake in zip(lines, mistakes, strict=True) if mistake.level == "error"]
    if errors and not force:
        more = f" (and {len(errors) - 1} more: `trackwright check {recording.path}`)" if len(errors) > 1 else ""
        raise UnusableInput(f"{errors[0]}{more}{'' if force is None else '; --force takes it as it is'}")
    return lines
