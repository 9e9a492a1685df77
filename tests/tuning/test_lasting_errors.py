"""Size, time constant and length of simulated errors, against the values that they were drawn with."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from trackwright.tuning import lasting_errors as module
from trackwright.tuning.lasting_errors import Series, lasting_errors, log_likelihood, series_of

TRUE = np.array([0.12, 0.05, 12.0, 0.5])
"""σ and ν, rad, τ, s, and ℓ, m."""


def _walk(rng, seconds=150.0, every=0.4):
    """Times, s, and positions, m, of a tag that walks at 0.8 m/s along x, and stops for 2 to 20 s."""
    times = np.arange(0.0, seconds, every)
    spells = rng.uniform(*np.array([[4.0, 2.0], [15.0, 20.0]] * 30).reshape(30, 2, 2).transpose(1, 0, 2))
    walks = np.searchsorted(np.cumsum(spells.ravel()), times) % 2 == 0
    x = np.cumsum(np.where(walks, 0.8 * every, 0.0))
    return times, np.stack([x, 0.0 * x, 0.0 * x], axis=1)


def _factor(times, positions):
    """A Cholesky factor of the dense covariance of the Gauss–Markov errors of a path."""
    sigma, _, time_constant, length = TRUE
    apart = np.abs(times[:, None] - times) / time_constant + np.abs(positions[:, :1] - positions[:, 0]) / length
    return np.linalg.cholesky(sigma**2 * np.exp(-apart) + 1e-12 * np.eye(len(times)))


def _errors(rng, factor):
    return factor @ rng.normal(size=len(factor)) + TRUE[1] * rng.normal(size=len(factor))


def _worlds(count, recordings=3):
    """Sources with errors of the same numbers, each in so many recordings of two and a half minutes."""
    rng = np.random.default_rng(4)
    paths = [(*path, _factor(*path)) for path in (_walk(rng) for _ in range(6))]
    drawn = {}
    for k in range(count):
        chosen = [paths[(k + n) % 6] for n in range(recordings)]
        drawn[str(k)] = [series_of(times, positions, _errors(rng, factor)) for times, positions, factor in chosen]
    return drawn


def _standardised(estimates):
    return np.array([(np.log(x.values) - np.log(TRUE)) / x.sigmas for x in estimates.values()])


def test_known_numbers_are_recovered_within_three_standard_errors():
    assert np.abs(_standardised(lasting_errors(_worlds(8)))).max() < 3.0


@pytest.mark.slow
def test_intervals_hold_90_to_97_percent_of_the_numbers_of_200_worlds():
    inside = np.abs(_standardised(lasting_errors(_worlds(200)))) < 1.96
    assert (inside.mean(axis=0) >= 0.90).all()
    assert 0.90 <= inside.mean() <= 0.97


def test_the_likelihood_is_that_of_the_dense_covariance():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.1, 3.0, 40))
    way = np.cumsum(rng.uniform(0.0, 0.5, 40) * (rng.random(40) < 0.5))
    errors = rng.normal(size=40)
    sigma, noise, time_constant, length = TRUE
    apart = np.abs(times[:, None] - times) / time_constant + np.abs(way[:, None] - way) / length
    expected = multivariate_normal(np.zeros(40), sigma**2 * np.exp(-apart) + noise**2 * np.eye(40)).logpdf(errors)
    short = Series(times[:7], way[:7], errors[:7])
    rows = module.side_by_side([Series(times, way, errors), short])
    values = np.broadcast_to(TRUE[:, None, None], (4, 1, 2))
    assert log_likelihood(rows, values)[0, 0] == pytest.approx(expected, rel=1e-9)


def test_spikes_and_the_noise_of_the_truth_at_rest_change_nothing_that_lasts():
    rng = np.random.default_rng(2)
    drawn = [(*path, _errors(rng, _factor(*path))) for path in (_walk(rng) for _ in range(4))]
    (plain,) = lasting_errors({"": [series_of(*one) for one in drawn]}).values()
    noisy = []
    for times, positions, errors in drawn:
        spikes = 3.0 * (rng.random(len(times)) < 0.02)
        noisy.append(series_of(times, positions + 0.005 * rng.normal(size=positions.shape), errors + spikes))
    (spiked,) = lasting_errors({"": noisy}).values()
    assert (np.abs(np.log(spiked.values / plain.values)) < plain.sigmas).all()


def test_a_tag_that_stands_still_leaves_the_length_at_its_prior():
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 200.0, 0.4)
    positions = np.zeros((len(times), 3))
    (estimate,) = lasting_errors({"": [series_of(times, positions, _errors(rng, _factor(times, positions)))]}).values()
    assert estimate.determined.tolist() == [True, True, True, False]
    assert estimate.values[3] == pytest.approx(module.WAY_M, rel=0.01)


def test_errors_are_thinned_alike_whenever_the_clock_began():
    times, positions, errors = 0.13 * np.arange(90), np.zeros((90, 3)), np.sin(np.arange(90.0))
    first, later = (series_of(times + shift, positions, errors) for shift in (0.0, 0.31))
    np.testing.assert_array_equal(first.errors, later.errors)
