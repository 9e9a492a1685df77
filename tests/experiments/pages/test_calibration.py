"""The report of a calibration: errors before and after, as it counts them."""

import numpy as np

from trackwright.experiments.pages.calibration import Source
from trackwright.tuning.calibrating import Pairs


def _source(true, error, number):
    values = np.asarray(true)[:, None]
    pairs = Pairs(values, values + np.asarray(error)[:, None], np.zeros((len(true), 3)), number, *[number] * 5)
    return Source("anchors", "A", "range", 0, pairs)


def test_a_short_recording_counts_as_much_as_a_long_one_in_the_spread_of_errors():
    errors, number = np.array([0.1, -1.0, -0.3, 0.2, np.nan, 0.4]), np.array([0, 1, 0, 0, 0, 0])
    source = _source(np.zeros(6), errors, number)
    # Half of the weight is that of the one row of 1 m: it holds the percentiles above the 50th.
    assert source.spread(errors) == 1.0
    assert source.spread(np.where(number == 0, errors, np.nan)) == 0.3
    assert np.isnan(source.spread(np.full(6, np.nan)))
