"""Random keys that depend on (seed, trajectory id) alone, and named random streams derived from them.

A trajectory has the same numbers in every batch and chunk. Each part of a world draws from a stream of its own name, so
that adding one part leaves the numbers of the others as they are. All draws are float32 whatever JAX's default, so that
worlds are the same in runs with double precision.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Key, UInt32

Keys = Key[jax.Array, " n"]
"""Typed keys of JAX, one per trajectory."""

LARGEST_ID = 2**32 - 1


def trajectory_keys(seed: int, ids: Sequence[int] | np.ndarray) -> Keys:
    """One key per trajectory id (n,), a function of the seed and that id alone.

    Raises ValueError for ids that aren't whole numbers from 0 to 2³² − 1.
    """
    numbers = np.asarray(ids)
    if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
        raise ValueError(f"trajectory ids are a list of whole numbers, found {numbers.dtype} of shape {numbers.shape}")
    if numbers.size and not (numbers.min() >= 0 and numbers.max() <= LARGEST_ID):
        raise ValueError(f"trajectory ids lie in 0..{LARGEST_ID}, found {numbers.min()}..{numbers.max()}")
    return _fold_each(jax.random.key(seed, impl="threefry2x32"), jnp.asarray(numbers.astype(np.uint32)))


def stream(keys: Keys, name: str) -> Keys:
    """The keys (n,) of the random stream `name` of each key; streams of different names are independent."""
    return _fold_name(keys, np.uint32(zlib.crc32(name.encode())))


def normals(keys: Keys, shape: tuple[int, ...]) -> Float32[np.ndarray, "n *shape"]:
    """Standard normal float32 numbers (n, *shape); row i depends on key i alone."""
    return np.asarray(_normals(keys, math.prod(shape))).reshape(-1, *shape)


def uniforms(keys: Keys, shape: tuple[int, ...]) -> Float32[np.ndarray, "n *shape"]:
    """Uniform float32 numbers in [0, 1), (n, *shape); row i depends on key i alone."""
    return np.asarray(_uniforms(keys, math.prod(shape))).reshape(-1, *shape)


@jax.jit
def _fold_each(key: Key[jax.Array, ""], numbers: UInt32[jax.Array, " n"]) -> Keys:
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, numbers)


@jax.jit
def _fold_name(keys: Keys, number: np.uint32) -> Keys:
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)


@partial(jax.jit, static_argnums=1)
def _normals(keys: Keys, size: int) -> Float32[jax.Array, "n size"]:
    return jax.vmap(lambda key: jax.random.normal(key, (size,), jnp.float32))(keys)


@partial(jax.jit, static_argnums=1)
def _uniforms(keys: Keys, size: int) -> Float32[jax.Array, "n size"]:
    return jax.vmap(lambda key: jax.random.uniform(key, (size,), jnp.float32))(keys)
