"""The derivative of a particle filter in score form: log-weights that carry the score of the noise draws.

A draw has no derivative through a wall or through the choice of an ancestor, but its density has one. So states are
held fixed, and the derivative of a log-weight is the accumulated score ∂ log p(noise draws) of its particle, passed
from ancestor to offspring; a weighted sum then has the derivative of its expectation (Poyiadjis, Doucet and Singh 2011,
section 2.2; with a discount MOP-α, Tan, Hooker and Ionides 2024). Values are unchanged, bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from trackwright.trackers.core.filters.particle.resampling import Weights, resample
from trackwright.trackers.core.model.algebra import cholesky, solve_lower, total, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.state import State, dimension, local


@eqx.filter_custom_jvp
def with_score(log_weights: Weights, *numbers: Any, log_density: Callable[..., Weights]) -> Weights:
    """The log-weights (N,), unchanged, with the derivative of `log_density(*numbers)`, (N,), added to theirs.

    `log_density` is called only where some of the numbers are differentiated.
    """
    return log_weights


@with_score.def_jvp
def _with_score(primals: Any, tangents: Any, *, log_density: Callable[..., Weights]) -> tuple[Weights, Weights | None]:
    value = with_score(*primals, log_density=log_density)
    tangent, others = tangents[0], jax.tree_util.tree_leaves(tangents[1:], is_leaf=lambda x: x is None)
    leaves, structure = jax.tree_util.tree_flatten(primals[1:])
    differentiated = [k for k, t in enumerate(others) if t is not None]
    if not differentiated:
        return value, tangent

    def density(*numbers: Any) -> Weights:
        replaced = list(leaves)
        for k, x in zip(differentiated, numbers, strict=True):
            replaced[k] = x
        return log_density(*jax.tree_util.tree_unflatten(structure, replaced))

    score = jax.jvp(density, [leaves[k] for k in differentiated], [others[k] for k in differentiated])[1]
    return value, score if tangent is None else tangent + score


@eqx.filter_custom_jvp
def resample_with_score(
    needed: Bool[Array, ""],
    offset: Float[Array, ""],
    states: State,
    log_weights: Weights,
    weights: Weights,
    *,
    discount: float,
) -> tuple[State, Weights, Weights]:
    """`resample`, with `discount` times the ancestor's score for each offspring."""
    return resample(needed, offset, states, log_weights, weights)


@resample_with_score.def_jvp
def _resample_with_score(primals: Any, tangents: Any, *, discount: float) -> tuple[Any, Any]:
    needed, offset, states, log_weights, weights = primals
    score = tangents[3]
    fixed = jax.tree_util.tree_map(lambda _: None, states)
    if score is None:
        return resample(needed, offset, states, log_weights, weights), (fixed, None, None)
    # The score is resampled with the particles, as if it were part of their state.
    (states, score), log_weights, weights = resample(needed, offset, (states, score), log_weights, weights)
    score = score if discount == 1 else jnp.where(needed, discount * score, score)
    return (states, log_weights, weights), (fixed, score, None)


def normal_log_density(belief: Gaussian, states: State) -> Weights:
    """The log densities (N,), up to a constant, of states (leaves end with an axis of N) under a Gaussian belief.

    A direction without variance contributes nothing; the mean must not depend on a tunable along it.
    """
    n = dimension(belief.mean)
    pairs = dict(zip(triangle(n), belief.cov, strict=True))
    L = cholesky(pairs, range(n), 16 * float(jnp.finfo(belief.cov[0].dtype).eps))
    scale = total(-jnp.log(jnp.where(L[i, i] > 0, L[i, i], 1.0)) for i in range(n))

    def density(state: State) -> Float[Array, ""]:
        return scale - 0.5 * total(x * x for x in solve_lower(L, local(belief.mean, state)))

    return jax.vmap(density, in_axes=-1, out_axes=-1)(states)
