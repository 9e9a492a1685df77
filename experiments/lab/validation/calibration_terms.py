"""Which terms of a calibration help: `python -m trackwright.experiments.lab.validation.calibration_terms`.

The first runs of three Bluetooth walks, each judged by a calibration on the other two. Prints, for growing sets of
terms, the mean over the walks of the horizontal RMSE of the tracker `bearings` with its default noise levels, of its
smoother, and of the share inside the 95 % ellipse. The recordings are not part of this repository:
TRACKWRIGHT_RECORDINGS names their folder, default `../shared/recordings`.
"""

from __future__ import annotations

from collections.abc import Sequence
from unittest import mock

import numpy as np

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.cli.runtime import set_flags
from trackwright.experiments.lab.subprocesses import required_recordings
from trackwright.experiments.text.tables import aligned
from trackwright.trackers.catalogue import build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.calibration import ANGLE_PRIOR, ANGLE_TERMS
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings
from trackwright.tuning import calibrating

WALKS = tuple(f"ble51-walk-u{k}-r1" for k in (1, 2, 3))

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


def main() -> int:
    """Print the table."""
    set_flags()
    folder = required_recordings()
    folders = read_recordings([folder / name for name in WALKS])
    rows = [["terms", "RMSE", "smoothed", "inside 95 %"]]
    for label, terms in SETS.items():
        rmse, smoothed, inside = np.mean([_judged(folders, one, terms) for one in folders], axis=0)
        rows.append([label, f"{rmse:.3f} m", f"{smoothed:.3f} m", f"{100 * inside:.0f} %"])
    print(aligned(rows, range(1, 4)))
    return 0


def _judged(folders: Sequence[RecordingFolder], one: RecordingFolder, terms: Sequence[str]) -> tuple[float, ...]:
    """The metrics of one walk, calibrated on the others."""
    mean, sigmas = ANGLE_PRIOR
    kept = np.where([term in terms for term in ANGLE_TERMS], sigmas, EXCLUDED)
    if terms:
        with mock.patch.object(calibrating, "ANGLE_PRIOR", (mean, kept)):
            one = one.calibrated(calibrating.calibrate([other for other in folders if other.name != one.name]))
    tracker = build("bearings", one)
    plain, smoothed = (evaluate(each.run(one), one) for each in (tracker, tracker.smoothing()))
    return plain["rmse_m"], smoothed["rmse_m"], plain["coverage_95"]


if __name__ == "__main__":
    run_alone(main, "python -m trackwright.experiments.lab.validation.calibration_terms")
