"""Median along an axis with missing values (NaN)."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from trackwright.trackers.core.model.inputs import AnyArray

NETWORK = 16  # most values sorted by a network of comparators, which XLA fuses; more are sorted by XLA's sort


def nan_median(values: AnyArray) -> jax.Array:
    """The median over the first axis of the values that are not NaN; NaN where there are none.

    Equation (1) of Huang et al. 2018: of 2n + 1 values the (n + 1)-th in order, where the paper's text has the n-th; of
    an even number the mean of the two in the middle.
    """
    seen = jnp.isfinite(values)
    count = jnp.sum(seen, axis=0)
    ordered = in_order(jnp.where(seen, values, jnp.inf))
    low, high = jnp.full_like(values[0], jnp.nan), jnp.full_like(values[0], jnp.nan)
    for k, value in enumerate(ordered):
        low, high = jnp.where((count - 1) // 2 == k, value, low), jnp.where(count // 2 == k, value, high)
    return jnp.where(count > 0, 0.5 * (low + high), jnp.nan)


def in_order(values: AnyArray) -> list[jax.Array]:
    """The values, none of them NaN, in ascending order along the first axis."""
    if len(values) > NETWORK:
        return list(jnp.sort(values, axis=0))
    ordered = list(values)
    for i, j in comparators(len(ordered)):
        ordered[i], ordered[j] = jnp.minimum(ordered[i], ordered[j]), jnp.maximum(ordered[i], ordered[j])
    return ordered


def comparators(n: int) -> Iterator[tuple[int, int]]:
    """The pairs of Batcher's odd-even merge sort of n values (Knuth 1998, algorithm 5.2.2M)."""
    p = 1 << max((n - 1).bit_length() - 1, 0)
    top = p
    while p > 0:
        q, r, d = top, 0, p
        while True:
            yield from ((i, i + d) for i in range(n - d) if i & p == r)
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2
