"""Priors: normal densities of unconstrained values, said in physical ones."""

import numpy as np
import pytest
from scipy import stats

from trackwright.trackers.core.model.tunable import Covariance, Fraction, Real, Scale
from trackwright.tuning.parameters import Parameter
from trackwright.tuning.priors import Prior, penalty

PARAMETERS = [
    Parameter(("sensors.a.sigma_p", "sensors.b.sigma_p"), Scale(0.5, "rad"), "sensors.*.sigma_p"),
    Parameter(("filter.halting",), Fraction(0.3), "filter.halting"),
    Parameter(("sensors.a.offsets",), Real(np.array([0.1, -0.2]), "rad", typical=0.1), "sensors.a.offsets"),
]
PRIORS = [
    Prior("sensors.a.sigma_p", 0.2, factor=2.0),
    Prior("*.halting", 0.6, factor=3.0),
    Prior("*offsets", 0.05, deviation=0.3),
]


def _density(vector):
    sigma, fraction, *offsets = np.exp(vector[0]), 1 / (1 + np.exp(-vector[1])), *(0.1 * vector[2:])
    odds = fraction / (1 - fraction)
    # of the logarithm, not of the number itself: what is estimated is the unconstrained value
    return (
        stats.norm(np.log(0.2), np.log(2.0)).logpdf(np.log(sigma))
        + stats.norm(np.log(1.5), np.log(3.0)).logpdf(np.log(odds))
        + stats.norm(0.05, 0.3).logpdf(offsets).sum()
    )


def test_the_penalty_is_the_negative_log_density_with_its_derivatives():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(5, 4))
    found = penalty(PRIORS, PARAMETERS, vectors)
    differences = [_density(vectors[0]) - _density(v) for v in vectors]
    np.testing.assert_allclose(found.values - found.values[0], differences, atol=1e-12)
    shifts = 1e-5 * np.eye(4)
    for k, v in enumerate(vectors):
        numeric = [(_density(v - s) - _density(v + s)) / 2e-5 for s in shifts]
        np.testing.assert_allclose(found.gradients[k], numeric, atol=1e-8)


@pytest.mark.parametrize(
    ("prior", "says"),
    [
        (Prior("nothing", 1.0, factor=2.0), "matches nothing"),
        (Prior("*.sigma_p", 1.0, deviation=2.0), "as '0.2x2'"),
        (Prior("*offsets", 1.0, factor=2.0), r"as '0\+-0.1'"),
        (Prior("*.sigma_p", -1.0, factor=2.0), "positive"),
        (Prior("matrix", 1.0, factor=2.0), "is a matrix"),
    ],
)
def test_a_prior_that_does_not_fit_is_refused(prior, says):
    matrix = Parameter(("matrix",), Covariance(np.eye(2)), "matrix")
    with pytest.raises(ValueError, match=says):
        penalty([prior], [*PARAMETERS, matrix], np.zeros((1, 8)))
