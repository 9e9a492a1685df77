"""cuthbert's Kalman filter of linearised moments, in square-root form and double precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trackwright.experiments.lab.benchmark.motion import Levels, Path, diffusion
from trackwright.experiments.lab.benchmark.problems import Problem, beginning, steps
from trackwright.experiments.lab.benchmark.readings import predicted


def prepared(problem: Problem, levels: Levels) -> Callable[[], Path]:
    """A function that returns the filtered path of a tag, and compiles when it is first called."""
    import cuthbert
    import jax
    import jax.numpy as jnp
    from cuthbert.gaussian import moments

    d, kind, height = problem.dimensions, problem.kind, problem.height
    m = problem.values.shape[1]
    unit = np.linalg.cholesky(diffusion(d, 1.0, levels.acceleration))
    mean, P = beginning(problem)

    def dynamics(state: Any, row: Any) -> Any:
        dt = row["dt"]
        # The root of the diffusion over dt is that over 1 s times dt^1.5 for positions and dt^0.5 for velocities.
        scale = jnp.repeat(jnp.stack([dt * jnp.sqrt(dt), jnp.sqrt(dt)]), d, total_repeat_length=2 * d)
        return (lambda x: (x.at[:d].add(dt * x[d:]), scale[:, None] * unit)), state.mean

    def observation(state: Any, row: Any) -> Any:
        def expected(x: Any) -> Any:
            place = x[:d] if height is None else jnp.append(x[:d], height)
            return predicted(kind, place, row["geometry"], row["values"], jnp), levels.reading * jnp.eye(m)

        return expected, state.mean, jnp.where(row["seen"], row["values"], jnp.nan)

    def of_rows(rows: Any, mean: Any, root: Any) -> Any:
        kalman = moments.build_filter(mean, root, dynamics, observation)
        return cuthbert.filter(kalman, rows, kalman.init_prepare())

    rows = {
        "dt": steps(problem), "geometry": problem.geometry, "values": problem.values, "seen": problem.seen,
    }  # fmt: skip
    filtered = jax.jit(of_rows)

    def run() -> Path:
        with jax.enable_x64(True):
            arrays = {name: jnp.asarray(x) for name, x in rows.items()}
            result = filtered(arrays, jnp.asarray(mean), jnp.asarray(np.linalg.cholesky(P)))
        roots = np.asarray(result.chol_cov)[1:, :d]
        return Path(np.asarray(result.mean)[1:, :d], roots @ roots.swapaxes(1, 2))

    return run
