"""Random numbers by the thousand from one raw key: Threefry-2x32 of 20 rounds (Salmon et al. 2011), written out.

It is what `jax.random` uses, but there in a loop that passes memory five times; written out, XLA makes one pass of it.
"""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import Any

import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)


def draws(key: Any, rows: int, count: int, dtype: Any) -> tuple[Any, Scalar, list[Any]]:
    """The next key (2,), a uniform number in [0, 1), and `rows` times `count` normal numbers, from a raw key (2,).

    A normal number takes 16 random bits: one of the middles of 65,536 equally likely intervals, none beyond 4.3.
    """
    first, second = threefry(key, jnp.arange(2, dtype=jnp.uint32), jnp.zeros(2, jnp.uint32))
    following, spare = jnp.stack([first[0], second[0]]), first[1]
    quarter, table = -(-count // 4), jnp.asarray(_middles(), dtype)
    normals = []
    for row in range(rows):
        x, y = threefry(key, jnp.arange(quarter, dtype=jnp.uint32), jnp.full(quarter, row + 1, jnp.uint32))
        halves = [x >> np.uint32(16), y >> np.uint32(16), x & np.uint32(0xFFFF), y & np.uint32(0xFFFF)]
        bits = jnp.concatenate(halves)[:count].astype(jnp.int32)
        normals.append(table.at[bits].get(mode="promise_in_bounds"))
    return following, (spare >> np.uint32(9)).astype(dtype) * 2.0**-23, normals


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
