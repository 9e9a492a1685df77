"""Detection of a tag that leaves its line."""

import numpy as np

from trackwright.experiments.lab.papers.line_thesis.leaving_line import cusum

TIMES = np.arange(0, 60, 0.5)


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
