"""The quadratic model of an objective at a point, and the influence of single trajectories on its gradient."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.problem import Evaluation, Problem, value_and_gradient

STEP = 0.02
"""Step of the central differences in unconstrained coordinates: 2 % of a noise level."""


class Optimum(NamedTuple):
    """Quadratic model of the objective: vector (p,), value, gradient (p,), H (p, p), ψ (n, p), u (NaN: no likelihood).

    `used`: which of all trajectories are the n that count. `evaluation`: at the vector itself. `squared` (p, p):
    Σ w_n² H_n, None where all trajectories have weight 1, since it is H then.
    """

    vector: Float[np.ndarray, " p"]
    value: float
    gradient: Float[np.ndarray, " p"]
    hessian: Float[np.ndarray, "p p"]
    influence: Float[np.ndarray, "n p"]
    nats_per_unit: float
    used: Bool[np.ndarray, " all"]
    evaluation: Evaluation
    squared: Float[np.ndarray, "p p"] | None = None

    def weighted(self, inverse: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
        """An inverse of H as the covariance of the weighted estimate, times u."""
        return inverse if self.squared is None else inverse @ self.squared @ inverse


def optimum(problem: Problem, vector: Float[np.ndarray, " p"]) -> Optimum:
    """The quadratic model of the objective at a vector (p,), by central differences of gradients.

    Only trajectories usable at all of the vectors count, so that all differences are of the same function.
    """
    vector = np.asarray(vector, float)
    p = len(vector)
    shifts = STEP * np.eye(p)
    vectors = np.concatenate([vector[None], vector + shifts, vector - shifts])
    evaluation = problem.evaluate(vectors)
    used = np.asarray(evaluation.used.all(axis=0))
    terms, term_gradients = evaluation.terms[..., used], evaluation.term_gradients[..., used]
    sums = terms.sum(axis=-1)
    values, by_sum = (np.asarray(x, float) for x in value_and_gradient(problem.objective, jnp.asarray(sums)))
    gradients = np.einsum("sk,skp->sp", by_sum, term_gradients.sum(axis=-1))
    prior = problem.prior_penalty(vectors, sums)
    values, gradients = values + prior.values, gradients + prior.gradients
    rows = (gradients[1 : p + 1] - gradients[p + 1 :]) / (2 * STEP)
    # Without a single usable trajectory there is no likelihood.
    nats = problem.nats_per_unit(sums[0]) if used.any() else np.nan
    psi = influence(problem.objective, terms[0], term_gradients[0])
    hessian, squared = 0.5 * (rows + rows.T), None
    weights = problem.weights[used]
    if np.any(weights != 1.0):
        excess = np.einsum("sk,skp->sp", by_sum, term_gradients @ (weights - 1.0))
        more = (excess[1 : p + 1] - excess[p + 1 :]) / (2 * STEP)
        squared = hessian + 0.5 * (more + more.T)
    return Optimum(vector, float(values[0]), gradients[0], hessian, psi, nats, used, evaluation.at(0), squared)


def influence(
    objective: AbstractObjective, terms: Float[np.ndarray, "k n"], term_gradients: Float[np.ndarray, "k p n"]
) -> Float[np.ndarray, "n p"]:
    """The derivative of the gradient with respect to each trajectory's weight (n, p).

    From terms (k, n) and their derivatives (k, p, n); exact, since the objective is a function of weighted sums.
    """
    first, second = (np.asarray(x, float) for x in _derivatives(objective, jnp.asarray(terms.sum(axis=-1))))
    return np.einsum("k,kpn->np", first, term_gradients) + np.einsum(
        "kn,kl,lp->np", terms, second, term_gradients.sum(axis=-1)
    )


@eqx.filter_jit
def _derivatives(
    objective: AbstractObjective, sums: Float[jax.Array, " k"]
) -> tuple[Float[jax.Array, " k"], Float[jax.Array, "k k"]]:
    """First and second derivatives of the objective with respect to the sums."""
    return jax.grad(objective.value)(sums), jax.hessian(objective.value)(sums)
