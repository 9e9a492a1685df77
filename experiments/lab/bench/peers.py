"""The same filter in dynamax, cuthbert and filterpy, each used as documented.

All have the textbook version's input: wrapped differences of all antenna pairs, masks and a known start. They are extra
dependencies (`pip install trackwright[peers]`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cuthbert
import jax
import jax.numpy as jnp
import numpy as np
from cuthbert.gaussian import moments
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter
from filterpy.kalman import ExtendedKalmanFilter

from experiments.lab.bench.textbook import Pairs, both_seen, noise, predicted, transition, wrap


def with_dynamax(pairs: Pairs, sigma_a: float, sigma_p: float) -> Callable[..., Any]:
    """`extended_kalman_filter` under `vmap`; wraps and masks are inputs of the emission function."""

    def one(phases: Any, seen: Any, dt: Any, mean: Any, cov: Any) -> Any:
        differences = phases @ jnp.asarray(pairs.take).T
        usable = jax.vmap(lambda s: both_seen(pairs, s))(seen)
        F, Q = transition(dt[-1], sigma_a)

        def emission(x: Any, inputs: Any) -> Any:
            read, use = inputs[: len(pairs.take)], inputs[len(pairs.take) :]
            return read - use * wrap(read - predicted(pairs, x))

        parameters = ParamsNLGSSM(
            initial_mean=mean,
            initial_covariance=cov,
            dynamics_function=lambda x, inputs: F @ x,
            dynamics_covariance=Q,
            emission_function=emission,
            emission_covariance=jax.vmap(lambda u: noise(pairs, u, sigma_p))(usable),
        )
        inputs = jnp.concatenate([differences, usable.astype(jnp.float32)], axis=1)
        posterior = extended_kalman_filter(parameters, differences, inputs)
        return posterior.filtered_means, posterior.filtered_covariances, posterior.marginal_loglik

    return jax.jit(jax.vmap(one))


def with_cuthbert(pairs: Pairs, sigma_a: float, sigma_p: float) -> Callable[..., Any]:
    """The moment-linearising filter in square-root form, under `vmap`; NaN marks masked differences."""
    count = len(pairs.take)
    full = sigma_p**2 * pairs.take @ pairs.take.T + 1e-3 * np.eye(count)
    root = jnp.asarray(np.linalg.cholesky(full), jnp.float32)

    def one(phases: Any, seen: Any, dt: Any, mean: Any, cov: Any) -> Any:
        F, _ = transition(dt[-1], sigma_a)
        eye = jnp.eye(2, dtype=jnp.float32)
        G = sigma_a * jnp.concatenate([0.5 * dt[-1] ** 2 * eye, dt[-1] * eye])
        noise_root = jnp.concatenate([G, jnp.zeros((4, 2), jnp.float32)], axis=1)

        def dynamics(state: Any, inputs: Any) -> Any:
            return (lambda x: (F @ x, noise_root)), state.mean

        def observation(state: Any, inputs: Any) -> Any:
            phases, seen = inputs
            expected = predicted(pairs, state.mean)
            read = expected + wrap(jnp.asarray(pairs.take) @ phases - expected)
            read = jnp.where(both_seen(pairs, seen), read, jnp.nan)
            return (lambda x: (predicted(pairs, x), root)), state.mean, read

        kalman = moments.build_filter(mean, jnp.linalg.cholesky(cov), dynamics, observation)
        states = cuthbert.filter(kalman, (phases, seen), kalman.init_prepare())
        return states.mean[1:], states.chol_cov[1:], states.log_normalizing_constant

    return jax.jit(jax.vmap(one))


def with_filterpy(pairs: Pairs, sigma_a: float, sigma_p: float) -> Callable[..., Any]:
    """`ExtendedKalmanFilter` in double precision, one trajectory after the other; masked pairs are left out."""
    take, wavenumbers = (np.asarray(x, float) for x in pairs)
    full = sigma_p**2 * take @ take.T + 1e-3 * np.eye(len(take))

    def residual(read: np.ndarray, expected: np.ndarray) -> np.ndarray:
        difference = read - expected
        return difference - 2 * np.pi * np.round(difference / (2 * np.pi))

    def measure(x: np.ndarray, use: np.ndarray) -> np.ndarray:
        return wavenumbers[use] @ np.array([np.sin(x[0]) * np.cos(x[1]), np.sin(x[1])])

    def jacobian(x: np.ndarray, use: np.ndarray) -> np.ndarray:
        direction = [[np.cos(x[0]) * np.cos(x[1]), -np.sin(x[0]) * np.sin(x[1])], [0.0, np.cos(x[1])]]
        return np.hstack([wavenumbers[use] @ np.array(direction), np.zeros((int(use.sum()), 2))])

    def run(phases: np.ndarray, seen: np.ndarray, dt: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> Any:
        means, covs = np.empty((*dt.shape, 4)), np.empty((*dt.shape, 4, 4))
        for trajectory in range(len(dt)):
            kalman = ExtendedKalmanFilter(4, len(take))
            kalman.x, kalman.P = mean[trajectory].astype(float), cov[trajectory].astype(float)
            for row, step in enumerate(dt[trajectory].astype(float)):
                kalman.F = np.block([[np.eye(2), step * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
                G = sigma_a * np.concatenate([0.5 * step * step * np.eye(2), step * np.eye(2)])
                kalman.Q = G @ G.T
                kalman.predict()
                use = np.abs(take) @ ~seen[trajectory, row] < 0.5
                if use.any():
                    read = take[use] @ phases[trajectory, row].astype(float)
                    R = full[np.ix_(use, use)]
                    kalman.update(read, jacobian, measure, R=R, args=(use,), hx_args=(use,), residual=residual)
                means[trajectory, row], covs[trajectory, row] = kalman.x, kalman.P
        return means, covs

    return run
