"""Moving average and median of fixes against NumPy, row by row."""

import numpy as np
import pytest

from trackwright.trackers.baselines.windows import MovingWindow
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.parts.fixes import FIXES

WINDOW, ROWS = 5, 30


def _recording(seed=0, rows=ROWS):
    rng = np.random.default_rng(seed)
    values, seen = rng.normal(size=(rows, 3)), rng.random((rows, 3)) > 0.3
    return Recording(np.arange(rows) * 0.1, {FIXES: Readings(np.where(seen, values, 0.0), seen)})


def _positions(estimates):
    return np.stack(list(estimates.mean.position), axis=-1)


@pytest.mark.parametrize(("median", "numpys"), [(False, np.mean), (True, np.median)])
def test_each_axis_is_numpys_mean_or_median_of_its_last_values(median, numpys):
    recording = _recording()
    estimates = MovingWindow(WINDOW, median).run(recording)
    fixes = recording.readings[FIXES]
    for row in range(ROWS):
        past = [fixes.values[: row + 1, k][fixes.seen[: row + 1, k]][-WINDOW:] for k in range(3)]
        if all(len(p) for p in past):
            assert estimates.status[row] == Status.OK
            np.testing.assert_allclose(_positions(estimates)[row], [numpys(p) for p in past], rtol=1e-12)
        else:
            assert estimates.status[row] == Status.WAITING


def test_of_nine_values_the_fifth_is_the_median():
    values = np.tile(np.array([9.0, 1, 8, 2, 7, 3, 6, 4, 5])[:, None], (1, 3))
    recording = Recording(np.arange(9) * 0.1, {FIXES: Readings(values, np.ones(values.shape, bool))})
    assert _positions(MovingWindow(9, True).run(recording))[-1].tolist() == [5.0, 5.0, 5.0]


def test_later_rows_change_nothing_before_them():
    whole, start = _recording(), _recording()
    part = Recording(
        start.times[:20],
        {FIXES: Readings(*(x[:20] for x in (start.readings[FIXES].values, start.readings[FIXES].seen)))},
    )
    tracker = MovingWindow(WINDOW, True)
    np.testing.assert_array_equal(_positions(tracker.run(whole))[:20], _positions(tracker.run(part)))


def test_a_trajectory_is_the_same_in_a_ragged_batch():
    batch = [_recording(0), _recording(1, 12)]
    together = MovingWindow(WINDOW, True).run(stack(batch))
    for k, recording in enumerate(batch):
        alone = MovingWindow(WINDOW, True).run(recording)
        np.testing.assert_array_equal(_positions(together[k])[: len(recording)], _positions(alone))
        assert np.all(together[k].status[len(recording) :] == Status.PADDING)


def test_a_window_without_rows_is_refused():
    with pytest.raises(ValueError, match="at least one row"):
        MovingWindow(0, True)
