"""Errors of simulated IMUs: their stated statistics at irregular times."""

import numpy as np

from trackwright.sim.corruptions import constant_bias, random_walk, white_density
from trackwright.sim.keys import trajectory_keys

N = 4000
KEYS = trajectory_keys(0, np.arange(N))
TIMES = np.array([2.0, 2.1, 2.6, 4.0, 4.02, 9.0])
IDEAL = np.zeros((N, len(TIMES), 3))
SEEN = np.ones(IDEAL.shape, bool)


def _covariance(corruption):
    values = corruption(KEYS, TIMES, IDEAL, SEEN)[0].transpose(0, 2, 1).reshape(-1, len(TIMES))
    return values.T @ values / len(values)


def _assert_within_chance(found, expected):
    # Of 12,000 series a covariance is known to sqrt((C_ii C_jj + C_ij²) / 12,000), here five of these.
    variances = np.diagonal(expected)
    error = np.sqrt((np.outer(variances, variances) + expected**2) / (3 * N))
    assert np.all(np.abs(found - expected) <= 5 * error)


def test_the_variance_of_a_random_walk_grows_with_the_time_since_the_first_sample():
    since = TIMES - TIMES[0]
    _assert_within_chance(_covariance(random_walk(0.3)), 0.3**2 * np.minimum(since[:, None], since))


def test_a_noise_density_gives_white_noise_whose_variance_falls_with_the_interval():
    intervals = np.array([0.1, 0.1, 0.5, 1.4, 0.02, 4.98])
    _assert_within_chance(_covariance(white_density(0.3)), np.diag(0.3**2 / intervals))


def test_a_constant_bias_is_one_number_per_axis_and_tag():
    values = constant_bias(0.3)(KEYS, TIMES, IDEAL, SEEN)[0]
    np.testing.assert_array_equal(values, np.broadcast_to(values[:, :1], values.shape))
    _assert_within_chance(_covariance(constant_bias(0.3)), np.full((6, 6), 0.3**2))
    between = values[:, 0].T @ values[:, 0] / N
    assert np.abs(between - np.diag(np.diagonal(between))).max() < 5 * 0.3**2 / np.sqrt(N)
