"""Sweeps over grids of values: what the fit's own objective says at each, repeats, and grids that can't be swept."""

import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.sweeping import Sweep, sweep

NLL = NegativeLogLikelihood()
SIGMA_V, SIGMA = "motion.sigma_v", "sensors.gauge.sigma"
STEPS = np.geomspace(0.1, 0.9, 5)
NOISES = np.array([0.1, 0.2, 0.4])


@pytest.fixture(scope="module")
def batches():
    return [stack(walks([130, 140, 125], 1)), stack(walks([260, 250], 2))]


@pytest.fixture(scope="module")
def swept(batches):
    counted = []
    return sweep(line_tracker(), batches, NLL, {SIGMA_V: STEPS, SIGMA: NOISES}, report=counted.append), counted


def test_every_value_is_the_objective_that_a_fit_sees_there(swept, batches):
    parameters = select_parameters(line_tracker(), (SIGMA_V, SIGMA))
    problem = Problem(line_tracker(), batches, NLL, parameters, 512)
    vectors = [np.log([step, noise]) for step in STEPS for noise in NOISES]
    wanted = problem.evaluate(np.array(vectors)).values.reshape(5, 3)
    # double precision, sums in another order
    np.testing.assert_allclose(swept[0].mean, wanted, rtol=1e-10)


def test_the_best_value_is_the_least_and_lies_where_the_walks_were_drawn(swept):
    found = swept[0]
    assert found.mean[found.best_index] == found.mean.min()
    # drawn with 0.3 and 0.2: both are values of the grid
    assert found.best == {SIGMA_V: pytest.approx(0.3), SIGMA: pytest.approx(0.2)}


@pytest.mark.slow
def test_a_threshold_of_track_loss_is_swept_by_name_and_none_is_left_to_a_fit(batches):
    found = sweep(line_tracker(), batches, NLL, {"track_loss.max_gap": np.array([1e-3, np.inf])})
    # a gap of 1 ms is every row: the track is lost at each, and nothing is measured
    assert np.isfinite(found.values[0, 1])
    assert not found.values[0, 0] < found.values[0, 1]
    assert [p.label for p in select_parameters(line_tracker(), "*")] == [
        "motion.sigma_v",
        "sensors.gauge.sigma",
        "sensors.gauge.offset",
        "sensors.gauge.bias",
    ]


def test_the_spread_is_the_sample_standard_deviation_of_two_repeats():
    repeats = np.array([[1.0, 5.0], [4.0, 5.0]])
    found = Sweep([], [np.array([0.1, 0.2])], repeats, 4)
    # of two numbers: their distance over the root of two
    np.testing.assert_allclose(found.spread, [3 / np.sqrt(2), 0.0])
