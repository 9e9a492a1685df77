"""The update by quadrature over the position: against Bayes' rule on a dense grid, and what it leaves alone."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm
from scipy.stats import t as student_t

from tests.known_start import Still
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.quadrature import AbstractPlaceSensor, AtPoints, QuadratureKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian, as_scalars, matrix
from trackwright.trackers.core.model.sensor import Channel, Reading, independent
from trackwright.trackers.parts.drifting_biases import BiasedState

MEAN = np.array([1.0, 2.0, 0.3, -0.2, 0.4, -0.6])
"""Position, velocity and two biases."""


def _covariance():
    factor = np.random.default_rng(3).normal(size=(6, 6)) * [[0.12], [0.1], [0.2], [0.2], [0.4], [0.4]]
    return factor @ factor.T


COV = _covariance()


class Wavy(AbstractPlaceSensor):
    """An azimuth and an elevation from the origin, with errors that are functions of the place."""

    dof: float

    @property
    def channels(self):
        return Channel("azimuth", "rad"), Channel("elevation", "rad")

    def parts(self, x, y):
        """Prediction without the bias, its factor and the noise, for each channel."""
        azimuth = jnp.arctan2(y, x + 2.0) + 0.1 * jnp.sin(2.0 * x)
        elevation = jnp.arctan2(jnp.ones_like(x), jnp.hypot(x + 2.0, y))
        return (
            (azimuth, 0.15 + 0.05 * jnp.cos(y), 0.1 + 0.04 * jnp.sin(x + y)),
            (elevation, 0.0 * x, 0.2 + 0.05 * jnp.cos(x)),
        )

    def measure(self, view, inputs):
        return [f + s * b for (f, s, _), b in zip(self.parts(*view.position), view.bias, strict=True)]

    def residual(self, reading, predicted):
        return independent([z - p for z, p in zip(reading.values, predicted, strict=True)], [0.1, 0.2], reading.seen)

    def biases(self, view, inputs):
        return list(view.bias)

    def at_points(self, reading, inputs, x, y):
        parts = zip(reading.values, self.parts(x, y), strict=True)
        return [AtPoints(z - f, s, sigma, self.dof) for z, (f, s, sigma) in parts]


def _belief(few=True):
    x = [jnp.asarray(value) for value in MEAN]
    cov = jnp.asarray(COV)
    return Gaussian(BiasedState(Vector(*x[:2]), Vector(*x[2:4]), Vector(*x[4:])), cov if few else as_scalars(cov))


def _updated(values, seen, dof, points=5, few=True):
    reading = Reading([jnp.asarray(z) for z in values], [jnp.asarray(s) for s in seen])
    after, innovation = QuadratureKalman(points).update(_belief(few), Still(), Wavy(dof), reading, {})
    state = after.mean
    return np.array([*state.position, *state.velocity, *state.bias]), np.asarray(matrix(after.cov)), innovation


def _exact(channel, value, dof):
    """Mean, covariance and log-likelihood after one channel, by a grid of x, y and the bias; others by regression."""
    parts = [0, 1, 4 + channel]
    z = np.stack(np.meshgrid(*[np.linspace(-7.0, 7.0, 141)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = MEAN[parts] + z @ np.linalg.cholesky(COV[np.ix_(parts, parts)]).T
    f, s, sigma = (np.asarray(a) for a in Wavy(dof).parts(nodes[:, 0], nodes[:, 1])[channel])
    density = norm.logpdf(z).sum(axis=1) + student_t.logpdf((value - f - s * nodes[:, 2]) / sigma, dof) - np.log(sigma)
    log_likelihood = logsumexp(density) + 3.0 * np.log(0.1)
    weights = np.exp(density - logsumexp(density))
    mean = weights @ nodes
    spread = (weights[:, None] * (nodes - mean)).T @ (nodes - mean)
    gain = COV[:, parts] @ np.linalg.inv(COV[np.ix_(parts, parts)])
    cov = COV + gain @ (spread - COV[np.ix_(parts, parts)]) @ gain.T
    return MEAN + gain @ (mean - MEAN[parts]), cov, log_likelihood


# With a bias the exact posterior is that of normal noise: of Student's t the filter reweights it once, as the EKF does.
@pytest.mark.parametrize(
    ("channel", "value", "dof"),
    [pytest.param(0, 0.9, 1e6, marks=pytest.mark.slow), (0, 0.3, 1e6), (1, 0.6, 1.0), (1, 1.4, 3.0)],
)
def test_one_channel_is_bayes_rule_on_a_dense_grid(channel, value, dof):
    values, seen = [0.0, 0.0], [False, False]
    values[channel], seen[channel] = value, True
    mean, cov, log_likelihood = _exact(channel, value, dof)
    scale = np.sqrt(np.diag(COV))
    for points, within in ((31, 2e-4), (5, 0.05)):
        found_mean, found_cov, innovation = _updated(values, seen, dof, points)
        np.testing.assert_allclose(found_mean / scale, mean / scale, atol=within)
        np.testing.assert_allclose(found_cov / np.outer(scale, scale), cov / np.outer(scale, scale), atol=2 * within)
        assert float(innovation.log_likelihood) == pytest.approx(log_likelihood, abs=2 * within)


def test_two_channels_are_one_after_the_other_in_both_forms_of_a_covariance():
    mean, cov, innovation = _updated([0.9, 0.6], [True, True], 2.0)
    other_mean, other_cov, other = _updated([0.9, 0.6], [True, True], 2.0, few=False)
    np.testing.assert_allclose(other_mean, mean, rtol=1e-12)
    np.testing.assert_allclose(other_cov, cov, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(other, innovation, rtol=1e-12)
    assert float(innovation.nis_dof) == 2.0
    assert np.linalg.eigvalsh(cov).min() > 0.0


def test_masked_channels_change_nothing_to_the_bit():
    mean, cov, innovation = _updated([0.9, 0.6], [False, False], 2.0)
    np.testing.assert_array_equal(mean, MEAN)
    np.testing.assert_array_equal(cov, COV)
    assert [float(x) for x in innovation] == [0.0] * 4
    # What a masked channel holds has no effect.
    one, other = (_updated([0.9, value], [True, False], 2.0) for value in (0.6, 1e3))
    np.testing.assert_array_equal(one[0], other[0])
    np.testing.assert_array_equal(one[1], other[1])


def test_with_a_straight_sensor_and_normal_noise_it_is_the_kalman_filter():
    class Straight(Wavy):
        def parts(self, x, y):
            one = jnp.ones_like(x)
            return (0.5 * x - 0.2 * y, 0.3 * one, 0.3 * one), (y, 0.0 * one, 0.4 * one)

        def residual(self, reading, predicted):
            differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
            return independent(differences, [jnp.asarray(0.3), jnp.asarray(0.4)], reading.seen)

    reading = Reading([jnp.asarray(0.4), jnp.asarray(2.2)], [jnp.asarray(True)] * 2)
    sensor = Straight(1e7)
    after, innovation = QuadratureKalman(31).update(_belief(), Still(), sensor, reading, {})
    expected, of_ekf = ExtendedKalman().update(_belief(), Still(), sensor, reading, {})
    for name in ("position", "velocity", "bias"):
        np.testing.assert_allclose(getattr(after.mean, name).array(), getattr(expected.mean, name).array(), atol=1e-6)
    np.testing.assert_allclose(after.cov, expected.cov, atol=1e-6)
    np.testing.assert_allclose(innovation, of_ekf, rtol=1e-5)
