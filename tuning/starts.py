"""The starts of a fit: the tracker's own values, then the best of guesses and of a coarse grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.model.tunable import Covariance, Scale, role_of
from trackwright.tuning.optimisation import FitState, MultiStart
from trackwright.tuning.parameters import Parameter

GRID_STEP = np.log(10.0)
"""Distance between points of the coarse grid of starts, in unconstrained coordinates: a factor of ten."""


def initial_state(driver: MultiStart, vectors: Float[np.ndarray, "V p"], starts: int) -> FitState:
    """The state at `starts` starts: the first of the vectors, and the best of the others and of a coarse grid.

    Starts with the same value differ in numbers without effect: one of them is taken.
    """
    runs = 0
    if starts > 1:
        vectors = np.concatenate([vectors, coarse_grid(driver.problem.parameters, vectors[0])[1:]])
        vectors = np.clip(vectors, driver.low, driver.high)
        scores, runs = driver.scores(vectors)
        best = [k for k in np.argsort(scores[1:], kind="stable") + 1 if np.isfinite(scores[k])]
        chosen = {float(scores[k]): k for k in reversed([0, *best])}
        vectors = vectors[[0, *(k for k in best if chosen[float(scores[k])] == k)][:starts]]
    state = driver.init(vectors)
    if not state.active[0]:
        raise FloatingPointError(
            f"the objective is not finite at the start ({state.values[0]}): no row is scored, or truth is missing"
        )
    return state._replace(filter_runs=state.filter_runs + runs)


def coarse_grid(parameters: Sequence[Parameter], vector: Float[np.ndarray, " p"]) -> Float[np.ndarray, "S p"]:
    """Starts (S, p): the vector itself first, then with process noise and all other scales a tenth or tenfold.

    Scales are noise levels, times and rates; offsets and fractions stay. Nine starts where both groups are tuned, three
    for one, one for none.
    """
    motion, others = np.zeros_like(vector), np.zeros_like(vector)
    at = 0
    for parameter in parameters:
        raised = np.zeros(parameter.shape)
        if isinstance(parameter.example, Scale):
            raised = raised + 1.0
        elif isinstance(parameter.example, Covariance):
            raised = np.eye(len(raised))  # the logarithms of a Cholesky factor's diagonal
        part = motion if role_of(parameter.example) in ("process noise", "bias noise") else others
        part[at : at + parameter.size] = np.ravel(raised)
        at += parameter.size
    steps = (0.0, -GRID_STEP, GRID_STEP)
    grid = [
        vector + a * motion + b * others
        for a in (steps if motion.any() else steps[:1])
        for b in (steps if others.any() else steps[:1])
    ]
    return np.stack(grid)
