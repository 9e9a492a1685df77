"""Ranges calibrated on one half of a recording: `python -m experiments.validation.calibration_halves`.

Each recording is cut in two at the middle of its truth. Each half is tracked with default noise levels, without a
calibration and with that of the other half. Prints the means of both halves. The recordings are not part of this
repository: TRACKWRIGHT_RECORDINGS names their folder, default `../shared/recordings`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from experiments.cli.runtime import set_flags
from experiments.cli.subprocesses import recordings_folder
from experiments.reports.tables import aligned
from experiments.reports.wording import fixed
from trackers.catalogue import build
from trackers.evaluation import evaluate
from trackers.recordings.folder import RecordingFolder, read_recording
from tuning.calibrating import calibrate

CASES = (("rcv-drone-3", "uwb"), ("iasl-drone-1", "uwb"), ("starloc-fast-s1", "uwb-imu"), ("starloc-2d-s5", "uwb"))
"""Recordings and their trackers."""

METRICS = ("rmse_m", "rmse_3d_m", "coverage_95", "nees_ratio")


def main() -> None:
    """Print the table."""
    set_flags()
    folder = recordings_folder()
    if folder is None:
        raise SystemExit(
            "no folder of real recordings; expected ../shared/recordings or one named by TRACKWRIGHT_RECORDINGS"
        )
    rows = [["recording", "tracker", "calibrated", "RMSE, m", "3-D", "inside 95 %", "NEES/dof"]]
    for name, tracker in CASES:
        first, second = _halves(read_recording(folder / name))
        pairs = (first, second), (second, first)
        for label, calibrated in (("no", False), ("on the other half", True)):
            found = []
            for half, other in pairs:
                judged = half.calibrated(calibrate(other)) if calibrated else half
                evaluation = evaluate(build(tracker, judged).run(judged), judged)
                found.append([evaluation[metric] for metric in METRICS])
            rmse, spatial, inside, nees = np.mean(found, axis=0)
            shown = [fixed(rmse, 3), fixed(spatial, 3), f"{100 * inside:.0f} %", fixed(nees, 2)]
            rows.append([name, tracker, label, *shown])
    print(aligned(rows, range(3, 7)))


def _halves(folder: RecordingFolder) -> tuple[RecordingFolder, RecordingFolder]:
    """The rows before and after the middle of the truth."""
    times = folder.tables["truth"]["t_s"]
    middle = 0.5 * (float(times[0]) + float(times[-1]))
    before = pl.col("t_s") < middle
    first, second = (
        replace(folder, tables={name: table.filter(rows) for name, table in folder.tables.items()})
        for rows in (before, ~before)
    )
    return first, second


if __name__ == "__main__":
    main()
