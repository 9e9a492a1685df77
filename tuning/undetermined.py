"""Tuned numbers that the objective does not determine: they keep their starting values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackwright.tuning.identifiability import flat_components
from trackwright.tuning.problem import Problem
from trackwright.tuning.profiles import refit
from trackwright.tuning.uncertainty import Uncertainty

PART = 0.05
"""Part of what a fit gained that a flat number may have gained, where the objective is no likelihood."""

NATS = 1.92
"""Rise of a likelihood, nats, within which a value is in the 95 % interval of a profile (Wilks 1938)."""

ROUNDS = 8
"""Steps of the other numbers with one at its starting value."""


class Kept(NamedTuple):
    """A vector (p,), which of its numbers (p,) are at their starting values, and the number of vectors evaluated."""

    vector: Float[np.ndarray, " p"]
    at_start: Bool[np.ndarray, " p"]
    vectors: int


def kept_at_start(problem: Problem, found: Uncertainty, start: Float[np.ndarray, " p"], gain: float) -> Kept:
    """The optimum with its flat numbers at their values of `start` (p,), and the others fitted again.

    Flat are numbers along which the objective has no curvature at the optimum, or hardly any. One keeps its starting
    value where that costs less than `NATS` of a likelihood, or `PART` of the `gain` of the fit of another objective.
    """
    vector, kept, vectors = found.optimum.vector, np.zeros(len(start), bool), 0
    nats = found.optimum.nats_per_unit
    limit = found.optimum.value + (NATS / nats if np.isfinite(nats) else PART * gain)
    for component in flat_components(found):
        if problem.stochastic or vector[component] == start[component]:
            continue
        fixed = kept | (np.arange(len(start)) == component)
        trial, used = np.where(fixed, start, vector)[None], found.optimum.used[None].astype(float)
        refitted = refit(problem, trial, found.optimum.hessian, ~(found.at_bound | fixed), used, ROUNDS)
        vectors += ROUNDS + 1
        if refitted.values[0] <= limit:
            vector, kept = refitted.vectors[0], fixed
    return Kept(vector, kept, vectors)
