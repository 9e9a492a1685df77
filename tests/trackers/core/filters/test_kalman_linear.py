"""On linear models the engine is the exact Bayesian filter: against dense conditioning and the textbook recursion.

The readings are sparse, their times irregular with several rows at one time, the recordings ragged.
"""

import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, LinearSensor, flat, recording
from tests.oracles import joint_conditioning, kalman, van_loan
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import Accelerated, ConstantVelocity, Kinematic
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.singer import Singer

LANES, ROWS = 6, 10


class Case:
    """A model, what the engine says of random recordings, and what they hold for the oracles."""

    def __init__(self, motion, build, A, noise, m):
        rng, n = np.random.default_rng(len(A) + m), len(A)
        self.H, self.sigmas = rng.normal(size=(m, n)), rng.uniform(0.1, 0.5, m)
        factor = rng.normal(size=(n, n))
        self.mean, self.cov = rng.normal(size=n), factor @ factor.T + np.eye(n)
        self.trajectories = []
        for trajectory in range(LANES):
            # A quarter of the rows share their time with the row before.
            steps = rng.exponential(0.4, ROWS - trajectory) * (rng.random(ROWS - trajectory) > 0.25)
            values, seen = rng.normal(size=(len(steps), m)) * 3, rng.random((len(steps), m)) > 0.4
            self.trajectories.append((np.cumsum(steps), values, seen))
        tracker = Tracker(motion, {"z": LinearSensor(self.H, self.sigmas, m)}, KnownStart(build), track_loss=NEVER_LOST)
        self.estimates = tracker.run(
            stack([recording(t, {"z": (z, seen)}, self.mean, self.cov) for t, z, seen in self.trajectories])
        )
        self.A, self.noise = A, noise

    def oracle(self, trajectory, method):
        times, values, seen = self.trajectories[trajectory]
        transitions = [van_loan(self.A, self.noise, dt) for dt in np.diff(times)]
        return method(transitions, self.H, np.diag(self.sigmas**2), values[1:], seen[1:], self.mean, self.cov)

    def trajectory(self, trajectory):
        """The engine's rows after the first, which only starts the track."""
        e, rows = self.estimates[trajectory], slice(1, len(self.trajectories[trajectory][0]))
        return flat(e.mean)[rows], e.covariance[rows], e.log_likelihood[rows], e.nis[rows], e.nis_dof[rows]


def _constant_velocity(d, m):
    A = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(d))
    noise = np.kron([[0.0, 0.0], [0.0, 0.7**2]], np.eye(d))
    return Case(ConstantVelocity(0.7, d), lambda x: Kinematic(Vector(*x[:d]), Vector(*x[d:])), A, noise, m)


def _singer(d, m):
    A = np.kron([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / 0.8]], np.eye(d))
    noise = np.kron(np.diag([0.0, 0.0, 2 * 1.3**2 / 0.8]), np.eye(d))
    build = lambda x: Accelerated(Vector(*x[:d]), Vector(*x[d : 2 * d]), Vector(*x[2 * d :]))  # noqa: E731
    return Case(Singer(1.3, 0.8, d), build, A, noise, m)


@pytest.fixture(
    scope="module",
    params=[(_constant_velocity, 1, 3), (_constant_velocity, 2, 3), (_constant_velocity, 3, 2), (_singer, 1, 2)],
    ids=["1-D, more channels than states", "2-D", "3-D", "singer"],
)
def case(request):
    build, d, m = request.param
    return build(d, m)


@pytest.mark.parametrize("method", [joint_conditioning, kalman])
def test_means_covariances_and_log_likelihoods_are_those_of_the_oracle(case, method):
    for trajectory in range(LANES):
        means, covs, log_likelihoods = case.oracle(trajectory, method)[:3]
        mean, cov, log_likelihood, _, _ = case.trajectory(trajectory)
        # Both sides work with condition numbers of about 1e3.
        np.testing.assert_allclose(mean, means, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(cov, covs, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(log_likelihood, log_likelihoods, rtol=1e-9, atol=1e-9)


def test_the_nis_is_the_textbooks_and_counts_the_channels_seen(case):
    for trajectory in range(LANES):
        _, _, _, nis, nis_dof = case.trajectory(trajectory)
        np.testing.assert_allclose(nis, case.oracle(trajectory, kalman)[3], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(nis_dof, case.trajectories[trajectory][2][1:].sum(axis=1))
