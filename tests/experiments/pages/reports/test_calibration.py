"""The report of a calibration: errors before and after, as it counts them, and its charts."""

import numpy as np

from trackwright.experiments.pages.reports.calibration import Report, Source, calibration_charts
from trackwright.trackers.recordings.calibration import AnchorCalibration, Calibration
from trackwright.tuning.calibration_pairs import Pairs


def _source(true, error, positions=None, number=None):
    values, none = np.asarray(true)[:, None], np.zeros(len(true), int)
    positions = np.zeros((len(true), 3)) if positions is None else positions
    pairs = Pairs(
        values, values + np.asarray(error)[:, None], positions, none if number is None else number, *[none] * 5
    )
    return Source("anchors", "A", "range", 0, pairs)


def _charts(source):
    """The chart of readings and the one over the floor, of an anchor without errors."""
    calibration = Calibration(anchors={"A": AnchorCalibration(np.zeros(2), np.eye(2), np.array([0.0, 9.0]))})
    ((readings,), (floor,)) = calibration_charts(calibration, Report({}, [source], ""))["anchors"]
    return readings, floor


def test_a_short_recording_counts_as_much_as_a_long_one_in_the_spread_of_errors():
    errors = np.array([0.1, -1.0, -0.3, 0.2, np.nan, 0.4])
    number = np.array([0, 1, 0, 0, 0, 0])
    source = _source(np.zeros(6), errors, number=number)
    # Half of the weight is that of the one row of 1 m: it holds the percentiles above the 50th.
    assert source.spread(errors) == 1.0
    assert source.spread(np.where(number == 0, errors, np.nan)) == 0.3
    assert np.isnan(source.spread(np.full(6, np.nan)))


def test_every_reading_but_the_wildest_lies_inside_its_chart():
    readings, _ = _charts(_source(np.linspace(1.0, 9.0, 400), np.linspace(-0.3, 0.5, 400)))
    low, high = readings.limits("y")
    assert -1.3 < low < -0.25
    assert 0.45 < high < 1.5


def test_a_floor_that_is_wide_is_drawn_low():
    def height(width, depth):
        positions = np.random.default_rng(0).uniform(0.0, [width, depth, 0.0], (200, 3))
        _, floor = _charts(_source(positions[:, 0] + 1.0, np.full(200, 0.1), positions))
        return floor.size[1]

    assert height(12.0, 6.0) < height(6.0, 6.0) < height(6.0, 8.0)
