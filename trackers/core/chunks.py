"""Batches in chunks of one shape, so that a trajectory's numbers never depend on what it is batched with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from trackers.core.recording import Batch

Tree = TypeVar("Tree")

CHUNK = 512
"""Trajectories per chunk and device: large enough to amortise a step's overhead, small enough for the cache."""


def prepared(tree: Tree, dtype: Any) -> Tree:
    """The tree with its floating numbers as arrays of the run's type, so that other numbers compile nothing anew."""

    def cast(x: Any) -> Any:
        floating = isinstance(x, (float, np.floating)) or (
            eqx.is_array_like(x) and np.issubdtype(np.asarray(x).dtype, np.floating)
        )
        return jnp.asarray(x, dtype) if floating else x

    return jax.tree_util.tree_map(cast, tree)


def chunks(batch: Batch, chunk: int) -> Iterator[Batch]:
    """The batch in parts of `chunk` lanes per device; all devices of the host share a part's lanes.

    Under `jax.default_device` that one alone: then what is compiled is the same program however many there are, and
    so are its results to the bit. XLA fuses the program of several devices otherwise, which moves last bits.
    """
    only = jax.config.jax_default_device  # type: ignore[attr-defined]
    devices = jax.local_devices() if only is None else [only]
    # A small batch gets a small chunk, a power of two so that few shapes are ever compiled.
    chunk = min(chunk, 1 << (batch.size - 1).bit_length())
    if batch.size <= chunk:
        devices = devices[:1]
    mesh = Mesh(np.array(devices), ("lanes",))

    def spread(x: Any) -> jax.Array:
        return jax.device_put(x, NamedSharding(mesh, _last(np.ndim(x))))

    for k in range(0, batch.size, chunk * len(devices)):
        yield jax.tree_util.tree_map(spread, batch.lanes(k, k + chunk * len(devices)))


def over_lanes(function: Callable[[Any, Batch], Tree], model: Any, part: Batch) -> Tree:
    """`function(model, part)` for a part that `chunks` made, each device its lanes; results end with the lanes."""
    return mapped(function, model, part, part.dt.sharding.mesh)


@eqx.filter_jit
def mapped(function: Callable[[Any, Batch], Tree], model: Any, part: Batch, mesh: Mesh) -> Tree:
    """What `over_lanes` compiles, once per function, kind of model and shape of the part."""
    if mesh.size == 1:
        return function(model, part)
    arrays, static = eqx.partition(model, eqx.is_array)

    def run(arrays: Any, part: Batch) -> Tree:
        return function(eqx.combine(arrays, static), part)

    def share(x: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*x.shape[:-1], x.shape[-1] // mesh.size), x.dtype)

    # Traced once, with the shapes of one device: a filter's program takes seconds to trace.
    program, shapes = jax.make_jaxpr(run, return_shape=True)(arrays, jax.tree_util.tree_map(share, part))
    traced = jaxpr_as_fun(program)

    def each(arrays: Any, part: Batch) -> Tree:
        flat = traced(*jax.tree_util.tree_leaves((arrays, part)))
        return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(shapes), flat)

    return jax.shard_map(
        each,
        mesh=mesh,
        in_specs=(PartitionSpec(), jax.tree_util.tree_map(lambda x: _last(x.ndim), part)),
        out_specs=jax.tree_util.tree_map(lambda x: _last(len(x.shape)), shapes),
        check_vma=False,
    )(arrays, part)


def _last(dimensions: int) -> PartitionSpec:
    return PartitionSpec(*[None] * (dimensions - 1), "lanes")
