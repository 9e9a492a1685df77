"""When weighted particles are drawn again, and how: systematically, with weights of zero that stay zero.

Cumulative sums are small triangular matrix products and counts are whole numbers: `jnp.cumsum` and a binary search per
offspring cost more than all the rest, and floating cumulative sums need not rise.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from trackers.core.algebra import Scalar

NOTHING = -1e30
"""The log-weight of a particle of weight zero: finite, so that a belief with some of them is one."""

AT_ONCE = 8
"""Trajectories whose particles are drawn again together."""


@jax.custom_jvp
def exponential(log_weights: Any, weights: Any) -> Any:
    """exp(log_weights), which is known already: `weights`; as a function of the first alone."""
    return weights


@exponential.defjvp
def _exponential_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    weights = exponential(*primals)
    return weights, weights * tangents[0]


def resampled(few: Scalar, place: Scalar, states: Any, log_weights: Any, weights: Any) -> tuple[Any, Any, Any]:
    """States, log-weights and weights drawn again at `place` in [0, 1) where `few` says so, else as they are.

    `weights`: as many as particles, adding to 1. None of weight zero has offspring, so all offspring weigh the same.
    """
    n = weights.shape[-1]
    states = offspring(few, place, states, weights)
    return states, jnp.where(few, -math.log(n), log_weights), jnp.where(few, 1.0 / n, weights)


@custom_vmap
def offspring(few: Scalar, place: Scalar, states: Any, weights: Any) -> Any:
    """The states drawn again, where `few` says so."""

    def drawn() -> Any:
        ancestors = systematic(weights, place)
        return jax.tree_util.tree_map(lambda x: jnp.take(x, ancestors, axis=-1, mode="clip"), states)

    return jax.lax.cond(few, drawn, lambda: states)


@offspring.def_vmap
def _in_trajectories(size: int, batched: Any, few: Any, place: Any, states: Any, weights: Any) -> tuple[Any, Any]:
    """Only the trajectories that need it are drawn again, a few at a time: that is one in several, and the dearest part."""

    def spread(x: Any, has: bool) -> Any:
        return x if has else jnp.broadcast_to(x[None], (size, *x.shape))

    few, place, states, weights = jax.tree_util.tree_map(spread, (few, place, states, weights), tuple(batched))
    n_workers = min(AT_ONCE, size)

    def some(loop: tuple[Any, Any]) -> tuple[Any, Any]:
        need, states = loop
        index = jnp.nonzero(need, size=n_workers, fill_value=size)[0]
        trajectories = jnp.minimum(index, size - 1)
        ancestors = systematic(jnp.take(weights, trajectories, axis=0), jnp.take(place, trajectories))
        fresh = jax.tree_util.tree_map(lambda x: gather(x, trajectories, ancestors), states)
        return need.at[index].set(False, mode="drop"), scatter(states, fresh, index)

    _, states = jax.lax.while_loop(lambda loop: jnp.any(loop[0]), some, (few, states))
    return states, jax.tree_util.tree_map(lambda _: True, states)


def gather(x: Any, trajectories: Any, ancestors: Any) -> Any:
    """x[trajectory, ..., ancestors] of some trajectories (k,) and their ancestors (k, N), of an array (trajectories, ..., N)."""
    inner, n = math.prod(x.shape[1:-1]), x.shape[-1]
    # From one long array: an index of two numbers would be put together in memory first.
    begin = (trajectories.astype(jnp.int32)[:, None] * inner + jnp.arange(inner, dtype=jnp.int32)[None, :]) * n
    places = begin[:, :, None] + ancestors[:, None, :]
    return x.reshape(-1).at[places].get(mode="promise_in_bounds").reshape(len(trajectories), *x.shape[1:])


def scatter(belief: Any, fresh: Any, index: Any) -> Any:
    """The belief with the trajectories `index` replaced; an index beyond the last trajectory is none."""
    leaves, structure = jax.tree_util.tree_flatten(belief)
    done: list[Any] = []
    for old, new in zip(leaves, jax.tree_util.tree_leaves(fresh), strict=True):
        # One after another: XLA (jaxlib 0.10, multi-output fusion) aborts where it makes one loop of several of these.
        (old, index), _ = jax.lax.optimization_barrier(((old, index), done))
        done.append(old.at[index].set(new, mode="drop"))
    return jax.tree_util.tree_unflatten(structure, done)


def effective_sample_size(weights: Any) -> Scalar:
    """M/(1 + CV²) = 1/Σw² (1.29), (1.30), with CV² = var(w)/E(w)²; the weights add to 1."""
    return 1.0 / jnp.sum(weights * weights)


def even_weights(log_weights: Any) -> Any:
    """Equal log-weights that add to 1 for what was drawn, but nothing for a copy of a particle of weight zero."""
    alive = log_weights > 0.5 * NOTHING
    count = jnp.sum(jnp.where(alive, jnp.ones_like(log_weights), 0.0))
    return jnp.where(alive, -jnp.log(count), NOTHING)


def systematic(weights: Any, u: Any) -> Any:
    """The ancestors (..., N) of N offspring at the places (k + u)/N of the cumulative weights, rising (Kitagawa 1996).

    `weights` (..., N), `u` (...). Weights are first made whole numbers that add to less than the largest below which
    the number format has all of them. Their cumulative sums are then exact and rise, and no particle of weight zero has
    offspring; a weight is off by at most 2⁻²⁴ of the sum in single precision.
    """
    n = weights.shape[-1]
    dtype = weights.dtype
    quanta = float(2 ** (jnp.finfo(dtype).nmant + 1) - 4 * n)
    ends = running_sum(jnp.floor(weights * (quanta / jnp.sum(weights, axis=-1, keepdims=True))))
    whole = ends[..., -1:]
    # The number of offspring up to and including each particle; rounding is the same for equal sums and keeps order.
    offspring = jnp.clip(jnp.ceil(ends * (n / whole) - u[..., None]), 0, n)
    offspring = jnp.where(ends == whole, n, offspring.astype(jnp.int32)).reshape(-1, n)
    # Offspring k descends from the first particle up to which there are more than k: as many end at k or before.
    trajectories = len(offspring)
    slots = offspring + jnp.arange(trajectories, dtype=jnp.int32)[:, None] * (n + 1)
    ending = (
        jnp.zeros(trajectories * (n + 1), dtype)
        .at[slots]
        .add(jnp.ones((trajectories, n), dtype), mode="promise_in_bounds")
    )
    return running_sum(ending.reshape(trajectories, n + 1)[:, :n]).astype(jnp.int32).reshape(weights.shape)


def running_sum(x: Any) -> Any:
    """The cumulative sums of (..., N) numbers by products with triangular matrices of about √N rows."""
    n = x.shape[-1]
    root = max(1, math.isqrt(n - 1) + 1)
    # Whole rows where a number of columns near √N divides N, else the last is filled up.
    columns = next((c for c in range(root, 2 * root) if n % c == 0), root)
    rows = -(-n // columns)
    lead = x.shape[:-1]
    table = jnp.pad(x, [(0, 0)] * len(lead) + [(0, rows * columns - n)]).reshape(*lead, rows, columns)
    upper, below = (np.triu(np.ones((columns, columns))), np.triu(np.ones((rows, rows)), 1))
    # On accelerators the default precision of a product would not keep whole numbers whole.
    inside = jnp.matmul(table, jnp.asarray(upper, x.dtype), precision="highest")
    before = jnp.matmul(inside[..., -1], jnp.asarray(below, x.dtype), precision="highest")
    return (inside + before[..., None]).reshape(*lead, rows * columns)[..., :n]
