"""NEES against a solver row by row, chi-square against closed forms, consistency against Monte Carlo."""

import math

import numpy as np
import pytest

from trackwright.trackers.core.data.consistency import consistency, nees


@pytest.fixture
def rng():
    return np.random.default_rng(20240611)


def _covariances(rng, n, d):
    factors = rng.normal(size=(n, d, d)) + 2 * np.eye(d)
    return factors @ factors.transpose(0, 2, 1)


def _draws(rng, covs):
    return np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=covs.shape[:2]))


def _even_chi_square_cdf(x, dof):
    """The closed form for even degrees of freedom: one minus a sum of Poisson probabilities."""
    k = np.arange(dof // 2)
    return 1.0 - math.fsum(np.exp(k * math.log(x / 2) - x / 2 - np.array([math.lgamma(j + 1.0) for j in k])))


@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_nees_is_the_quadratic_form_solved_row_by_row(rng, d):
    covs, errors = _covariances(rng, 30, d), rng.normal(size=(30, d))
    expected = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covs, strict=True)]
    # Both are direct solvers in double precision on matrices with condition numbers up to some thousands.
    np.testing.assert_allclose(nees(errors, covs), expected, rtol=1e-9)


def test_nees_is_nan_where_the_covariance_is_singular_and_right_elsewhere(rng):
    covs, errors = _covariances(rng, 4, 3), rng.normal(size=(4, 3))
    alone = nees(errors, covs)
    covs[1, 2, :] = covs[1, :, 2] = 0.0
    covs[2] = np.diag([1.0, -1.0, 1.0])
    values = nees(errors, covs)
    assert np.isnan(values[[1, 2]]).all()
    assert (values[[0, 3]] == alone[[0, 3]]).all()


def test_nees_of_a_damaged_covariance_is_no_number_or_infinite_and_the_others_are_right(rng):
    covs, errors = _covariances(rng, 4, 2), np.ones((4, 2))
    right = nees(errors, covs)
    covs[0] = [[1e-300, 1e200], [1e200, 1.0]]
    values = nees(errors, covs)
    assert not np.isfinite(values[0])
    np.testing.assert_array_equal(values[1:], right[1:])


def test_mean_nees_of_true_covariances_lies_inside_its_bounds_as_often_as_promised(rng):
    studies, runs, d = 2000, 20, 3
    covs = _covariances(rng, runs, d)
    inside = []
    for _ in range(studies):
        interval = consistency(nees(_draws(rng, covs), covs), d)
        inside.append(interval.low <= interval.mean <= interval.high)
    # Four standard errors of a share of 0.95 in 2,000 studies.
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / studies))


def test_bounds_of_values_with_different_dof_are_those_of_their_sum(rng):
    dof = np.array([2.0, 8.0, 5.0, 5.0])
    interval = consistency(np.array([2.0, 8.0, 5.0, 5.0]), dof)
    assert (interval.mean, interval.expected, interval.n) == (5.0, 5.0, 4)
    assert _even_chi_square_cdf(4 * interval.low, 20) == pytest.approx(0.025, abs=1e-9)
    assert _even_chi_square_cdf(4 * interval.high, 20) == pytest.approx(0.975, abs=1e-9)
