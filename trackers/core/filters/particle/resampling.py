"""Systematic resampling of particles (Kitagawa 1996) in which a particle of weight zero never has offspring.

Cumulative sums are products with small triangular matrices and counts are whole numbers: `jnp.cumsum` and a binary
search per offspring cost more than the rest of the filter, and floating-point cumulative sums need not be monotone.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, Shaped

from trackwright.trackers.core.model.covariance import side_by_side
from trackwright.trackers.core.model.state import State

Tree = TypeVar("Tree")

Weights = Float[Array, " N"]
"""Weights of N particles, or their logarithms."""

LOG_ZERO = -1e30  # the log-weight of a particle of weight zero; finite, so that sums over particles stay finite

RESAMPLED_AT_ONCE = 8  # trajectories whose particles are resampled together


@jax.custom_jvp
def cached_exp(log_weights: Weights, weights: Weights) -> Weights:
    """`weights`, the known value of exp(log_weights), with the derivative of exp(log_weights)."""
    return weights


@cached_exp.defjvp
def _exponential_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    weights = cached_exp(*primals)
    return weights, weights * tangents[0]


def resample(
    needed: Bool[Array, ""], offset: Float[Array, ""], states: State, log_weights: Weights, weights: Weights
) -> tuple[State, Weights, Weights]:
    """States, log-weights and weights, resampled with `offset` in [0, 1) where `needed`, else unchanged.

    `weights`: (N,), with sum 1. All offspring have weight 1/N.
    """
    n = weights.shape[-1]
    states = resample_states(needed, offset, states, weights)
    return states, jnp.where(needed, -math.log(n), log_weights), jnp.where(needed, 1.0 / n, weights)


@custom_vmap
def resample_states(needed: Bool[Array, ""], offset: Float[Array, ""], states: State, weights: Weights) -> State:
    """The states of the offspring where `needed`, else the states."""

    def chosen() -> State:
        ancestors = systematic(weights, offset)
        return jax.tree_util.tree_map(lambda x: jnp.take(x, ancestors, axis=-1, mode="clip"), states)

    return jax.lax.cond(needed, chosen, lambda: states)


@resample_states.def_vmap
def _in_trajectories(size: int, batched: Any, needed: Any, offset: Any, states: Any, weights: Any) -> tuple[Any, Any]:
    """Resampling under `vmap`: only the trajectories that need it, a few at a time; it is the most expensive part."""

    def spread(x: Array, has: bool) -> Array:
        return x if has else jnp.broadcast_to(x[None], (size, *x.shape))

    needed, offset, states, weights = jax.tree_util.tree_map(spread, (needed, offset, states, weights), tuple(batched))
    n_at_once = side_by_side(RESAMPLED_AT_ONCE, size)

    def some(loop: tuple[Any, Any]) -> tuple[Any, Any]:
        need, states = loop
        index = jnp.nonzero(need, size=n_at_once, fill_value=size)[0]
        trajectories = jnp.minimum(index, size - 1)
        ancestors = systematic(jnp.take(weights, trajectories, axis=0), jnp.take(offset, trajectories))
        fresh = jax.tree_util.tree_map(lambda x: gather(x, trajectories, ancestors), states)
        return need.at[index].set(False, mode="drop"), scatter(states, fresh, index)

    _, states = jax.lax.while_loop(lambda loop: jnp.any(loop[0]), some, (needed, states))
    return states, jax.tree_util.tree_map(lambda _: True, states)


def gather(
    x: Shaped[Array, "B *rows N"], trajectories: Int[Array, " k"], ancestors: Int[Array, "k N"]
) -> Shaped[Array, "k *rows N"]:
    """x[trajectory, ..., ancestors] for trajectories (k,) with ancestors (k, N), of an array x (B, ..., N)."""
    inner, n = math.prod(x.shape[1:-1]), x.shape[-1]
    # From a flat array: a two-dimensional index would first be assembled in memory.
    first = (trajectories.astype(jnp.int32)[:, None] * inner + jnp.arange(inner, dtype=jnp.int32)[None, :]) * n
    index = first[:, :, None] + ancestors[:, None, :]
    return x.reshape(-1).at[index].get(mode="promise_in_bounds").reshape(len(trajectories), *x.shape[1:])


def scatter(belief: Tree, fresh: Tree, index: Int[Array, " k"]) -> Tree:
    """The belief with the trajectories `index` replaced; an index beyond the last trajectory is ignored."""
    leaves, structure = jax.tree_util.tree_flatten(belief)
    replaced: list[Array] = []
    for old, new in zip(leaves, jax.tree_util.tree_leaves(fresh), strict=True):
        # In sequence: XLA (jaxlib 0.10, multi-output fusion) aborts where it fuses several of these scatters.
        (old, index), _ = jax.lax.optimization_barrier(((old, index), replaced))
        replaced.append(old.at[index].set(new, mode="drop"))
    scattered: Tree = jax.tree_util.tree_unflatten(structure, replaced)
    return scattered


def effective_sample_size(weights: Weights) -> Float[Array, ""]:
    """The effective sample size N/(1 + CV²) = 1/Σw² (1.29), (1.30), with CV² = var(w)/E(w)²; the weights have sum 1."""
    return 1.0 / jnp.sum(weights * weights)


def systematic(weights: Float[Array, "*B N"], u: Float[Array, "*B"]) -> Int[Array, "*B N"]:
    """The ancestors (..., N), ascending, at the points (k + u)/N of the cumulative weights (Kitagawa 1996).

    `weights` (..., N), `u` (...). Weights are first rounded to whole numbers with a sum below 2^mantissa, so that
    cumulative sums are exact and monotone, and no particle of weight zero has offspring. The rounding error of a weight
    is at most 2⁻²⁴ of the sum in single precision.
    """
    n = weights.shape[-1]
    dtype = weights.dtype
    quanta = float(2 ** (jnp.finfo(dtype).nmant + 1) - 4 * n)
    ends = running_sum(jnp.floor(weights * (quanta / jnp.sum(weights, axis=-1, keepdims=True))))
    whole = ends[..., -1:]
    # Number of offspring up to and including each particle: monotone, and equal for equal sums.
    offspring = jnp.clip(jnp.ceil(ends * (n / whole) - u[..., None]), 0, n)
    offspring = jnp.where(ends == whole, n, offspring.astype(jnp.int32)).reshape(-1, n)
    # Offspring k descends from the first particle with more than k offspring up to it: count those with at most k.
    trajectories = len(offspring)
    slots = offspring + jnp.arange(trajectories, dtype=jnp.int32)[:, None] * (n + 1)
    ending = (
        jnp.zeros(trajectories * (n + 1), dtype)
        .at[slots]
        .add(jnp.ones((trajectories, n), dtype), mode="promise_in_bounds")
    )
    return running_sum(ending.reshape(trajectories, n + 1)[:, :n]).astype(jnp.int32).reshape(weights.shape)


def running_sum(x: Float[Array, "*B N"]) -> Float[Array, "*B N"]:
    """The cumulative sums of (..., N) numbers by products with triangular matrices of about √N rows."""
    n = x.shape[-1]
    root = max(1, math.isqrt(n - 1) + 1)
    # Full rows if a number of columns near √N divides N; else the last row is padded.
    columns = next((c for c in range(root, 2 * root) if n % c == 0), root)
    rows = -(-n // columns)
    lead = x.shape[:-1]
    table = jnp.pad(x, [(0, 0)] * len(lead) + [(0, rows * columns - n)]).reshape(*lead, rows, columns)
    upper, below = (np.triu(np.ones((columns, columns))), np.triu(np.ones((rows, rows)), 1))
    # The default precision of a matrix product on accelerators would not keep whole numbers exact.
    inside = jnp.matmul(table, jnp.asarray(upper, x.dtype), precision="highest")
    before = jnp.matmul(inside[..., -1], jnp.asarray(below, x.dtype), precision="highest")
    return (inside + before[..., None]).reshape(*lead, rows * columns)[..., :n]
