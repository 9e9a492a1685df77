"""Robust regressions with clustered errors: they do not depend on the unit of the errors."""

import numpy as np
import pytest
from scipy.optimize import minimize

from trackwright.tuning.clustered_regression import Regression, Rows, regressions, with_least_slope


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_terms_covariance_and_scale_have_the_unit_of_the_errors_outliers_included(unit):
    rng = np.random.default_rng(0)
    rows = 300
    x = np.column_stack([np.ones(rows), rng.uniform(-1, 1, rows)])
    y = x @ [0.3, -0.2] + 0.1 * rng.standard_t(2, rows)
    number = np.arange(rows)
    prior = np.array([0.05, 0.0]), np.array([0.5, 0.4])

    def fitted(scale):
        of_place = Rows(x, y * scale, number // 150, number // 10, number // 25)
        return regressions({"A": of_place}, prior[0] * scale, prior[1] * scale)["A"]

    one, other = fitted(1.0), fitted(unit)
    np.testing.assert_allclose(other.terms, one.terms * unit, rtol=1e-6)
    np.testing.assert_allclose(other.covariance, one.covariance * unit**2, rtol=1e-6)
    assert other.scale == pytest.approx(one.scale * unit, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_terms_of_too_small_a_slope_become_the_nearest_that_have_it(seed):
    rng = np.random.default_rng(seed)
    root, slopes = rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
    found = Regression(rng.normal(size=3), root @ root.T + np.eye(3), 1.0)
    least = float(np.max(slopes @ found.terms)) + 0.3
    nearest = minimize(
        lambda d: d @ np.linalg.solve(found.covariance, d), np.zeros(3), method="SLSQP", options={"ftol": 1e-14},
        constraints={"type": "ineq", "fun": lambda d: slopes @ (found.terms + d) - least},
    )  # fmt: skip
    moved = with_least_slope(found, slopes, least)
    np.testing.assert_allclose(moved.terms, found.terms + nearest.x, atol=1e-5)
    assert with_least_slope(found, slopes, float(np.min(slopes @ found.terms))) is found
