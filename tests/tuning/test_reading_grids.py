"""Steps and repetitions of readings, found from made-up readings of which both are known."""

import math

import numpy as np
import pytest

import trackwright as tw
from tests.tuning.worlds import line_tracker, walks
from trackers.core.recording import Readings, Recording, stack
from trackers.core.rig import Station
from tuning.parameters import select_parameters
from tuning.reading_grids import floors, reading_grids

SIGMA = "sensors.gauge.sigma"


def _gauge(values, seen=None):
    """A recording of a gauge with these values at 10 Hz."""
    values = np.asarray(values, float)
    (made,) = walks([len(values)], 1)
    seen = np.ones(len(values), bool) if seen is None else seen
    return Recording(made.times, {"gauge": Readings(values[:, None], seen[:, None])}, made.inputs)


def test_the_step_of_rounded_readings_is_found_in_single_precision():
    rng = np.random.default_rng(1)
    values = 0.0349 * np.round(rng.normal(0, 8, 2000)) + 0.7
    (grid,) = reading_grids(line_tracker(), [stack([_gauge(values)], dtype=np.float32)])
    assert grid.step == pytest.approx(0.0349, rel=1e-4)
    assert grid.floor == pytest.approx(0.0349 / math.sqrt(12), rel=1e-4)


def test_readings_without_a_grid_have_no_step():
    rng = np.random.default_rng(2)
    (grid,) = reading_grids(line_tracker(), [stack([_gauge(np.repeat(rng.normal(size=400), 5))])])
    assert math.isnan(grid.step)
    assert grid.repeated == pytest.approx(0.8, abs=0.01)
    unread = _gauge(np.zeros(20), np.zeros(20, bool))
    assert reading_grids(line_tracker(), [stack([unread])]) == []


def test_repetitions_are_counted_within_a_trajectory_and_over_missing_rows():
    values, seen = np.repeat(np.arange(50.0), 4), np.ones(200, bool)
    seen[1::4] = False
    # of three values seen in each run of four, two repeat
    (grid,) = reading_grids(line_tracker(), [stack([_gauge(values, seen)] * 3)])
    assert grid.repeated == pytest.approx(100 / 149)
    assert (grid.sensor, grid.unit) == ("gauge", "m")


def test_repetitions_are_those_of_each_station():
    n = 400
    rng = np.random.default_rng(3)
    # two stations in turn, each value four times
    azimuth = np.repeat(rng.normal(size=(n // 8, 2)), 4, axis=0).reshape(-1)
    elevation = 0 * azimuth
    stations = {
        k: Station(np.array([x, 0.0, 2.0]), np.array([1.0, 0.0, 0.0, 0.0])) for k, x in (("a", 0.0), ("b", 5.0))
    }
    bearings = np.stack([azimuth, elevation], axis=1)
    recording = tw.bearing_recording(0.05 * np.arange(n), bearings, ["a", "b"] * (n // 2), stations)
    grids = reading_grids(tw.bearing_tracker(2), [stack([recording])])
    assert grids[0].repeated == pytest.approx(0.75, abs=0.01)


def test_noise_levels_have_the_rounding_as_their_lower_bound_unless_bounded():
    rng = np.random.default_rng(4)
    recording = _gauge(0.2 * np.round(rng.normal(0, 3, 500)))
    tracker = line_tracker()
    parameters = select_parameters(tracker, ["motion.sigma_v", SIGMA])
    grids = reading_grids(tracker, [stack([recording])])
    assert floors(grids, parameters, {}) == pytest.approx([-np.inf, np.log(0.2 / np.sqrt(12))], rel=1e-4)
    assert floors(grids, parameters, {SIGMA: (0.01, 1.0)})[1] == -np.inf
