"""The prior of a fit: densities of unconstrained values, said in physical ones."""

import numpy as np
from scipy import stats

from trackwright.trackers.core.model.tunable import Covariance, Fraction, Real, Scale
from trackwright.tuning.parameters import Parameter, Prior

PARAMETERS = [
    Parameter(("sensors.a.sigma_p", "sensors.b.sigma_p"), Scale(0.5, "rad"), "sensors.*.sigma_p"),
    Parameter(("sensors.a.dof",), Scale(4.0), "sensors.a.dof"),
    Parameter(("filter.halting",), Fraction(0.3), "filter.halting"),
    Parameter(("sensors.a.latency",), Real(0.1, "s", typical=0.05), "sensors.a.latency"),
    Parameter(("sensors.a.offsets",), Real(np.array([0.1, -0.2]), "rad", typical=0.1), "sensors.a.offsets"),
    Parameter(("matrix",), Covariance(np.eye(2)), "matrix"),
]


def _density(vector):
    """Of the logarithms of positive numbers, of the logit of a fraction, and of others in their unit or typical size."""
    return (
        stats.t(3, np.log(0.5), 0.35).logpdf(vector[0])
        + stats.t(3, np.log(4.0), 0.5).logpdf(vector[1])
        + stats.t(3, np.log(0.3 / 0.7), 0.35).logpdf(vector[2])
        + stats.t(3, 0.1, 1.0).logpdf(0.05 * vector[3])
        + stats.t(3, [0.1, -0.2], 0.1).logpdf(0.1 * vector[4:6]).sum()
    )


def test_the_penalty_is_the_negative_log_density_with_its_derivatives():
    vectors = np.random.default_rng(0).normal(size=(5, 10))
    found = Prior.of(PARAMETERS).penalty(vectors)
    differences = [_density(vectors[0]) - _density(v) for v in vectors]
    np.testing.assert_allclose(found.values - found.values[0], differences, atol=1e-12)
    for k, v in enumerate(vectors):
        numeric = [(_density(v - s) - _density(v + s)) / 2e-5 for s in 1e-5 * np.eye(10)]
        np.testing.assert_allclose(found.gradients[k], numeric, atol=1e-7)
