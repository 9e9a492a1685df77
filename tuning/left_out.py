"""Cross-validation of a fit: values fitted to all recordings but one, from the optimum of all."""

from __future__ import annotations

import numpy as np

from trackwright.tuning.fitting import FitResult, by_label
from trackwright.tuning.profiles import refit

MOST_FOLDS = 10
"""Fits at most: of more recordings several are left out at once."""

ROUNDS = 8
"""Steps of each fit from the optimum of all recordings."""


def left_out_values(result: FitResult) -> dict[str, dict[str, np.ndarray]]:
    """For each recording, the values by label that are fitted to the others, all at once.

    Numbers at a bound, and those that keep their starting values, stay there. Empty for one recording, for an
    interrupted fit, and for particle filters, whose gradients are too noisy for a few steps.
    """
    found, names = result.uncertainty, list(dict.fromkeys(name for name in result.recordings if name))
    if found is None or result.problem.stochastic or len(names) < 2 or not np.all(np.isfinite(found.optimum.hessian)):
        return {}
    folds = [names[k::MOST_FOLDS] for k in range(min(len(names), MOST_FOLDS))]
    own = np.asarray(result.recordings)
    weights = np.stack([found.optimum.used & ~np.isin(own, fold) for fold in folds]).astype(float)
    starts = np.tile(result.vector, (len(folds), 1))
    vectors = refit(result.problem, starts, found.optimum.hessian, ~found.at_bound, weights, ROUNDS).vectors
    vectors = np.clip(vectors, *result.limits)
    return {
        name: by_label(result.parameters, vector)
        for fold, vector, others in zip(folds, vectors, weights, strict=True)
        for name in fold
        if others.any()
    }
