"""MH-K: the plain Kalman filter without accelerations, times of stamped estimates."""

import dataclasses

import numpy as np
import pytest

from tests.known_start import flat
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.mhk.tracker import mhk_tracker
from trackwright.trackers.parts.fixes import FIXES


def _position(t):
    # There and back along a line at 0.8 m/s, with turns.
    return np.stack([4 * np.sin(0.2 * t), 0.3 * t, 1 + 0 * t], axis=1)


def _recording(rows=60):
    rng = np.random.default_rng(0)
    times = np.arange(rows) * 0.1
    fixes = _position(times) + 0.03 * rng.normal(size=(rows, 3))
    return Recording(times, {FIXES: Readings(fixes, np.ones((rows, 3), bool))})


@pytest.fixture(scope="module", params=[None, pytest.param(1.0, marks=pytest.mark.slow)], ids=["as printed", "sticky"])
def tracker(request):
    return mhk_tracker(rate=request.param)


def test_it_waits_for_a_full_window_and_ends_near_the_path(tracker):
    recording = _recording()
    estimates = tracker.run(recording)
    assert np.all(estimates.status[:8] == Status.WAITING)
    assert np.all(estimates.status[8:] == Status.OK)
    # The middle of the window is 0.4 s old.
    errors = flat(estimates.mean)[20:, :3] - _position(recording.times[20:] - 0.4)
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.06


@pytest.mark.parametrize("empty", [0.0, 0.2, 0.5])
def test_stamped_estimates_have_the_time_of_the_middle_fix_however_many_rows_are_empty(empty):
    recording = _recording()
    there = np.random.default_rng(5).random(len(recording)) >= empty
    fixes = recording.readings[FIXES]
    seen = fixes.seen & there[:, None]
    recording = dataclasses.replace(recording, readings={FIXES: Readings(fixes.values, seen, fixes.reported)})
    estimates = mhk_tracker(stamped=True).run(recording)
    fix_times = recording.times[there]
    for row in np.flatnonzero(there)[8:]:
        newest = np.searchsorted(fix_times, recording.times[row])
        assert estimates.times[row] == pytest.approx(fix_times[newest - 4], abs=1e-9)
    # Without a fix the filter predicts: the lag is that of the last fix.
    lags = recording.times - estimates.times
    without = np.flatnonzero(~there & (recording.times > fix_times[8]))
    np.testing.assert_allclose(lags[without], lags[without - 1], atol=1e-12)
    np.testing.assert_array_equal(mhk_tracker().run(recording).times, recording.times)
