"""dynamax's extended Kalman smoother, in double precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from trackwright.experiments.lab.benchmark.motion import Levels, Path, diffusion
from trackwright.experiments.lab.benchmark.problems import Problem, beginning, steps
from trackwright.experiments.lab.benchmark.readings import predicted

UNSEEN = 1e4
"""Standard deviation of a channel that was not seen: dynamax has no missing values."""


def prepared(problem: Problem, levels: Levels) -> Callable[[], Path]:
    """A function that returns the smoothed path of a tag, and compiles when it is first called."""
    import jax
    import jax.numpy as jnp
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_smoother

    d, kind, dts = problem.dimensions, problem.kind, steps(problem)
    m, height = problem.values.shape[1], problem.height

    # What dynamax calls the input of a row has the step to the next row, the geometry and the reading of its own.
    inputs = np.column_stack([np.append(dts[1:], 0.0), problem.geometry, problem.values])

    def moved(x: Any, u: Any) -> Any:
        return x.at[:d].add(u[0] * x[d:])

    def emission(x: Any, u: Any) -> Any:
        place = x[:d] if height is None else jnp.append(x[:d], height)
        return predicted(kind, place, u[1:-m], u[-m:], jnp)

    sigmas = np.where(problem.seen, levels.reading, UNSEEN)
    mean, P = beginning(problem)
    Q = np.array([diffusion(d, dt, levels.acceleration) for dt in inputs[:, 0]])
    R = sigmas[:, :, None] ** 2 * np.eye(m)
    smoothed = jax.jit(
        lambda mean, P, Q, R, z, u: extended_kalman_smoother(ParamsNLGSSM(mean, P, moved, Q, emission, R), z, inputs=u)[
            3:5
        ]
    )

    def run() -> Path:
        with jax.enable_x64(True):
            means, covariances = smoothed(*map(jnp.asarray, (mean, P, Q, R, problem.values, inputs)))
        return Path(np.asarray(means)[:, :d], np.asarray(covariances)[:, :d, :d])

    return run
