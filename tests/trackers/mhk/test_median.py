"""The speed-limited sliding median: the fifth of nine values, limited only above the speed limit."""

import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.mhk.tracker import LimitedMedian, speed_limited
from trackwright.trackers.parts.fixes import FIXES


def _medians(values, seen=None, dt=0.1, limit=1e6, window=9):
    seen = np.ones(values.shape, bool) if seen is None else seen
    recording = Recording(np.arange(len(values)) * dt, {FIXES: Readings(np.where(seen, values, 0.0), seen)})
    batch = stack([recording])
    out, _, _ = LimitedMedian(window, limit).medians(batch)
    return np.asarray(out.values)[..., 0], np.asarray(out.seen)[..., 0]


def test_it_is_the_median_of_the_last_nine_and_not_seen_before():
    values = np.random.default_rng(0).normal(size=(40, 3))
    medians, seen = _medians(values)
    assert not seen[:8].any()
    assert seen[8:].all()
    # The fifth of nine in order: n + 1 of 2n + 1, where the paper's text has the n-th.
    expected = [np.sort(values[k - 8 : k + 1], axis=0)[4] for k in range(8, 40)]
    np.testing.assert_allclose(medians[8:], expected, rtol=1e-12)


def test_missing_fixes_are_left_out_of_the_window_and_give_no_median():
    rng = np.random.default_rng(1)
    values, rows = rng.normal(size=(60, 3)), rng.random(60) > 0.3
    medians, seen = _medians(values, np.tile(rows[:, None], (1, 3)))
    kept = np.flatnonzero(rows)
    assert not seen[~rows].any()
    for number, row in enumerate(kept[8:], 8):
        np.testing.assert_allclose(medians[row], np.median(values[kept[number - 8 : number + 1]], axis=0))


@pytest.mark.parametrize(("jump", "expected"), [(0.1, 0.1), (0.2, 0.2), (0.3, 0.2), (5.0, 0.2)])
def test_only_displacements_above_the_speed_limit_are_shortened(jump, expected):
    # 2 m/s for 0.1 s. As printed, (2) would limit slow displacements and pass fast ones.
    direction = np.array([0.6, 0.0, 0.8])
    limited = np.asarray(speed_limited(np.zeros(3), jump * direction, 0.2))
    np.testing.assert_allclose(limited, expected * direction, rtol=1e-12)


def test_after_a_step_the_median_follows_at_the_speed_limit():
    values = np.zeros((60, 3))
    values[20:, 0] = 3.0
    medians, _ = _medians(values, limit=2.0)
    speeds = np.diff(medians[8:, 0]) / 0.1
    assert speeds.max() == pytest.approx(2.0, rel=1e-9)
    assert medians[-1, 0] == pytest.approx(3.0)


def test_the_speed_limit_applies_to_the_whole_length_of_a_gap():
    values = np.zeros((40, 3))
    values[20:] = [3.0, 0.0, 0.0]
    seen = np.ones((40, 3), bool)
    seen[16:36] = False
    medians, known = _medians(values, seen, limit=2.0, window=1)
    assert medians[36, 0] == pytest.approx(3.0)
    assert known[36].all()
