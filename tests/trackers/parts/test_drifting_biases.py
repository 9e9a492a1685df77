"""Biases drift with time and with the way covered, at a speed that exceeds its uncertainty."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.oracles import van_loan
from trackwright.trackers.core.model.algebra import Vector, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.parts.drifting_biases import BiasedState, DriftingBiases, damped_velocity

SIGMAS, TIME, LENGTH = np.array([0.1, 0.3]), 9.0, 0.4
N = 2 + 2 + 4


def _motion():
    return DriftingBiases(4, 0.5, 0.2, 3.0, SIGMAS, TIME, LENGTH, "rad")


def _state(*velocity):
    return BiasedState(Vector(1.0, 2.0), Vector(*velocity), Vector(0.1, -0.2, 0.3, 0.4))


def _after(motion, state, dt, w=None):
    return motion.step(state, {}, jnp.asarray(dt), Vector(*(np.zeros(10) if w is None else w)))


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (0.3, -0.4), (1.2, 0.5)])
def test_biases_decay_at_the_rate_of_time_and_way_and_keep_their_variance(velocity):
    dt = 0.7
    kept = np.exp(-dt * (1 / TIME + np.hypot(*velocity) / LENGTH))
    quiet = _after(_motion(), _state(*velocity), dt)
    np.testing.assert_allclose(np.array(quiet.bias.parts, float), kept * np.array([0.1, -0.2, 0.3, 0.4]), rtol=1e-12)
    # In equilibrium what decays is replaced: variance · kept² + noise² = variance, of azimuth and elevation in turn.
    for number in range(4):
        w = np.zeros(10)
        w[6 + number] = 1.0
        noise = float(_after(_motion(), _state(*velocity), dt, w).bias[number] - quiet.bias[number])
        variance = SIGMAS[number % 2] ** 2
        assert variance * kept**2 + noise**2 == pytest.approx(variance, rel=1e-12)


@pytest.mark.parametrize("u", [0.0, 3e-4, 0.01, 0.2, 0.45, 0.499, 0.501, 3.0, 10.0])
def test_a_damped_velocity_is_that_of_its_stochastic_differential_equation(u):
    sigma, memory = 0.7, 4.0
    dt, motion = u * memory, DriftingBiases(0, sigma, 0.2, memory, 0.05, 20.0, 2.0)
    F, Q = van_loan(np.array([[0.0, 1.0], [0.0, -1.0 / memory]]), np.diag([0.0, sigma**2]), dt)

    def moved(x, v, *noise):
        state = BiasedState(Vector(x, 0.0), Vector(v, 0.0), Vector())
        after = motion.step(state, None, jnp.asarray(dt), Vector(noise[0], 0.0, 0.0, noise[1], 0.0, 0.0))
        return np.array([float(after.position[0]), float(after.velocity[0])])

    G = np.column_stack([moved(0.0, 0.0, 1.0, 0.0), moved(0.0, 0.0, 0.0, 1.0)])
    # The oracle halves and doubles to twelve digits; the series' next term is 1e-8 of the sum at most.
    np.testing.assert_allclose(np.column_stack([moved(1.0, 0.0, 0, 0), moved(0.0, 1.0, 0, 0)]), F, rtol=1e-10)
    np.testing.assert_allclose(G @ G.T, Q, rtol=2e-6, atol=1e-14)


def test_gradients_with_respect_to_the_motions_numbers_are_finite_at_dt_zero():
    def moved(log_memory, dt):
        kept, reach, kick, along, across = damped_velocity(dt, jnp.exp(log_memory))
        return kept + reach + kick + along + across

    for dt in (0.0, 1e-4, 3.0):
        assert np.isfinite(jax.grad(moved)(jnp.asarray(1.0), jnp.asarray(dt)))


@pytest.mark.parametrize("as_matrix", [False, True])
def test_the_speed_of_a_belief_is_shrunk_by_its_uncertainty(as_matrix):
    matrix = np.diag([0.1, 0.1, 0.02, 0.03, 1, 1, 1, 1]).astype(float)
    cov = jnp.asarray(matrix) if as_matrix else tuple(jnp.asarray(matrix[i, j]) for i, j in triangle(N))
    for velocity in ((0.3, -0.4), (0.1, 0.1)):
        square = velocity[0] ** 2 + velocity[1] ** 2
        expected = max(square - 0.05, 0.0) / np.sqrt(square)
        state = _state(*(jnp.asarray(v) for v in velocity))
        assert float(_motion().at(Gaussian(state, cov)).speed) == pytest.approx(expected, abs=1e-12)


def test_at_a_belief_the_decay_of_a_bias_is_no_function_of_the_velocity():
    still, moving = _state(0.0, 0.0), _state(0.8, 0.0)
    fixed = _motion().at(Gaussian(moving, jnp.zeros((N, N))))
    decays = [float(_after(fixed, state, 0.5).bias[0]) for state in (still, moving)]
    assert decays[0] == decays[1] == pytest.approx(0.1 * np.exp(-0.5 * (1 / TIME + 0.8 / LENGTH)), rel=1e-12)
