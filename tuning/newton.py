"""Newton steps of a likelihood from the best point that an optimiser met."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from trackwright.tuning.optimisation import MultiStart, min_gain
from trackwright.tuning.optimum import Optimum, optimum
from trackwright.tuning.uncertainty import determined

NEWTON_STEPS = 4


def newton(driver: MultiStart, vector: Float[np.ndarray, " p"]) -> tuple[Optimum, int]:
    """The optimum at a vector (p,) or after a few Newton steps from there, while they help.

    For smooth likelihoods only, and not where held-out recordings select the point. Second: the number of vectors
    evaluated.
    """
    problem, found = driver.problem, optimum(driver.problem, vector)
    n_each = 2 * len(vector) + 1
    vectors = n_each
    if not np.isfinite(found.nats_per_unit) or driver.held_out is not None or problem.stochastic:
        return found, vectors
    for _ in range(NEWTON_STEPS):
        _, inverse, _ = determined(found.hessian, ~driver.at_bound(found.vector, found.gradient))
        step = -inverse @ found.gradient
        # The gain that the quadratic model predicts.
        if not -found.gradient @ step / 2 >= min_gain(found.value, found.nats_per_unit):
            break
        step = step / max(1.0, float(np.linalg.norm(step)))
        vector = np.clip(found.vector + step, driver.low, driver.high)
        trial = problem.evaluate(vector)
        vectors += 1
        before = problem.finite_values(found.vector, found.evaluation.terms)
        if not (trial.finite[0] and problem.finite_values(vector, trial.terms)[0] < before[0]):
            break
        found, vectors = optimum(problem, vector), vectors + n_each
    return found, vectors
