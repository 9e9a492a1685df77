"""The chi-square distribution against closed forms and scipy's."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import gammainc

from trackwright.trackers.core.data.consistency import chi_square_probability, chi_square_quantile


def _even_cdf(x, dof):
    """The closed form for even degrees of freedom: one minus a sum of Poisson probabilities."""
    k = np.arange(dof // 2)
    return 1.0 - math.fsum(np.exp(k * math.log(x / 2) - x / 2 - np.array([math.lgamma(j + 1.0) for j in k])))


@pytest.mark.parametrize("dof", [0.3, 1, 2, 3, 6.5, 17, 400])
def test_the_probability_is_that_of_scipy(dof):
    values = np.concatenate([[0.0], np.geomspace(1e-12, 1e6, 500)])
    np.testing.assert_allclose(chi_square_probability(values, dof), gammainc(dof / 2, values / 2), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dof", [2, 4, 8, 60, 1000, 40_000])
@pytest.mark.parametrize("probability", [1e-4, 0.025, 0.5, 0.68, 0.975, 0.9999])
def test_the_quantile_inverts_the_closed_form_for_even_dof(dof, probability):
    x = chi_square_quantile(probability, dof)
    # The sum of 20,000 terms of the closed form itself is good to about 1e-10.
    assert _even_cdf(x, dof) == pytest.approx(probability, abs=1e-9)
