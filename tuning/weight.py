"""What a likelihood counts for beside the prior: the effective rows, and what left-out recordings tell.

A fit is run on other recordings. Errors that last tell less than as many independent ones, and levels differ from
recording to recording: the more of these, the more a fit to them is to be trusted, and the less if they contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from trackwright.tuning.fit_cautions import rows_and_inflation
from trackwright.tuning.optimisation import FitState, MultiStart, initial_state
from trackwright.tuning.problem import Problem, weighted_sum
from trackwright.tuning.uncertainty import optimum, refit

MOST_ROWS = 4.0
"""Independent estimates that one recording counts for at most: levels of their errors differ between recordings."""

RATIO = 4.0
"""Ratio of the weights that left-out recordings may ask for, two steps from the first at most."""

FOLDS, ROUNDS = 4, 4
"""Parts of the recordings that are left out in turn, at most, and the steps of each fit without one."""

MORE = 1.5
"""Growth of the part of a likelihood that counts, from the start to the best point, with which a fit goes on."""

BETTER = 0.02
"""Gain in left-out recordings, nats per unit of the objective, from which on they ask for another weight."""


def discount(problem: Problem, vector: Float[np.ndarray, " p"], recordings: int) -> float:
    """The part of a likelihood's nats at a vector (p,) that counts, of errors that last and unequal weights.

    With an objective that needs truth none of the `recordings` counts for more than `MOST_ROWS`.
    """
    rows = np.concatenate(problem.rows).astype(float)
    part = min(problem.weights @ rows / (problem.weights**2 @ rows), 1.0) / rows_and_inflation(problem, vector)[1]
    if not problem.objective.needs_truth:
        return float(part)
    terms = problem.terms(vector)[0]
    nats = problem.objective.nats_per_unit(terms[:, np.isfinite(terms).all(axis=0)].sum(axis=1))
    return float(part / (1.0 + part * nats / (MOST_ROWS * recordings)))


def tempered_anew(driver: MultiStart, state: FitState) -> FitState:
    """The state of a finished fit without truth, or with another best point, where more of its nats count there.

    At levels that are far off innovations are correlated that are not at the fitted ones.
    """
    problem, winner = driver.problem, int(np.argmin(state.best_scores))
    vector = state.best_vectors[winner]
    if problem.objective.needs_truth or not (part := discount(problem, vector, 1)) > MORE * problem.discount:
        return state
    problem.discount = part
    again = initial_state(driver, vector, 1)
    while not driver.done(again):
        again = driver.step(again)
    best = _with_best(state, winner, again.best_vectors[0], again.best_scores[0])
    return best._replace(filter_runs=state.filter_runs + again.filter_runs)


def weighed_anew(driver: MultiStart, state: FitState, recordings: Sequence[str]) -> FitState:
    """The state of a finished fit, or with another best point, where recordings left out ask for another weight.

    That of the likelihood is divided by `RATIO`, or with three or more else multiplied, while fits without a part of
    the recordings get better on it, by more than a standard error. `recordings`: of each trajectory, empty for padding.
    """
    problem, winner = driver.problem, int(np.argmin(state.best_scores))
    names, of_trajectory = list(dict.fromkeys(name for name in recordings if name)), np.asarray(recordings)
    if len(names) < 2 or np.array_equal(state.best_vectors[winner], problem.prior.mean):
        return state
    left_out = np.stack([np.isin(of_trajectory, names[k::FOLDS]) for k in range(min(len(names), FOLDS))])
    others, every = (of_trajectory != "") & ~left_out, problem.valid[None]
    at, before = optimum(problem, state.best_vectors[winner]), problem.prior.mean

    def fitted(factor: float, count: Bool[np.ndarray, "S n"]) -> Float[np.ndarray, "S p"]:
        # Where the prior weighs more, the fit is to be found near its mean.
        starts = np.tile(at.vector if factor >= 1.0 else before, (len(count), 1))
        hessian = at.hessian + np.diag(at.prior * (1.0 / factor - 1.0))
        found = refit(problem, starts, hessian, None, factor * count, ROUNDS).vectors
        return np.clip(found, driver.low, driver.high)

    def scores(factor: float) -> Float[np.ndarray, " S"]:
        terms = problem.terms(fitted(factor, others))
        return problem.values_of(weighted_sum(terms, np.isfinite(terms).all(axis=1) & left_out))

    best, least = 1.0, scores(1.0)
    # Two recordings have one difference, which does not tell by how much recordings differ.
    for ratio in (1 / RATIO, RATIO)[: len(names) - 1]:
        for factor in (ratio, ratio**2) if best == 1.0 else ():
            gains = least - (values := scores(factor))
            if not gains.mean() > max(BETTER, gains.std(ddof=1) / len(gains) ** 0.5):
                break
            best, least = factor, values
    if best == 1.0:
        return state
    vector = fitted(best, every)[0]
    problem.discount *= best
    return _with_best(state, winner, vector, problem.values(vector)[0])


def _with_best(state: FitState, winner: int, vector: Float[np.ndarray, " p"], score: float) -> FitState:
    """The state with another best point (p,) of the start that won, and its score."""
    best_vectors, best_scores = state.best_vectors.copy(), state.best_scores.copy()
    best_vectors[winner], best_scores[winner] = vector, score
    return state._replace(best_vectors=best_vectors, best_scores=best_scores)
