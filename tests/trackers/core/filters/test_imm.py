"""Interacting models: several are the textbook's K² mixing."""

import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, LinearSensor, flat, recording
from tests.oracles import normal_log_density, van_loan
from trackwright.trackers.core.filters.imm import InteractingModels, SwitchingMotion
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.run.tracker import Tracker

SIGMAS, RATE, ODDS = (0.1, 1.0, 5.0), 0.8, (2.0, 1.0, 1.0)
H, R = np.array([[1.0, 0.0], [0.3, 1.0]]), np.array([0.2, 0.4])
MEAN, COV = np.array([0.5, -0.2]), np.array([[1.0, 0.2], [0.2, 0.6]])


def _state(x):
    return Kinematic(Vector(x[0]), Vector(x[1]))


def _rows(seed=0, rows=12):
    rng = np.random.default_rng(seed)
    # A third of the rows share their time with the row before.
    times = np.cumsum(rng.exponential(0.4, rows) * (rng.random(rows) > 0.33))
    return times, rng.normal(size=(rows, 2)), rng.random((rows, 2)) > 0.3


def _run(motion, modes, copies=1):
    times, values, seen = _rows()
    sensors = {"z": LinearSensor(H, R, 2)}
    tracker = Tracker(motion, sensors, KnownStart(_state), modes, NEVER_LOST)
    return tracker.run([recording(times, {"z": (values, seen)}, MEAN, COV)] * copies)[0]


def _transition(sigma, dt):
    return van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, sigma**2]), dt)


def _textbook(sigmas, rate, mode_prior):
    """Bar-Shalom 2001, section 11.6.6, with all K² mixing probabilities and rows really deleted."""
    times, values, seen = _rows()
    K, shares = len(sigmas), np.array(mode_prior) / np.sum(mode_prior)
    means, covs, weights = np.tile(MEAN, (K, 1)), np.tile(COV, (K, 1, 1)), shares
    out = []
    for dt, z, s in zip(np.diff(times), values[1:], seen[1:], strict=True):
        kept = np.exp(-rate * dt)
        P = kept * np.eye(K) + (1 - kept) * shares
        c = weights @ P
        mixing = weights[:, None] * P / c
        mixed = mixing.T @ means
        deviations = means[:, None] - mixed[None]
        spread = [
            sum(mixing[i, j] * (covs[i] + np.outer(deviations[i, j], deviations[i, j])) for i in range(K))
            for j in range(K)
        ]
        lls = np.zeros(K)
        for j in range(K):
            F, Q = _transition(sigmas[j], dt)
            m, C = F @ mixed[j], F @ spread[j] @ F.T + Q
            h, r = H[s], np.diag(R[s] ** 2)
            S, e = h @ C @ h.T + r, z[s] - h @ m
            gain = C @ h.T @ np.linalg.inv(S)
            means[j], covs[j], lls[j] = m + gain @ e, C - gain @ S @ gain.T, normal_log_density(e, S)
        joint = c * np.exp(lls)
        weights = joint / joint.sum()
        mean = weights @ means
        cov = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in zip(weights, means, covs, strict=True))
        out.append((mean, cov, np.log(joint.sum())))
    return tuple(np.array(x) for x in zip(*out, strict=True))


# Few trajectories have covariances as matrices, many as scalars.
@pytest.mark.parametrize("copies", [1, 16])
def test_three_models_are_the_textbooks_with_every_pair_mixed(copies):
    motion = SwitchingMotion(tuple(ConstantVelocity(s, 1) for s in SIGMAS))
    three = _run(motion, InteractingModels(RATE, ODDS), copies)
    means, covs, lls = _textbook(SIGMAS, RATE, ODDS)
    np.testing.assert_allclose(flat(three.mean)[1:], means, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(three.covariance[1:], covs, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(three.log_likelihood[1:], lls, rtol=1e-10, atol=1e-12)


def test_a_filter_without_modes_sees_the_first_motion():
    switching = SwitchingMotion(tuple(ConstantVelocity(s, 1) for s in (0.7, 9.0)))
    default = Tracker.__dataclass_fields__["filter"].default
    np.testing.assert_array_equal(
        flat(_run(switching, default).mean), flat(_run(ConstantVelocity(0.7, 1), default).mean)
    )
