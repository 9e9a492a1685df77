"""When a tag has left its line."""

import numpy as np

from trackers.line.leaving import absences, evidence

TIMES = np.arange(0, 60, 0.5)


def test_a_stay_away_begins_where_the_difference_began_and_ends_where_it_is_over():
    apart = np.where((TIMES >= 20) & (TIMES < 30), 2.0, 0.2)
    (stay,) = absences(TIMES, apart, 1.0, 2.0)
    assert TIMES[stay.start] == 20.0
    # Ten seconds of one metre more than the slack fill the sum to its cap of 4 m s, which 0.8 m/s takes 5 s to empty.
    assert abs(TIMES[stay.end] - 34.75) <= 0.25
    assert stay.farthest == 2.0


def test_a_short_or_small_difference_is_no_stay_away():
    assert absences(TIMES, np.where(np.abs(TIMES - 20) < 0.6, 2.0, 0.2), 1.0, 2.0) == []
    assert absences(TIMES, np.full(len(TIMES), 0.9), 1.0, 2.0) == []


def test_one_that_lasts_ends_with_the_recording():
    (stay,) = absences(TIMES, np.where(TIMES >= 40, 3.0, 0.0), 1.0, 2.0)
    assert stay.end == len(TIMES)


def test_rows_without_a_free_estimate_say_nothing():
    apart = np.where((TIMES >= 20) & (TIMES < 30), 2.0, 0.2)
    gaps = np.where((TIMES > 22) & (TIMES < 28), np.nan, apart)
    (stay,) = absences(TIMES, gaps, 1.0, 2.0)
    assert (TIMES[stay.start], stay.farthest) == (20.0, 2.0)
    assert absences(TIMES, np.full(len(TIMES), np.nan), 1.0, 2.0) == []


def test_the_evidence_is_distance_beyond_the_slack_summed_over_time_and_never_negative():
    apart = np.where((TIMES >= 20) & (TIMES < 30), 2.0, 0.2)
    sums = evidence(TIMES, apart, 1.0)
    # Ten seconds of one metre too much, then 0.8 m/s less.
    assert sums[TIMES < 20].max() == 0.0
    assert sums.max() == 10.0
    assert abs(sums[TIMES == 35.0][0] - (10.0 - 0.8 * 5.5)) < 1e-9
    assert evidence(TIMES, apart, 1.0, 4.0).max() == 4.0
