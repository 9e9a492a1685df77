"""Moving average and median of fixes against NumPy, row by row."""

import numpy as np
import pytest

from trackwright.trackers.baselines.fixes import MovingWindow
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.parts.fixes import FIXES

WINDOW, ROWS = 5, 30


def _recording():
    rng = np.random.default_rng(0)
    values, seen = rng.normal(size=(ROWS, 3)), rng.random((ROWS, 3)) > 0.3
    return Recording(np.arange(ROWS) * 0.1, {FIXES: Readings(np.where(seen, values, 0.0), seen)})


@pytest.mark.parametrize(("median", "numpys"), [(False, np.mean), (True, np.median)])
def test_each_axis_is_numpys_mean_or_median_of_its_last_values(median, numpys):
    recording = _recording()
    estimates = MovingWindow(WINDOW, median).run(recording)
    fixes = recording.readings[FIXES]
    for row in range(ROWS):
        past = [fixes.values[: row + 1, k][fixes.seen[: row + 1, k]][-WINDOW:] for k in range(3)]
        if all(len(p) for p in past):
            assert estimates.status[row] == Status.OK
            np.testing.assert_allclose(
                np.stack(list(estimates.mean.position), axis=-1)[row], [numpys(p) for p in past], rtol=1e-12
            )
        else:
            assert estimates.status[row] == Status.WAITING
