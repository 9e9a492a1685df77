"""Scores of single rows against finite differences of a textbook filter's log-likelihoods."""

import numpy as np
import pytest

from tests.oracles import kalman
from tests.tuning.worlds import SIGMA_START, line_tracker, walks
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.covariance import FEW
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem
from trackwright.tuning.row_information import row_information

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")
STEP = 1e-5


def _rows(r, vector):
    """The textbook filter's log-likelihood of each row; zero for the first, which starts the track."""
    sigma_v, sigma = np.exp(vector)
    moves = [(np.eye(1), np.array([[sigma_v**2 * dt]])) for dt in np.diff(r.times)]
    gauge = r.readings["gauge"]
    start = np.zeros(1), np.eye(1) * SIGMA_START**2
    log_likelihoods = kalman(moves, np.eye(1), np.array([[sigma**2]]), gauge.values[1:], gauge.seen[1:], *start)[2]
    return np.concatenate([[0.0], log_likelihoods])


@pytest.fixture(scope="module", params=[1, 3], ids=["few", "many"])
def world(request):
    recordings = walks([30, 45, 12] * request.param, 3)
    tracker = line_tracker()
    parameters = select_parameters(tracker, LEVELS)
    return recordings, Problem(tracker, [stack(recordings)], NegativeLogLikelihood(), parameters)


@pytest.mark.parametrize("block", [1, 7])
def test_scores_and_information_are_those_of_the_textbook_filter(world, block):
    recordings, problem = world
    vectors = flatten(problem.parameters) + np.array([[0.0, 0.0], [0.7, -0.4]])
    found = row_information(problem, vectors, block)
    assert found.information.shape[:3] == (2, 2, 2)
    assert not found.scores[..., len(recordings) :].any(), "padding trajectories have no scores"
    if len(recordings) > FEW:
        assert found.information.shape[3] > len(recordings)
    for s, vector in enumerate(vectors):
        for n, recording in enumerate(recordings):
            differences = [
                (_rows(recording, vector + shift) - _rows(recording, vector - shift)) / (2 * STEP)
                for shift in STEP * np.eye(2)
            ]
            starts = np.arange(0, len(recording), block)
            blocked = np.add.reduceat(np.array(differences), starts, axis=1)
            # the differences' own error, step² and rounding / step, is about 1e-10
            np.testing.assert_allclose(found.scores[s, :, n], blocked.sum(axis=1), rtol=1e-6, atol=1e-8)
            np.testing.assert_allclose(found.information[s, ..., n], blocked @ blocked.T, rtol=1e-6, atol=1e-8)
            assert found.log_likelihoods[s, n] == pytest.approx(_rows(recording, vector).sum(), rel=1e-12)
