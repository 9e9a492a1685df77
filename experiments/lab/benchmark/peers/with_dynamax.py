"""dynamax's extended Kalman smoother, each update linearised three times, in double precision."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter, extended_kalman_smoother
from model import Path, Problem, diffusion

UNSEEN, PASSES = 1e4, 3
"""Standard deviation of a channel that was not seen: dynamax has no missing values; linearisations of an update."""


def prepared(p: Problem) -> Any:
    """A function of the levels that returns the smoothed path, and compiles when it is first called."""
    m, (mean, P), z = p.values.shape[1], map(jnp.asarray, p.beginning), jnp.asarray(p.values)
    # What dynamax calls the input of a row has the step to the next row, the geometry and the reading of its own.
    inputs = jnp.asarray(np.column_stack([np.append(p.steps[1:], 0.0), p.geometry, p.values]))

    def moved(x: Any, u: Any) -> Any:
        return x.at[: p.d].add(u[0] * x[p.d :])

    def emission(x: Any, u: Any) -> Any:
        return p.predicted(x, u[1:-m], u[-m:], jnp)

    @jax.jit
    def smoothed(Q: Any, R: Any) -> Any:
        parameters = ParamsNLGSSM(mean, P, moved, Q, emission, R)
        filtered = extended_kalman_filter(parameters, z, num_iter=PASSES, inputs=inputs)
        return extended_kalman_smoother(parameters, z, filtered, inputs)[3:5]

    def run(acceleration: float, reading: float) -> Path:
        Q = jnp.array([diffusion(p.d, dt, acceleration) for dt in np.append(p.steps[1:], 0.0)])
        R = jnp.asarray(np.where(p.seen, reading, UNSEEN)[:, :, None] ** 2 * np.eye(m))
        means, covariances = smoothed(Q, R)
        return np.asarray(means)[:, : p.d], np.asarray(covariances)[:, : p.d, : p.d]

    return run
