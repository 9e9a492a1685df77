"""Detection of a tag that leaves its line."""

import numpy as np

from trackwright.trackers.line.leaving import cusum, excursions

TIMES = np.arange(0, 60, 0.5)


def test_an_excursion_starts_and_ends_with_the_difference():
    distance = np.where((TIMES >= 20) & (TIMES < 30), 2.0, 0.2)
    (excursion,) = excursions(TIMES, distance, 1.0, 2.0)
    assert TIMES[excursion.start] == 20.0
    # Ten seconds of one metre more than the slack fill the sum to its cap of 4 m s, which 0.8 m/s takes 5 s to empty.
    assert abs(TIMES[excursion.end] - 34.75) <= 0.25
    assert excursion.farthest == 2.0


def test_a_short_or_small_difference_is_no_excursion():
    assert excursions(TIMES, np.where(np.abs(TIMES - 20) < 0.6, 2.0, 0.2), 1.0, 2.0) == []
    assert excursions(TIMES, np.full(len(TIMES), 0.9), 1.0, 2.0) == []


def test_the_cusum_is_excess_distance_summed_over_time_and_never_negative():
    distance = np.where((TIMES >= 20) & (TIMES < 30), 2.0, 0.2)
    sums = cusum(TIMES, distance, 1.0)
    # Ten seconds of one metre too much, then 0.8 m/s less.
    assert sums[TIMES < 20].max() == 0.0
    assert sums.max() == 10.0
    assert abs(sums[TIMES == 35.0][0] - (10.0 - 0.8 * 5.5)) < 1e-9
    assert cusum(TIMES, distance, 1.0, 4.0).max() == 4.0


def test_each_row_counts_for_the_time_since_the_row_before():
    times, distance = np.array([0.0, 1.0, 4.0, 4.5, 6.5]), np.array([9.0, 1.5, 3.0, 0.6, 1.1])
    # 0.5 m for 1 s, 2 m for 3 s, −0.4 m for 0.5 s, 0.1 m for 2 s; the first row has no time before it.
    np.testing.assert_allclose(cusum(times, distance, 1.0), [0.0, 0.5, 6.5, 6.3, 6.5], rtol=1e-12)
