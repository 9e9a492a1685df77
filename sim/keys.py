"""Random keys that depend on (seed, trajectory id) alone, and named random streams derived from them.

A trajectory has the same numbers in every batch and chunk. Each part of a world draws from a stream of its own name, so
that adding one part leaves the numbers of the others as they are. All draws are float32 whatever JAX's default, so that
worlds are the same in runs with double precision.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Key, UInt32

from trackwright.trackers.core.model.inputs import threefry

Keys = Key[jax.Array, " n"]
"""Typed keys of JAX, one per trajectory."""

_GENERATOR = "threefry2x32"


def trajectory_keys(seed: int, ids: Sequence[int] | np.ndarray) -> Keys:
    """One key per trajectory id (n,), a function of the seed and that id alone.

    Raises ValueError for ids that aren't whole numbers from 0 to 2³² − 1.
    """
    numbers = np.asarray(ids)
    whole = numbers.ndim == 1 and np.issubdtype(numbers.dtype, np.integer)
    if not whole or not np.all((numbers >= 0) & (numbers < 2**32)):
        raise ValueError(f"trajectory ids are a list of whole numbers from 0 to 2**32 - 1, found {numbers!r}")
    return keys_of(seed_key(seed), numbers.astype(np.uint32))


def seed_key(seed: int) -> UInt32[Any, " 2"]:
    """The data of the seed's key: both its halves, of which jax itself takes the lower one in single precision."""
    return np.array([seed >> 32, seed & 0xFFFFFFFF], np.uint32)


def keys_of(seed_key: UInt32[Any, " 2"], ids: UInt32[Any, " n"]) -> Keys:
    """The keys of trajectory ids (n,) from the data of the seed's key; traceable."""
    return _fold_each(jax.random.wrap_key_data(jnp.asarray(seed_key), impl=_GENERATOR), jnp.asarray(ids))


def stream(keys: Keys, name: str) -> Keys:
    """The keys (n,) of the random stream `name` of each key; streams of different names are independent."""
    return _fold_name(keys, np.uint32(zlib.crc32(name.encode())))


def namespace(*arrays: Any) -> Any:
    """The module whose functions take these arrays: `jax.numpy` if any of them is jax's, as in a traced draw."""
    return jnp if any(isinstance(x, jax.Array) for x in arrays) else np


def repeated(one: Any, keys: Keys) -> Any:
    """The array (1, …) once for each of the keys, (n, …)."""
    xp = jnp if isinstance(keys, jax.core.Tracer) else namespace(one)
    return xp.broadcast_to(one, (len(keys), *one.shape[1:]))


def in_dtype(numbers: Any, of: Any) -> Any:
    """The numbers in the dtype of another array; traced ones in what jax makes of it."""
    return numbers.astype(jax.dtypes.canonicalize_dtype(of.dtype) if isinstance(numbers, jax.Array) else of.dtype)


def normals(keys: Keys, shape: tuple[int, ...]) -> Float[Any, "n *shape"]:
    """Standard normal float32 numbers (n, *shape); row i depends on key i alone."""
    return _drawn(_normals, keys, math.prod(shape)).reshape(-1, *shape)


def uniforms(keys: Keys, shape: tuple[int, ...]) -> Float[Any, "n *shape"]:
    """Uniform float32 numbers in [0, 1), (n, *shape); row i depends on key i alone."""
    return _drawn(_uniforms, keys, math.prod(shape)).reshape(-1, *shape)


def _drawn(draw: Callable[[Keys, int], jax.Array], keys: Keys, size: int) -> Float[Any, "n size"]:
    """The float32 numbers of each key, in NumPy; if the keys are traced in jax's default type."""
    if not isinstance(keys, jax.core.Tracer):
        return np.asarray(draw(keys, size))
    # In a loop, which keeps them in memory: elsewhere XLA joins all generators of a draw in one kernel, which takes ten
    # times as long.
    n, blocks = len(keys), 4
    by_block = keys[np.minimum(np.arange(-(-n // blocks) * blocks), n - 1)].reshape(blocks, -1)
    return jax.lax.map(lambda block: draw(block, size), by_block).reshape(-1, size)[:n].astype(float)


_fold_each = jax.jit(jax.vmap(jax.random.fold_in, in_axes=(None, 0)))
_fold_name = jax.jit(jax.vmap(jax.random.fold_in, in_axes=(0, None)))


@partial(jax.jit, static_argnums=1)
def _normals(keys: Keys, size: int) -> Float32[jax.Array, "n size"]:
    least = np.nextafter(np.float32(-1), np.float32(0))
    inside = jnp.maximum(least, _uniforms(keys, size) * (np.float32(1) - least) + least)
    return np.float32(np.sqrt(2)) * jax.lax.erf_inv(inside)


@partial(jax.jit, static_argnums=1)
def _uniforms(keys: Keys, size: int) -> Float32[jax.Array, "n size"]:
    """The numbers of `jax.random.uniform`, which takes six times as long on a CPU: its generator passes five times."""
    key = jnp.moveaxis(jax.random.key_data(keys), -1, 0)[..., None]
    number = jnp.arange(size, dtype=jnp.uint32)[None]
    first, second = threefry(key, jnp.zeros_like(number), number)
    # 23 random bits as the fraction of a number from 1 to 2.
    one_to_two = jnp.right_shift(first ^ second, np.uint32(9)) | np.uint32(0x3F800000)
    return jax.lax.bitcast_convert_type(one_to_two, jnp.float32) - np.float32(1)
