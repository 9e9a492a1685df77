"""The steps of many starts: which end, and how often a failing step is tried."""

from itertools import pairwise

import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.optimisation import LBFGS, MultiStart
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")
ANYWHERE = np.full(2, -np.inf), np.full(2, np.inf)


@pytest.fixture(scope="module")
def problem():
    tracker = line_tracker()
    return Problem(tracker, [stack(walks([60] * 4, 2))], NegativeLogLikelihood(), select_parameters(tracker, LEVELS))


class Overshooting(LBFGS):
    """Steps down the slope, far too long."""

    def propose(self, state, vectors, gradients):
        return -1e3 * gradients / np.linalg.norm(gradients, axis=1, keepdims=True), state


def _evaluated(problem, monkeypatch):
    """The vectors of all evaluations from here on."""
    evaluate, seen = Problem.evaluate, []

    def recorded(self, vectors, *args, **kwargs):
        seen.extend(np.atleast_2d(vectors))
        return evaluate(self, vectors, *args, **kwargs)

    monkeypatch.setattr(Problem, "evaluate", recorded)
    return seen


def test_of_two_starts_that_meet_the_worse_one_ends(problem):
    driver, start = MultiStart(problem, LBFGS(), 20, *ANYWHERE), flatten(problem.parameters)
    state = driver.init(start + np.array([[0.0, 0.0], [0.02, 0.0], [1.5, -1.5]]))
    state = driver.step(state)
    assert state.active.tolist() in ([True, False, True], [False, True, True])
    better = int(np.argmin(state.values[:2]))
    assert state.active[better]


def test_a_failed_step_is_shortened_at_once_to_where_a_parabola_has_its_minimum(problem, monkeypatch):
    driver, start = MultiStart(problem, Overshooting(), 5, *ANYWHERE), flatten(problem.parameters)
    state = driver.init(start)
    seen = _evaluated(problem, monkeypatch)
    after = driver.step(state)
    lengths = [np.linalg.norm(v - start) for v in seen]
    assert lengths[0] == pytest.approx(1e3)
    assert all(0.1 * a <= b * (1 + 1e-9) and b <= 0.5 * a * (1 + 1e-9) for a, b in pairwise(lengths))
    assert after.values[0] <= state.values[0]


def test_the_first_step_of_l_bfgs_has_length_one_down_the_slope():
    start, slope = np.array([[1.0, -0.5]]), np.array([[0.025, -0.09]])
    step, _ = LBFGS().propose(LBFGS().init(start), start, slope)
    np.testing.assert_allclose(step, -slope / np.linalg.norm(slope), rtol=1e-6)
