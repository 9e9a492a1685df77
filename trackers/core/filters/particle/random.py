"""Random numbers for particles: Threefry-2x32 with 20 rounds (Salmon et al. 2011), unrolled.

`jax.random` has the same generator in a loop that passes memory five times; XLA fuses the unrolled form into one pass.
"""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, DTypeLike, Float, UInt32

from trackwright.trackers.core.model.keys import RawKey, threefry


@cache
def quantiles() -> np.ndarray:
    """The normal quantiles at the midpoints of 65,536 equal probability intervals, scaled to variance 1."""
    upper = scipy.special.ndtri((np.arange(32768, 65536) + 0.5) / 65536)
    return np.concatenate([-upper[::-1], upper]) / np.sqrt(np.mean(upper**2))


def draws(
    key: RawKey, rows: int, count: int, dtype: DTypeLike
) -> tuple[RawKey, Float[Array, ""], list[Float[Array, " {count}"]]]:
    """The next key (2,), a uniform number in [0, 1), and `rows` arrays of `count` standard normal numbers.

    `key`: raw, (2,) uint32. A normal number has 16 random bits: the median of one of 65,536 equally likely intervals,
    so that none exceeds 4.3.
    """
    spare = words(key, 0, 2)
    table = jnp.asarray(quantiles(), dtype)
    normals = []
    for row in range(rows):
        both = words(key, row + 1, -(-count // 4)).reshape(-1)
        bits = jnp.concatenate([both >> np.uint32(16), both & np.uint32(0xFFFF)])[:count].astype(jnp.int32)
        normals.append(table.at[bits].get(mode="promise_in_bounds"))
    return spare[:, 0], (spare[0, 1] >> np.uint32(9)).astype(dtype) * 2.0**-23, normals


def words(key: RawKey, stream: int, count: int) -> UInt32[Array, "2 {count}"]:
    """Random words (2, count), uint32: both words of the first `count` counters of a stream under a raw key.

    Each entry computes both words and selects one: with two results XLA makes a pass over memory of every round.
    """
    shape = (2, count)
    x, y = threefry(key, jax.lax.broadcasted_iota(jnp.uint32, shape, 1), jnp.full(shape, stream, jnp.uint32))
    return jnp.where(jax.lax.broadcasted_iota(jnp.uint32, shape, 0) == 0, x, y)
