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


@custom_vmap
def drawn_again(few: Scalar, place: Scalar, states: Any, log_weights: Any) -> tuple[Any, Any]:
    """States and log-weights drawn again at `place` in [0, 1) where `few` says so, else as they are."""
    return jax.lax.cond(few, _drawn, lambda place, *belief: belief, place, states, log_weights)


@drawn_again.def_vmap
def _in_lanes(size: int, batched: Any, few: Any, place: Any, states: Any, log_weights: Any) -> tuple[Any, Any]:
    """Only the lanes that need it are drawn again, a few at a time: that is one in several, and the dearest part."""

    def spread(x: Any, has: bool) -> Any:
        return x if has else jnp.broadcast_to(x[None], (size, *x.shape))

    arguments = few, place, states, log_weights
    few, place, states, log_weights = jax.tree_util.tree_map(spread, arguments, tuple(batched))
    at_once = min(AT_ONCE, size)

    def some(loop: tuple[Any, Any]) -> tuple[Any, Any]:
        need, belief = loop
        index = jnp.nonzero(need, size=at_once, fill_value=size)[0]
        mine = jax.tree_util.tree_map(lambda x: jnp.take(x, index, axis=0, mode="clip"), belief)
        fresh = jax.vmap(_drawn)(jnp.take(place, index, mode="clip"), *mine)
        return need.at[index].set(False, mode="drop"), put(belief, fresh, index)

    _, belief = jax.lax.while_loop(lambda loop: jnp.any(loop[0]), some, (few, (states, log_weights)))
    return belief, jax.tree_util.tree_map(lambda _: True, belief)


def put(belief: Any, fresh: Any, index: Any) -> Any:
    """The belief with the lanes `index` replaced; an index beyond the last lane is none."""
    leaves, structure = jax.tree_util.tree_flatten(belief)
    done: list[Any] = []
    for old, new in zip(leaves, jax.tree_util.tree_leaves(fresh), strict=True):
        # One after another: XLA (jaxlib 0.10, multi-output fusion) aborts where it makes one loop of several of these.
        (old, index), _ = jax.lax.optimization_barrier(((old, index), done))
        done.append(old.at[index].set(new, mode="drop"))
    return jax.tree_util.tree_unflatten(structure, done)


def _drawn(place: Scalar, states: Any, log_weights: Any) -> tuple[Any, Any]:
    ancestors = systematic(log_weights, place)

    def take(x: Any) -> Any:
        return jnp.take(x, ancestors, axis=-1, mode="clip")

    return jax.tree_util.tree_map(take, states), even_weights(take(log_weights))


def log_sum(log_weights: Any) -> Scalar:
    """The logarithm of the sum of the weights."""
    top = jnp.max(log_weights)
    return top + jnp.log(jnp.sum(jnp.exp(log_weights - top)))


def effective_sample_size(log_weights: Any) -> Scalar:
    """M/(1 + CV²) = 1/Σw² (1.29), (1.30), with CV² = var(w)/E(w)²; the weights add to 1."""
    return 1.0 / jnp.sum(jnp.exp(2.0 * log_weights))


def even_weights(log_weights: Any) -> Any:
    """Equal log-weights that add to 1 for what was drawn, but nothing for a copy of a particle of weight zero."""
    alive = log_weights > 0.5 * NOTHING
    count = jnp.sum(jnp.where(alive, jnp.ones_like(log_weights), 0.0))
    return jnp.where(alive, -jnp.log(count), NOTHING)


def systematic(log_weights: Any, u: Scalar) -> Any:
    """The ancestors (N,) of N offspring at the places (k + u)/N of the cumulative weights, rising (Kitagawa 1996).

    Weights are first made whole numbers that add to less than the largest below which the number format has all of
    them. Their cumulative sums are then exact and rise, and no particle of weight zero has offspring; a weight is off
    by at most 2⁻²⁴ of the sum in single precision.
    """
    n = log_weights.shape[-1]
    dtype = log_weights.dtype
    weights = jnp.exp(log_weights - jnp.max(log_weights))
    quanta = float(2 ** (jnp.finfo(dtype).nmant + 1) - 4 * n)
    ends = running_sum(jnp.floor(weights * (quanta / jnp.sum(weights))))
    whole = ends[-1]
    # The number of offspring up to and including each particle; rounding is the same for equal sums and keeps order.
    offspring = jnp.clip(jnp.ceil(ends * (n / whole) - u), 0, n)
    offspring = jnp.where(ends == whole, n, offspring.astype(jnp.int32))
    # Offspring k descends from the first particle up to which there are more than k: as many end at k or before.
    ending = jnp.zeros(n, dtype).at[offspring].add(jnp.ones(n, dtype), mode="drop")
    return running_sum(ending).astype(jnp.int32)


def running_sum(x: Any) -> Any:
    """The cumulative sums of (N,) numbers by products with triangular matrices of about √N rows."""
    n = x.shape[-1]
    columns = max(1, math.isqrt(n - 1) + 1)
    rows = -(-n // columns)
    table = jnp.pad(x, (0, rows * columns - n)).reshape(rows, columns)
    upper, below = (np.triu(np.ones((columns, columns))), np.tril(np.ones((rows, rows)), -1))
    # On accelerators the default precision of a product would not keep whole numbers whole.
    inside = jnp.matmul(table, jnp.asarray(upper, x.dtype), precision="highest")
    before = jnp.matmul(jnp.asarray(below, x.dtype), inside[:, -1], precision="highest")
    return (inside + before[:, None]).reshape(-1)[:n]
