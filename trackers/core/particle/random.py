"""Random numbers by the thousand from one raw key: Threefry-2x32 of 20 rounds (Salmon et al. 2011), written out.

It is what `jax.random` uses, but there in a loop that passes memory five times; written out, XLA makes one pass of it.
"""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)


def draws(key: Any, rows: int, count: int, dtype: Any) -> tuple[Any, Scalar, list[Any]]:
    """The next key (2,), a uniform number in [0, 1), and `rows` times `count` normal numbers, from a raw key (2,).

    A normal number takes 16 random bits: one of the middles of 65,536 equally likely intervals, none beyond 4.3.
    """
    spare = words(key, 0, 2)
    table = jnp.asarray(_middles(), dtype)
    normals = []
    for row in range(rows):
        both = words(key, row + 1, -(-count // 4)).reshape(-1)
        bits = jnp.concatenate([both >> np.uint32(16), both & np.uint32(0xFFFF)])[:count].astype(jnp.int32)
        normals.append(table.at[bits].get(mode="promise_in_bounds"))
    return spare[:, 0], (spare[0, 1] >> np.uint32(9)).astype(dtype) * 2.0**-23, normals


def words(key: Any, stream: int, count: int) -> Any:
    """Random words (2, count) under a raw key: the first and second words of a stream's first `count` counters.

    Both are made for either, and one is taken: with two results XLA makes a pass over memory of every round.
    """
    shape = (2, count)
    x, y = threefry(key, jax.lax.broadcasted_iota(jnp.uint32, shape, 1), jnp.full(shape, stream, jnp.uint32))
    return jnp.where(jax.lax.broadcasted_iota(jnp.uint32, shape, 0) == 0, x, y)


@lru_cache(maxsize=1)
def _middles() -> np.ndarray:
    """The quantiles of the normal distribution at the middles of 65,536 intervals, scaled to variance 1."""
    quantile = NormalDist().inv_cdf
    upper = np.array([quantile((k + 0.5) / 65536) for k in range(32768, 65536)])
    middles = np.concatenate([-upper[::-1], upper])
    return middles / np.sqrt(np.mean(middles**2))


def threefry(key: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """The two random words of each pair of counters `x`, `y` (n,) uint32 under a raw key (2,) uint32."""
    keys = key[0], key[1], key[0] ^ key[1] ^ PARITY
    x, y = x + keys[0], y + keys[1]
    for group in range(5):
        for turn in ROTATIONS[group % 2]:
            x = x + y
            y = (y << np.uint32(turn)) | (y >> np.uint32(32 - turn))
            y = y ^ x
        x, y = x + keys[(group + 1) % 3], y + keys[(group + 2) % 3] + np.uint32(group + 1)
    return x, y
