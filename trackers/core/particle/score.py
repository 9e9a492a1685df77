"""The derivative of a particle filter in score form: what its log-weights owe to the numbers that drew the particles.

A move has no derivative through a wall or the choice of an ancestor, but the density of what was drawn has one. So
states count as given, and a log-weight's derivative is that of the log-density of its noise draws, carried from
ancestor to offspring; a sum over the weights then has the derivative of its expectation (Poyiadjis, Doucet and Singh
2011, section 2.2; with a discount MOP-α, Tan, Hooker and Ionides 2024). Values stay as they are, to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, cholesky, inverse_or_zero, total, triangle
from trackers.core.ekf import Gaussian
from trackers.core.particle.resampling import resampled
from trackers.core.state import State, dimension, local


@eqx.filter_custom_jvp
def with_score(log_weights: Any, *numbers: Any, log_density: Callable[..., Any]) -> Any:
    """The log-weights (N,) as they are; to their derivative that of `log_density(*numbers)`, (N,), is added.

    `log_density` is asked only where some of the numbers are differentiated.
    """
    return log_weights


@with_score.def_jvp
def _with_score(primals: Any, tangents: Any, *, log_density: Callable[..., Any]) -> tuple[Any, Any]:
    value = with_score(*primals, log_density=log_density)
    slope, slopes = tangents[0], jax.tree_util.tree_leaves(tangents[1:], is_leaf=lambda x: x is None)
    leaves, structure = jax.tree_util.tree_flatten(primals[1:])
    moving = [k for k, t in enumerate(slopes) if t is not None]
    if not moving:
        return value, slope

    def density(*chosen: Any) -> Any:
        every = list(leaves)
        for k, x in zip(moving, chosen, strict=True):
            every[k] = x
        return log_density(*jax.tree_util.tree_unflatten(structure, every))

    score = jax.jvp(density, [leaves[k] for k in moving], [slopes[k] for k in moving])[1]
    return value, score if slope is None else slope + score


@eqx.filter_custom_jvp
def drawn_with_scores(
    few: Scalar, place: Scalar, states: Any, log_weights: Any, weights: Any, *, discount: float
) -> tuple[Any, Any, Any]:
    """`resampled`, where an offspring's log-weight has `discount` times the derivative of its ancestor's."""
    return resampled(few, place, states, log_weights, weights)


@drawn_with_scores.def_jvp
def _drawn_with_scores(primals: Any, tangents: Any, *, discount: float) -> tuple[Any, Any]:
    few, place, states, log_weights, weights = primals
    slope = tangents[3]
    still = jax.tree_util.tree_map(lambda _: None, states)
    if slope is None:
        return resampled(few, place, states, log_weights, weights), (still, None, None)
    # What a log-weight owes goes with the particle, as if it were part of its state.
    (states, slope), log_weights, weights = resampled(few, place, (states, slope), log_weights, weights)
    slope = slope if discount == 1 else jnp.where(few, discount * slope, slope)
    return (states, log_weights, weights), (still, slope, None)


def normal_density(belief: Gaussian, states: State) -> Any:
    """The log densities (N,), up to a constant, of states (leaves end with an axis of N) under a normal belief.

    A direction without variance says nothing; a belief's mean must not move along it.
    """
    n = dimension(belief.mean)
    pairs = dict(zip(triangle(n), belief.cov, strict=True))
    L = cholesky(pairs, range(n), 16 * float(jnp.finfo(belief.cov[0].dtype).eps))
    inverse = [inverse_or_zero(L[i, i]) for i in range(n)]
    scale = total(-jnp.log(jnp.where(L[i, i] > 0, L[i, i], 1.0)) for i in range(n))

    def density(state: State) -> Scalar:
        steps = local(belief.mean, state)
        parts: list[Scalar] = []
        for i in range(n):
            parts.append((steps[i] - total(L[i, j] * parts[j] for j in range(i))) * inverse[i])
        return scale - 0.5 * total(p * p for p in parts)

    return jax.vmap(density, in_axes=-1, out_axes=-1)(states)
