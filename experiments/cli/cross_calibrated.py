"""Recordings of a fit that its calibration was made of: calibrated without themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from experiments.text.terminal import notice
from trackers.core.errors import UnusableInput, listed
from trackers.recordings.calibration import Calibration
from trackers.recordings.calibration_file import read_calibration
from trackers.recordings.folder import RecordingFolder
from tuning.cross_calibration import by_halves, by_others


def cross_calibrated(folders: Sequence[RecordingFolder], file: Path) -> list[list[RecordingFolder]]:
    """For each recording, itself, or what a fit takes in its place where it is one of those of the calibration `file`.

    These are calibrated on the others among them, or, if there are none, each half on the other half: a fit with the
    file's calibration would see errors smaller than those of new recordings.
    """
    whole = read_calibration(file)
    seen = [folder for folder in folders if folder.name in whole.recordings]
    parts = [_without_itself(folder, seen, file) if folder in seen else [folder] for folder in folders]
    return [[_spread_of(whole, part) for part in own] for own in parts]


def _spread_of(whole: Calibration, part: RecordingFolder) -> RecordingFolder:
    """The recording with the spread of the file's ranges, which sets the tracker's noise levels as `track` has them."""
    if part.calibration is None:
        return part
    return replace(part, calibration=replace(part.calibration, range_spread=whole.range_spread))


def _without_itself(folder: RecordingFolder, seen: Sequence[RecordingFolder], file: Path) -> list[RecordingFolder]:
    """The recording calibrated on the others of `seen`, or its halves; as it is, with a notice, without truth."""
    path = folder.path or folder.name
    try:
        if len(seen) > 1:
            found = [by_others(folder, seen)]
            how = f"calibrated on {listed(one.name for one in seen if one is not folder)}"
        else:
            found, how = by_halves(folder), "each half calibrated on the other half"
    except (UnusableInput, KeyError) as error:
        notice(f"notice: {path}: not cross-fitted ({error}): noise levels fitted to it are too small for others")
        return [folder]
    notice(f"notice: {path}: for the fit {how}, instead of by {file}")
    return found
