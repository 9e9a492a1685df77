"""Batches in chunks of one shape, so that a trajectory's numbers never depend on what it is batched with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from trackers.core.recording import Batch

if TYPE_CHECKING:
    from trackers.core.tracker import AbstractTracker, Output

AnyTracker = TypeVar("AnyTracker", bound="AbstractTracker")

CHUNK = 512
"""Trajectories per chunk and device: large enough to amortise a step's overhead, small enough for the cache."""


def prepared(tracker: AnyTracker, dtype: Any) -> AnyTracker:
    """The tracker with its floating numbers as arrays of the run's type, so that other numbers compile nothing anew."""

    def cast(x: Any) -> Any:
        floating = isinstance(x, (float, np.floating)) or (
            eqx.is_array_like(x) and np.issubdtype(np.asarray(x).dtype, np.floating)
        )
        return jnp.asarray(x, dtype) if floating else x

    return jax.tree_util.tree_map(cast, tracker)


@eqx.filter_jit
def _chunk(tracker: AbstractTracker, batch: Batch) -> Output:
    return tracker.scan(batch)


@eqx.filter_jit
def _sharded_chunk(tracker: AbstractTracker, batch: Batch, mesh: Mesh) -> Output:
    arrays, static = eqx.partition(tracker, eqx.is_array)
    spread = PartitionSpec

    def run(arrays: Any, batch: Batch) -> Output:
        return eqx.combine(arrays, static).scan(batch)

    def last(x: Any) -> PartitionSpec:
        return spread(*[None] * (np.ndim(x) - 1), "lanes")

    shapes = jax.eval_shape(run, arrays, batch)
    return jax.shard_map(
        run,
        mesh=mesh,
        in_specs=(spread(), jax.tree_util.tree_map(last, batch)),
        out_specs=jax.tree_util.tree_map(lambda s: spread(*[None] * (len(s.shape) - 1), "lanes"), shapes),
        check_vma=False,
    )(arrays, batch)


def outputs(tracker: AbstractTracker, batch: Batch, chunk: int) -> list[Output]:
    """The outputs of each chunk, batch-last, on the devices; all devices of the host share a chunk's lanes."""
    tracker = prepared(tracker, batch.dt.dtype)
    devices = jax.local_devices()
    # A small batch gets a small chunk, a power of two so that few shapes are ever compiled.
    chunk = min(chunk, 1 << (batch.size - 1).bit_length())
    if batch.size <= chunk or len(devices) == 1:
        return [_chunk(tracker, batch.lanes(k, k + chunk)) for k in range(0, batch.size, chunk)]
    mesh = Mesh(np.array(devices), ("lanes",))
    results = []
    for k in range(0, batch.size, chunk * len(devices)):
        part = batch.lanes(k, k + chunk * len(devices))
        put = jax.tree_util.tree_map(
            lambda x: jax.device_put(x, NamedSharding(mesh, PartitionSpec(*[None] * (x.ndim - 1), "lanes"))), part
        )
        results.append(_sharded_chunk(tracker, put, mesh))
    return results
