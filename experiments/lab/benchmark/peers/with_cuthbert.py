"""cuthbert's Kalman filter of linearised moments, in square-root form and double precision."""

from typing import Any

import cuthbert
import jax
import jax.numpy as jnp
import numpy as np
from cuthbert.gaussian import moments
from model import Path, Problem, diffusion


def prepared(p: Problem) -> Any:
    """A function of the levels that returns the filtered path, and compiles when it is first called."""
    m, (mean, P) = p.values.shape[1], p.beginning

    def of_rows(rows: Any, mean: Any, root: Any, unit: Any, reading: Any) -> Any:
        def dynamics(state: Any, row: Any) -> Any:
            # The root of the diffusion over dt is that over 1 s times dt^1.5 for positions and dt^0.5 for velocities.
            scale = jnp.repeat(jnp.stack([row["dt"] ** 1.5, row["dt"] ** 0.5]), p.d, total_repeat_length=2 * p.d)
            return (lambda x: (x.at[: p.d].add(row["dt"] * x[p.d :]), scale[:, None] * unit)), state.mean

        def observation(state: Any, row: Any) -> Any:
            root_R, z = reading * jnp.eye(m), jnp.where(row["seen"], row["values"], jnp.nan)
            return (lambda x: (p.predicted(x, row["geometry"], row["values"], jnp), root_R)), state.mean, z

        kalman = moments.build_filter(mean, root, dynamics, observation)
        return cuthbert.filter(kalman, rows, kalman.init_prepare())

    rows, filtered = {"dt": p.steps, "geometry": p.geometry, "values": p.values, "seen": p.seen}, jax.jit(of_rows)

    def run(acceleration: float, reading: float) -> Path:
        unit = np.linalg.cholesky(diffusion(p.d, 1.0, acceleration))
        result = filtered(rows, mean, np.linalg.cholesky(P), unit, reading)
        roots = np.asarray(result.chol_cov)[1:, : p.d]
        return np.asarray(result.mean)[1:, : p.d], roots @ roots.swapaxes(1, 2)

    return run
