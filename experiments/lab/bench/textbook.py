"""The beam tracker as textbooks write it, under `vmap`: the benchmark's reference.

All wrapped phase differences (28 of 8 antennas), their singular covariance with a jitter, a Cholesky factor and two
solves per step, and the Joseph form: equations (5) to (17) of Will et al. 2020 line by line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

JITTER = 1e-3
"""Added to the variance of every difference, rad²; makes the Cholesky factor exist in single precision."""


class Pairs(NamedTuple):
    """Differences of all antenna pairs: `take` (m, n) forms them, `wavenumbers` (m, 2), rad, predict them."""

    take: np.ndarray
    wavenumbers: np.ndarray


def all_pairs(antennas: np.ndarray, wavelength: float) -> Pairs:
    """The n(n − 1)/2 pairs of an array; `antennas` (n, 2) and `wavelength` in m."""
    first, second = np.triu_indices(len(antennas), 1)
    take = np.zeros((len(first), len(antennas)), np.float32)
    rows = np.arange(len(first))
    take[rows, first], take[rows, second] = 1.0, -1.0
    return Pairs(take, (2 * np.pi / wavelength * take @ antennas).astype(np.float32))


def wrap(angle: Any) -> Any:
    """The angle wrapped to [−π, π], rad."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def transition(dt: Any, sigma_a: float) -> tuple[Any, Any]:
    """F and Q of equations (5) and (6); state: azimuth, elevation and their rates."""
    eye = jnp.eye(2, dtype=jnp.float32)
    F = jnp.block([[eye, dt * eye], [0 * eye, eye]])
    G = jnp.concatenate([0.5 * dt * dt * eye, dt * eye])
    return F, sigma_a**2 * G @ G.T


def predicted(pairs: Pairs, x: Any) -> Any:
    """Predicted differences (m,), rad, equation (9), not wrapped."""
    direction = jnp.stack([jnp.sin(x[0]) * jnp.cos(x[1]), jnp.sin(x[1])])
    return jnp.asarray(pairs.wavenumbers) @ direction


def both_seen(pairs: Pairs, seen: Any) -> Any:
    """Mask (m,) of the pairs with both antennas seen."""
    return jnp.abs(jnp.asarray(pairs.take)) @ (1.0 - seen.astype(jnp.float32)) < 0.5


def noise(pairs: Pairs, usable: Any, sigma_p: float) -> Any:
    """Covariance of the differences; unusable pairs have unit variance and no correlation."""
    full = sigma_p**2 * pairs.take @ pairs.take.T + JITTER * np.eye(len(pairs.take))
    return jnp.where(usable[:, None] & usable[None], full.astype(np.float32), jnp.diag(jnp.where(usable, 0.0, 1.0)))


def textbook(pairs: Pairs, sigma_a: float, sigma_p: float) -> Callable[..., Any]:
    """The filter of a batch of trajectories: phases (B, T, n), seen (B, T, n), dt (B, T), mean (B, 4), cov (B, 4, 4).

    Returns mean, covariance, NIS and log-likelihood of every row.
    """

    def step(carry: Any, row: Any) -> tuple[Any, Any]:
        (x, P), (phases, seen, dt) = carry, row
        F, Q = transition(dt, sigma_a)
        x, P = F @ x, F @ P @ F.T + Q
        usable = both_seen(pairs, seen)
        H = jnp.where(usable[:, None], jax.jacfwd(lambda x: predicted(pairs, x))(x), 0.0)
        innovation = jnp.where(usable, wrap(jnp.asarray(pairs.take) @ phases - predicted(pairs, x)), 0.0)
        R = noise(pairs, usable, sigma_p)
        factor = jax.scipy.linalg.cho_factor(H @ P @ H.T + R)
        K = jax.scipy.linalg.cho_solve(factor, H @ P).T
        x = x + K @ innovation
        rest = jnp.eye(4, dtype=jnp.float32) - K @ H
        P = rest @ P @ rest.T + K @ R @ K.T
        nis = innovation @ jax.scipy.linalg.cho_solve(factor, innovation)
        log_determinant = 2.0 * jnp.sum(jnp.log(jnp.diag(factor[0])))
        density = -0.5 * (nis + log_determinant + jnp.sum(usable) * jnp.log(2 * jnp.pi))
        return (x, P), (x, P, nis, density)

    def one(phases: Any, seen: Any, dt: Any, mean: Any, cov: Any) -> Any:
        return jax.lax.scan(step, (mean, cov), (phases, seen, dt))[1]

    return jax.jit(jax.vmap(one))
