"""Robust regressions with clustered errors: they do not depend on the unit of the errors."""

import numpy as np
import pytest

from tuning.clustered_regression import Rows, regressions


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
