"""The band of a perfect filter on worlds of known correlation, and energy scores against sampling."""

import math

import numpy as np
import pytest

from trackwright.trackers.evaluation.judge import LEAST_SAMPLES, band, correlation_time, energy_scores, whitened

WORLDS = 400


def _errors(rng, rows, step, lasts):
    """Unit normal errors (WORLDS, rows, 2) whose correlation falls by e every `lasts` s."""
    a = math.exp(-step / lasts)
    x = rng.normal(size=(WORLDS, rows, 2))
    for k in range(1, rows):
        x[:, k] = a * x[:, k - 1] + math.sqrt(1 - a * a) * x[:, k]
    return x


def _judged(worlds, factor=1.0):
    """Effective samples of each world, and whether NEES/dof of errors times `factor` lies in the band."""
    rows = worlds.shape[1]
    samples = np.array([rows / correlation_time(factor * x, np.array([0, rows])) for x in worlds])
    low, high = band(samples, 2)
    ratio = factor**2 * (worlds**2).mean(axis=(1, 2))
    return samples, (low <= ratio) & (ratio <= high)


@pytest.mark.parametrize(
    ("rows", "step", "lasts"), [(400, 0.5, 0.6), (200, 0.5, 2.0), (400, 0.5, 5.0), (150, 0.5, 5.0), (900, 1.0, 30.0)]
)
def test_the_band_holds_a_perfect_filter_in_95_of_100_worlds_and_none_that_is_wrong_by_two(rows, step, lasts):
    worlds = _errors(np.random.default_rng(5), rows, step, lasts)
    samples, inside = _judged(worlds)
    long = samples >= LEAST_SAMPLES
    assert long.mean() > 0.8
    assert 0.92 <= inside[long].mean() <= 0.985
    for factor in (0.5, 2.0):
        assert _judged(worlds, factor)[1][long].mean() < 0.1


def test_the_band_holds_a_kalman_filter_of_its_own_model():
    rng, rows, q, r = np.random.default_rng(6), 500, 0.02, 1.0
    state, mean, variance = np.zeros((WORLDS, 2)), np.zeros((WORLDS, 2)), 1e-6
    errors, variances = np.empty((WORLDS, rows, 2)), np.empty(rows)
    for k in range(rows):
        state = state + math.sqrt(q) * rng.normal(size=state.shape)
        gain = (variance + q) / (variance + q + r)
        mean = mean + gain * (state + math.sqrt(r) * rng.normal(size=state.shape) - mean)
        variance = (1 - gain) * (variance + q)
        errors[:, k], variances[k] = mean - state, variance
    samples, inside = _judged(errors / np.sqrt(variances)[:, None])
    assert samples.min() > LEAST_SAMPLES
    assert 0.92 <= inside.mean() <= 0.98


def test_effective_samples_are_those_of_the_known_correlation():
    worlds = _errors(np.random.default_rng(7), 2000, 0.5, 2.0)
    a = math.exp(-2 * 0.5 / 2.0)
    assert np.median(_judged(worlds[:50])[0]) == pytest.approx(2000 * (1 - a) / (1 + a), rel=0.06)


def test_whitened_errors_have_the_nees_as_their_square():
    error, cov = np.array([[1.0, 1.0]]), np.array([[[1.0, 0.5], [0.5, 1.0]]])
    assert (whitened(error, cov) ** 2).sum() == pytest.approx(4 / 3)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("smallest", [1.0, 0.1, 1e-3])
@pytest.mark.parametrize("size", [0.0, 1.0, 20.0])
def test_energy_scores_are_those_of_samples(dimensions, smallest, size):
    rng = np.random.default_rng(8)
    root = np.linalg.qr(rng.normal(size=(dimensions, dimensions)))[0] * np.linspace(1.0, smallest, dimensions)
    x, y = (rng.normal(size=(400_000, dimensions)) @ root.T for _ in range(2))
    error = np.full(dimensions, size / math.sqrt(dimensions))
    sampled = np.linalg.norm(x + error, axis=1) - 0.5 * np.linalg.norm(x - y, axis=1)
    (found,) = energy_scores(error[None], (root @ root.T)[None])
    assert found == pytest.approx(sampled.mean(), abs=5 * sampled.std() / math.sqrt(len(sampled)))


def test_the_energy_score_along_one_axis_is_the_closed_form():
    for x in (0.0, 0.3, 4.0):
        inside = math.erf(x / math.sqrt(2))
        expected = x * inside + 2 * math.exp(-x * x / 2) / math.sqrt(2 * math.pi) - 1 / math.sqrt(math.pi)
        assert energy_scores(np.array([[x]]), np.ones((1, 1, 1)))[0] == pytest.approx(expected, abs=1e-9)
