"""Smoothed mixtures against every sequence of modes, each by dense conditioning of all its rows."""

from itertools import pairwise, product

import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, LinearSensor, flat, recording
from tests.oracles import joint_conditioning, van_loan
from trackwright.trackers.core.filters.imm import InteractingModels, SwitchingMotion
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import ConstantVelocity, Kinematic
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import Tracker

ROWS, SIGMAS, LAG = 8, (0.3, 3.0), 0.9
H, R = np.array([[1.0, 0.0]]), np.array([0.2])
MEAN, COV = np.array([0.5, -0.2]), np.array([[1.0, 0.2], [0.2, 0.6]])
MOTIONS = {"two motions": SwitchingMotion((ConstantVelocity(1.0, 1),) * 2), "one motion": ConstantVelocity(1.0, 1)}


def _rows():
    rng, times = np.random.default_rng(4), 0.3 * np.arange(ROWS)
    # Straight, then a manoeuvre: only later measurements determine the first modes.
    values = 0.3 * times + 2.0 * np.maximum(times - times[3], 0.0) ** 2 + 0.2 * rng.normal(size=ROWS)
    return times, values[:, None], np.ones((ROWS, 1), bool)


def _state(x):
    return Kinematic(Vector(x[0]), Vector(x[1]))


def _tracker(sigmas, rate):
    motion = SwitchingMotion(tuple(ConstantVelocity(s, 1) for s in sigmas))
    modes = InteractingModels(rate, [1.0] * len(sigmas))
    return Tracker(motion, {"z": LinearSensor(H, R, 1)}, KnownStart(_state), modes, NEVER_LOST)


def _smoothed(tracker, lag=None):
    times, values, seen = _rows()
    return Smoothed(tracker, lag).run(recording(times, {"z": (values, seen)}, MEAN, COV))


def _enumerated(sigmas, rate, lag=None):
    """Exact means and covariances of all rows but the first, over every sequence of modes between them."""
    times, values, seen = _rows()
    steps = np.diff(times)
    until = [len(steps) - 1 if lag is None else int(np.sum(times[1:] <= t + lag)) - 1 for t in times[1:]]
    sequences = list(product(range(len(sigmas)), repeat=len(steps))) if rate else [(k,) * len(steps) for k in (0, 1)]
    weights, means, covs = [], [], []
    for modes in sequences:
        links = [
            van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, sigmas[k] ** 2]), dt)
            for k, dt in zip(modes, steps, strict=True)
        ]
        mean, cov, _ = joint_conditioning(links, H, np.diag(R**2), values[1:], seen[1:], MEAN, COV, until)
        single = joint_conditioning(links, H, np.diag(R**2), values[1:], seen[1:], MEAN, COV)[2]
        kept = np.exp(-rate * steps[1:])
        chain = [0.5 * (1 - k) + k * (a == b) for k, (a, b) in zip(kept, pairwise(modes), strict=True)]
        # What is known of the sequence at row t: its chance, and the readings up to the last one that the row may use.
        known = np.log(0.5) + np.sum(np.log(chain)) + np.cumsum(single)[until]
        weights.append(known)
        means.append(mean)
        covs.append(cov)
    w = np.exp(np.array(weights) - np.logaddexp.reduce(weights, axis=0))[..., None]
    mean = np.sum(w * means, axis=0)
    deviations = np.array(means) - mean
    return mean, np.sum(w[..., None] * (np.array(covs) + deviations[..., :, None] * deviations[..., None, :]), axis=0)


@pytest.mark.parametrize(
    "lag", [pytest.param(None, id="fixed interval"), pytest.param(LAG, id="fixed lag", marks=pytest.mark.slow)]
)
def test_without_switching_the_smoothed_mixture_is_every_mode_smoothed_and_weighed_by_its_likelihood(lag):
    estimates = _smoothed(_tracker(SIGMAS, 1e-9), lag)
    means, covs = _enumerated(SIGMAS, 0.0, lag)
    # Switches at 1e-9 per second, absent from the enumeration, have a weight of that order.
    np.testing.assert_allclose(flat(estimates.mean)[1:], means, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(estimates.covariance[1:], covs, rtol=1e-6, atol=1e-6)


def test_with_switching_the_smoothed_mixture_is_nearer_the_enumeration_of_all_128_sequences_than_the_filters():
    tracker = _tracker(SIGMAS, 0.2)
    means, covs = _enumerated(SIGMAS, 0.2)
    times, values, seen = _rows()
    filtered, smoothed = tracker.run(recording(times, {"z": (values, seen)}, MEAN, COV)), _smoothed(tracker)
    spread = np.sqrt(np.einsum("tii->ti", covs))
    off = np.abs(flat(smoothed.mean)[1:] - means) / spread
    # Collapsed moments and Kim's approximation of the modes are not exact: the error of the method.
    assert off.max() < 0.3
    assert off[:-1].mean() < 0.2 * (np.abs(flat(filtered.mean)[1:] - means) / spread)[:-1].mean()
    np.testing.assert_allclose(np.sqrt(np.einsum("tii->ti", smoothed.covariance[1:])), spread, rtol=0.3)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_one_model_under_two_names_is_smoothed_as_the_plain_filter(motion):
    sensor, start = {"z": LinearSensor(H, R, 1)}, KnownStart(_state)
    expected = _smoothed(Tracker(ConstantVelocity(1.0, 1), sensor, start, track_loss=NEVER_LOST))
    mixture = _smoothed(Tracker(motion, sensor, start, InteractingModels(0.8, [1.0, 2.0]), NEVER_LOST))
    np.testing.assert_allclose(flat(mixture.mean), flat(expected.mean), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mixture.covariance, expected.covariance, rtol=1e-9, atol=1e-9)
