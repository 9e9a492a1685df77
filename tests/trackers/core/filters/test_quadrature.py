"""The update by quadrature over the position: against Bayes' rule on a dense grid, and what it leaves alone."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm
from scipy.stats import t as student_t

from tests.known_start import Still
from trackwright.trackers.core.filters.quadrature import AbstractPlaceSensor, AtPoints, QuadratureKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian, as_scalars, matrix
from trackwright.trackers.core.model.sensor import Channel, Reading
from trackwright.trackers.parts.drifting_biases import BiasedState

MEAN = np.array([1.0, 2.0, 0.3, -0.2, 0.4, -0.6])  # position, velocity and two biases
_FACTOR = np.random.default_rng(3).normal(size=(6, 6)) * [[0.12], [0.1], [0.2], [0.2], [0.4], [0.4]]
COV = _FACTOR @ _FACTOR.T
SCALE = np.sqrt(np.diag(COV))


class Wavy(AbstractPlaceSensor):
    """An azimuth and an elevation from the origin, with errors that are functions of the place."""

    dof: float
    channels = Channel("azimuth", "rad"), Channel("elevation", "rad")
    measure = residual = None

    def parts(self, x, y):
        """Prediction without the bias, its factor and the noise, for each channel."""
        azimuth = jnp.arctan2(y, x + 2.0) + 0.1 * jnp.sin(2.0 * x)
        first = azimuth, 0.15 + 0.05 * jnp.cos(y), 0.1 + 0.04 * jnp.sin(x + y)
        return first, (jnp.arctan2(1.0, jnp.hypot(x + 2.0, y)), 0.0 * x, 0.2 + 0.05 * jnp.cos(x))

    def biases(self, view, inputs):
        return list(view.bias)

    def at_points(self, reading, inputs, x, y):
        parts = zip(reading.values, self.parts(x, y), strict=True)
        return [AtPoints(z - f, s, sigma, self.dof) for z, (f, s, sigma) in parts]


def _updated(values, seen, dof, points=5, few=True):
    x, cov = [jnp.asarray(value) for value in MEAN], jnp.asarray(COV)
    state = BiasedState(Vector(*x[:2]), Vector(*x[2:4]), Vector(*x[4:]))
    reading = Reading([jnp.asarray(z) for z in values], [jnp.asarray(s) for s in seen])
    belief = Gaussian(state, cov if few else as_scalars(cov))
    after, innovation = QuadratureKalman(points).update(belief, Still(), Wavy(dof), reading, {})
    return np.array([float(x) for part in after.mean for x in part]), np.asarray(matrix(after.cov)), innovation


def _exact(channel, value, dof):
    """Mean, covariance and log-likelihood after one channel, by a grid of x, y and the bias; others by regression."""
    parts = [0, 1, 4 + channel]
    z = np.stack(np.meshgrid(*[np.linspace(-7.0, 7.0, 141)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = MEAN[parts] + z @ np.linalg.cholesky(COV[np.ix_(parts, parts)]).T
    f, s, sigma = (np.asarray(a) for a in Wavy(dof).parts(nodes[:, 0], nodes[:, 1])[channel])
    density = norm.logpdf(z).sum(axis=1) + student_t.logpdf((value - f - s * nodes[:, 2]) / sigma, dof) - np.log(sigma)
    weights = np.exp(density - logsumexp(density))
    mean = weights @ nodes
    spread = (weights[:, None] * (nodes - mean)).T @ (nodes - mean)
    gain = COV[:, parts] @ np.linalg.inv(COV[np.ix_(parts, parts)])
    cov = COV + gain @ (spread - COV[np.ix_(parts, parts)]) @ gain.T
    return MEAN + gain @ (mean - MEAN[parts]), cov, logsumexp(density) + 3.0 * np.log(0.1)


# With a bias the exact posterior is that of normal noise: of Student's t the filter reweights it once, as the EKF does.
@pytest.mark.slow
@pytest.mark.parametrize(("channel", "value", "dof"), [(0, 0.3, 1e6), (1, 0.6, 1.0), (1, 1.4, 3.0)])
def test_one_channel_is_bayes_rule_on_a_dense_grid(channel, value, dof):
    values, seen = [value, value], [k == channel for k in range(2)]
    mean, cov, log_likelihood = _exact(channel, value, dof)
    for points, within in ((31, 2e-4), (5, 0.05)):
        found_mean, found_cov, innovation = _updated(values, seen, dof, points)
        np.testing.assert_allclose(found_mean / SCALE, mean / SCALE, atol=within)
        np.testing.assert_allclose(found_cov / np.outer(SCALE, SCALE), cov / np.outer(SCALE, SCALE), atol=2 * within)
        assert float(innovation.log_likelihood) == pytest.approx(log_likelihood, abs=2 * within)


def test_both_forms_of_a_covariance_agree_and_masked_channels_change_nothing():
    mean, cov, innovation = _updated([0.9, 0.6], [True, True], 2.0)
    other_mean, other_cov, other = _updated([0.9, 0.6], [True, True], 2.0, few=False)
    np.testing.assert_allclose(other_mean, mean, rtol=1e-12)
    np.testing.assert_allclose(other_cov, cov, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(other, innovation, rtol=1e-12)
    assert float(innovation.nis_dof) == 2.0
    mean, cov, innovation = _updated([0.9, 1e3], [False, False], 2.0)
    np.testing.assert_array_equal(mean, MEAN)
    np.testing.assert_array_equal(cov, COV)
    assert [float(x) for x in innovation] == [0.0] * 4
