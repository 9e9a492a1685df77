"""Counters that wrap are unwrapped and named."""

from __future__ import annotations

import numpy as np
import pytest

from trackwright.trackers.recordings.tables import unwrapped_times


@pytest.mark.parametrize("period", [2**32 * 1e-6, 2**32 * 1e-3])
def test_a_counter_of_32_bits_that_wraps_is_unwrapped_and_named(period):
    t = 0.1 * np.arange(200) + period - 7.0
    found, (notice,) = unwrapped_times(t % period)
    np.testing.assert_allclose(found, t, rtol=1e-9)
    assert "2³² " in notice
    assert unwrapped_times(t)[1] == []
