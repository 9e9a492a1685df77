"""Which terms of a calibration help: the first runs of three Bluetooth walks, each calibrated on the other two."""

from __future__ import annotations

from collections.abc import Sequence
from unittest import mock

import numpy as np

from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, shown
from trackwright.experiments.lab.validation.sites import WALKS, recorded
from trackwright.trackers.catalogue import build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.calibration import ANGLE_PRIOR, ANGLE_TERMS
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning import calibrating

SETS: dict[str, Sequence[str]] = {
    "none": (),
    "offset": ("offset",),
    "offset, gain": ("offset", "gain"),
    "offset, gain, cubic": ("offset", "gain", "cubic"),
    "offset, gain, cross": ("offset", "gain", "cross"),
    "all": ANGLE_TERMS,
}

EXCLUDED = 1e-6
"""Prior standard deviation of a term that is left out."""


def calibration_terms(*, output: Output = DEFAULTS) -> int:
    """Which terms of a calibration help on walks left out of it, for growing sets of terms.

    Means over the walks, tracker `bearings` with its default noise levels.
    """
    folders = recorded(WALKS)
    output.publish("validation calibration-terms", Table(shown(_with_terms(folders, label) for label in SETS)))
    return 0


def _with_terms(folders: Sequence[RecordingFolder], label: str) -> Row:
    """The means over the walks, each calibrated on the others with one of the `SETS`."""
    mean, sigmas = ANGLE_PRIOR
    kept = np.where([term in SETS[label] for term in ANGLE_TERMS], sigmas, EXCLUDED)
    figures = []
    for folder in folders:
        calibrated = folder
        if SETS[label]:
            with mock.patch.object(calibrating, "ANGLE_PRIOR", (mean, kept)):
                calibrated = folder.calibrated(
                    calibrating.calibrate([other for other in folders if other is not folder])
                )
        tracker = build("bearings", calibrated)
        plain, smoothed = (evaluate(each.run(calibrated), calibrated) for each in (tracker, tracker.smoothing()))
        figures.append((plain["rmse_m"], smoothed["rmse_m"], 100 * plain["coverage_95"]))
    rmse, smoothed_rmse, inside = np.mean(figures, axis=0).tolist()
    return {"terms": label, "RMSE m": rmse, "smoothed m": smoothed_rmse, "inside 95 %": inside}
