"""Singer's motion against the matrix exponential, over ten decades of step length, in both precisions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.oracles import van_loan
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import Accelerated
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.parts.singer import Singer

SIGMA, TAU = 1.7, 2.5
STEPS = TAU * np.geomspace(1e-6, 1e4, 61)


def _step(motion, flat, w, dt):
    """One step of a one-dimensional Singer motion on flat arrays, in the order p, v, a."""
    p, v, a = flat
    moved = motion.step(Accelerated(Vector(p), Vector(v), Vector(a)), None, dt, Vector.of(w))
    return jnp.stack([moved.position[0], moved.velocity[0], moved.acceleration[0]])


def _factors(dtype):
    """F and the noise factor of every step in STEPS, by automatic differentiation of the step."""
    motion = jax.tree_util.tree_map(lambda x: jnp.asarray(x, dtype), Singer(SIGMA, TAU, 1))
    zero = jnp.zeros(3, dtype)
    both = jax.jacfwd(lambda x, w, dt: _step(freeze(motion), x, w, dt), argnums=(0, 1))
    return jax.jit(jax.vmap(both, in_axes=(None, None, 0)))(zero, zero, jnp.asarray(STEPS, dtype))


@pytest.fixture(scope="module")
def exact():
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / TAU]])
    noise = np.diag([0.0, 0.0, 2 * SIGMA**2 / TAU])
    F, Q = zip(*(van_loan(A, noise, dt) for dt in STEPS), strict=True)
    return np.array(F), np.array(Q)


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-11), (jnp.float32, 3e-6)])
def test_the_transition_is_the_matrix_exponential(exact, dtype, tolerance):
    F, _ = _factors(dtype)
    # The oracle squares a matrix up to fifteen times: 1e-11 is its own error for the longest steps.
    np.testing.assert_allclose(F, exact[0], rtol=tolerance, atol=1e-30)


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-10), (jnp.float32, 1e-5)])
def test_the_noise_has_the_covariance_of_van_loan(exact, dtype, tolerance):
    G = np.asarray(_factors(dtype)[1], float)
    Q = exact[1]
    scale = np.sqrt(np.diagonal(Q, axis1=1, axis2=2))
    error = (G @ G.transpose(0, 2, 1) - Q) / (scale[:, :, None] * scale[:, None, :])
    assert np.abs(error).max() < tolerance


@pytest.mark.parametrize(("dtype", "tolerance"), [(jnp.float64, 1e-8), (jnp.float32, 1e-5)])
def test_the_smallest_pivot_of_the_noise_factor_is_accurate(exact, dtype, tolerance):
    G = np.asarray(_factors(dtype)[1], float)[:, ::-1]
    # A Cholesky factor in the order a, v, p; the pivot of p is 1/36 of its variance, which costs the oracle digits.
    factor = np.linalg.cholesky(exact[1][:, ::-1, ::-1])
    np.testing.assert_allclose(np.diagonal(G, axis1=1, axis2=2), np.diagonal(factor, axis1=1, axis2=2), rtol=tolerance)
    assert np.all(np.triu(G, 1) == 0)


def _moved(log_tau, dt):
    motion = eqx.tree_at(lambda m: m.tau.raw, Singer(SIGMA, TAU, 1), log_tau)
    return _step(motion, jnp.array([0.3, -1.0, 2.0]), jnp.array([0.5, -1.5, 0.8]), dt)


# On either side of the 7.5 s at which the branches of `singer_terms` meet, and at both ends of the range.
@pytest.mark.parametrize("dt", [0.0, 1e-6, 7.4, 7.6, 1e4])
def test_the_derivative_with_respect_to_the_time_constant_is_the_central_difference(dt):
    at, by, moved = np.log(TAU), 1e-5, jax.jit(_moved)
    difference = (moved(at + by, dt) - moved(at - by, dt)) / (2 * by)
    # Truncation is 1e-10 of the third derivative, rounding 1e-11 of the value.
    tolerance = 1e-10 * (1 + float(np.abs(moved(at, dt)).max()))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(_moved))(at, dt), difference, rtol=1e-7, atol=tolerance)
