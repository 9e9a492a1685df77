"""The band, the density and the autocorrelation of NIS, and the spread that a scale of Student's t implies."""

import numpy as np
import pytest
from scipy import stats

from trackwright.tuning.diagnostics import (
    Innovations,
    autocorrelation,
    expected_density,
    nis_band,
    nis_probabilities,
    normal_scores,
    student_t_spread,
)


def _innovations(scale: float, seed: int = 0, trajectories: int = 4, rows: int = 300) -> Innovations:
    """χ² values with two and three degrees of freedom by turns, times `scale`."""
    rng = np.random.default_rng(seed)
    dof = np.tile([2.0, 3.0], trajectories * rows // 2)
    return Innovations(scale * rng.chisquare(dof), dof, np.repeat(np.arange(trajectories), rows))


@pytest.mark.parametrize(("nu", "skew"), [(None, 1.0), (1.8, 4.0), (4.0, 1.0)])
def test_means_of_nis_lie_in_the_band_of_the_noise_that_made_them(nu, skew):
    rng = np.random.default_rng(1)
    # Residuals of a two-piece density, each half over its own scale, as `RangeSensor` whitens them.
    up = rng.random((4000, 50)) < skew / (1 + skew)
    raw = np.abs(rng.normal(size=up.shape) if nu is None else rng.standard_t(nu, up.shape)) * np.where(up, skew, -1)
    square = np.where(raw > 0, raw / skew, raw) ** 2
    mean = (square if nu is None else square * (nu + 1) / (nu + square)).mean(axis=1)
    assert mean.mean() == pytest.approx(1.0, abs=0.01)
    low, high = nis_band(np.full(len(mean), 50.0), nu)
    assert np.mean((low <= mean) & (mean <= high)) == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize(("dof", "skew"), [(30.0, 1.0), (6.0, 3.0), (1.8, 4.0), (1.0, 1.0)])
def test_the_spread_is_that_of_draws(dof, skew):
    rng = np.random.default_rng(4)
    up = rng.random(2_000_000) < skew / (1 + skew)
    drawn = 0.02 * np.abs(rng.standard_t(dof, len(up))) * np.where(up, skew, -1.0)
    found = student_t_spread(0.02, dof, skew)
    assert found.is_deviation is (dof > 2)
    expected = drawn.std() if found.is_deviation else np.subtract(*np.quantile(drawn, [0.84, 0.16])) / 2
    assert found.value == pytest.approx(expected, rel=0.02)


def test_probabilities_and_scores_are_those_of_scipy():
    seen = _innovations(1.3)
    np.testing.assert_allclose(nis_probabilities(seen), stats.chi2.cdf(seen.nis, seen.dof), rtol=1e-9)
    # the inverse of a probability near 1 has its rounding times a few thousand
    np.testing.assert_allclose(normal_scores(seen), stats.norm.ppf(stats.chi2.cdf(seen.nis, seen.dof)), atol=1e-8)


def test_the_density_is_the_mixture_of_the_rows_degrees_of_freedom():
    x = np.linspace(0.1, 9, 5)
    wanted = 0.75 * stats.chi2.pdf(x, 2) + 0.25 * stats.chi2.pdf(x, 5)
    seen = Innovations(np.ones(4), np.array([2.0, 5.0, 2.0, 2.0]), np.zeros(4, int))
    np.testing.assert_allclose(expected_density(x, seen), wanted, rtol=1e-12)


def test_the_density_and_probability_of_noise_with_a_tail_belong_together():
    edges = np.linspace(0.01, 12, 4001)
    seen = Innovations(edges, np.full(len(edges), 2.0), np.zeros(len(edges), int), student_t_dof=4.0)
    middle = 0.5 * (edges[1:] + edges[:-1])
    same = np.zeros(len(middle), int)
    density = expected_density(middle, Innovations(middle, np.full(len(middle), 2.0), same, student_t_dof=4.0))
    # the middle rule's own error over 4,000 steps
    np.testing.assert_allclose(
        np.cumsum(density) * (edges[1] - edges[0]), nis_probabilities(seen)[1:] - nis_probabilities(seen)[0], atol=1e-4
    )


def test_the_density_of_a_heavy_tail_is_finite_and_ends():
    x = np.linspace(0.01, 12, 500)
    seen = Innovations(x, np.ones(len(x)), np.zeros(len(x), int), student_t_dof=1.8)
    density = expected_density(x, seen)
    assert np.isfinite(density).all()
    # The NIS of a row with one degree of freedom is below 1 + 1.8.
    assert (density[x < 2.8] > 0).all()
    assert (density[x > 2.8] == 0).all()


def test_autocorrelation_is_that_of_the_model_and_stops_at_the_end_of_a_trajectory():
    rng = np.random.default_rng(0)
    z = np.zeros(20_000)
    for k in range(1, len(z)):
        z[k] = 0.6 * z[k - 1] + 0.8 * rng.normal()
    nis = stats.chi2.ppf(stats.norm.cdf(z), 2)
    trajectory = np.repeat(np.arange(4), 5_000)
    found, pairs = autocorrelation(Innovations(nis, np.full(len(nis), 2.0), trajectory), 5)
    # standard error of each about 0.01
    np.testing.assert_allclose(found, 0.6 ** np.arange(1, 6), atol=0.04)
    assert pairs == 4 * 4_999
    alone, none = autocorrelation(Innovations(nis[:9], np.full(9, 2.0), np.arange(9)), 3)
    assert np.isnan(alone).all()
    assert none == 0
