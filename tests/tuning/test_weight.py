"""What a likelihood counts for beside the prior, of errors that last and of recordings that differ."""

import numpy as np
import pytest

import trackwright as tw
from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.tuning.objectives import NegativeLogLikelihood, StateLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.weight import MOST_ROWS, discount

SIGMA = "sensors.gauge.sigma"


def _problem(recordings, objective, weights=None):
    tracker = line_tracker()
    return Problem(tracker, [stack(recordings)], objective, select_parameters(tracker, (SIGMA,)), weights=weights)


def test_independent_readings_all_count_and_recordings_of_unequal_weight_for_fewer():
    made, weights = walks([400, 400], 3), np.array([1.9, 0.1])
    alone, unequal = (_problem(made, NegativeLogLikelihood(), given) for given in (None, [weights]))
    vector = flatten(alone.parameters)
    assert discount(alone, vector, 2) == pytest.approx(1.0, abs=0.2)
    # (Σ w)² / Σ w² of two recordings, Kish's effective number
    expected = 4.0 / 3.62 / 2.0
    assert discount(unequal, vector, 2) / discount(alone, vector, 2) == pytest.approx(expected, rel=1e-6)


def test_a_recording_counts_for_so_many_estimates_at_most():
    objective = StateLogLikelihood(dimensions=1)
    for count in (1, 3):
        problem = _problem(walks([4000] * count, 3), objective)
        vector = flatten(problem.parameters)
        nats = problem.nats_per_unit(problem.evaluate(vector).sums[0]) * discount(problem, vector, count)
        assert 0.8 * MOST_ROWS * count < nats < MOST_ROWS * count


@pytest.mark.parametrize("prior", [pytest.param("flat", marks=pytest.mark.slow), "sites"])
def test_standard_errors_do_not_depend_on_how_far_off_the_start_is(prior):
    made, options = walks([600] * 4, 3), tw.FitOptions(prior=prior)
    near, far = (tw.fit(line_tracker(sigma=sigma), made, "nll", None, options).standard_errors for sigma in (0.3, 3.0))
    assert far[SIGMA] == pytest.approx(near[SIGMA], rel=0.1), "3.4 times as large with the correlation at the start"


@pytest.mark.parametrize(("sigmas", "grows"), [((0.6, 0.6, 0.6), True), ((0.05, 0.2, 0.8), False)])
def test_recordings_that_agree_are_followed_more_and_those_that_contradict_each_other_less(sigmas, grows):
    made = [walk for k, sigma in enumerate(sigmas) for walk in walks([600], 10 + k, sigma=sigma)]
    tracker, options = line_tracker(sigma=0.2), tw.FitOptions(dimensions=1)
    found = tw.fit(tracker, made, "state-nll", SIGMA, options)
    before = discount(found.problem, found.start_vector, 3)
    assert (found.problem.discount / before > 1.0) is grows
    assert (found.problem.discount / before < 1.0) is not grows
    flat = tw.fit(tracker, made, "state-nll", SIGMA, tw.FitOptions(dimensions=1, prior="flat"))
    away, other = (abs(np.log(float(result.values[SIGMA]) / 0.2)) for result in (found, flat))
    assert away < 0.7 * other or grows
    assert away > 0.8 * other or not grows
