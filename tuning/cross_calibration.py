"""Calibrations by cross-fitting: a recording is corrected by what others show, or each half of it by the other half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import polars as pl

from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.calibrating import calibrate


def by_others(folder: RecordingFolder, folders: Sequence[RecordingFolder]) -> RecordingFolder:
    """The recording with a calibration of the other `folders`; raises UnusableInput as `calibrate`."""
    return folder.calibrated(calibrate([other for other in folders if other is not folder]))


def by_halves(folder: RecordingFolder) -> list[RecordingFolder]:
    """The halves of a recording with truth, each with a calibration of the other; raises as `calibrate`."""
    first, second = halves(folder)
    return [first.calibrated(calibrate(second)), second.calibrated(calibrate(first))]


def halves(folder: RecordingFolder) -> tuple[RecordingFolder, RecordingFolder]:
    """The rows before the middle of the truth, and those from there on."""
    times = folder.tables["truth"]["t_s"]
    before = pl.col("t_s") < 0.5 * (float(times[0]) + float(times[-1]))
    first, second = (
        replace(
            folder, name=f"{folder.name}, {which} half", tables={k: t.filter(rows) for k, t in folder.tables.items()}
        )
        for which, rows in (("first", before), ("second", ~before))
    )
    return first, second
