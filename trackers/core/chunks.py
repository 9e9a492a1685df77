"""Batches in chunks of one shape, so that a trajectory's numbers never depend on what it is batched with."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.recording import Batch

Tree = TypeVar("Tree")

CHUNK = 512
"""Trajectories per chunk: large enough to amortise a step's overhead, small enough for the cache."""


def as_dtype(tree: Tree, dtype: Any) -> Tree:
    """The tree with its floating numbers as arrays of the run's type, so that other numbers compile nothing anew."""

    def cast(x: Any) -> Any:
        floating = isinstance(x, (float, np.floating)) or (
            eqx.is_array_like(x) and np.issubdtype(np.asarray(x).dtype, np.floating)
        )
        return jnp.asarray(x, dtype) if floating else x

    return jax.tree_util.tree_map(cast, tree)


def chunks(batch: Batch, chunk: int) -> Iterator[Batch]:
    """The batch in parts of `chunk` trajectories, by turns on all devices of the host; under `jax.default_device` on that one.

    No part is spread over devices: XLA fuses the program of several otherwise, which moves last bits.
    """
    only = jax.config.jax_default_device  # type: ignore[attr-defined]
    devices = jax.local_devices() if only is None else [only]
    # A small batch gets a small chunk, a power of two so that few shapes are ever compiled.
    chunk = min(chunk, 1 << (batch.size - 1).bit_length())
    for k, start in enumerate(range(0, batch.size, chunk)):
        yield jax.device_put(batch.columns(start, start + chunk), devices[k % len(devices)])


def n_workers() -> int:
    """How many parts the host runs at once: one per device, and on CPUs one per core."""
    devices = len(jax.local_devices())
    # Not every system can say which cores are ours.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(devices, cores) if jax.default_backend() == "cpu" else devices


def run_chunks(function: Callable[[Any, Batch], Tree], pairs: Sequence[tuple[Any, Batch]]) -> list[Tree]:
    """`function(model, part)` for pairs of a model and a part that `chunks` made, as NumPy arrays, in their order."""
    double = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]

    def run(pair: tuple[Any, Batch]) -> Tree:
        # A thread has settings of its own.
        with jax.enable_x64(double):
            return jax.tree_util.tree_map(np.asarray, _begun(function, *pair))

    if len(pairs) == 1:
        return [run(pairs[0])]
    with ThreadPoolExecutor(min(n_workers(), len(pairs))) as pool:
        waiting = [pool.submit(run, pair) for pair in pairs]
        try:
            return [one.result() for one in waiting]
        finally:
            pool.shutdown(cancel_futures=True)


@eqx.filter_jit
def jitted(function: Callable[[Any, Batch], Tree], model: Any, part: Batch) -> Tree:
    """What `run_chunks` compiles, once per function, kind of model, shape of the part and device."""
    return function(model, part)


_compiling: dict[Hashable, Lock] = {}
_compiled: set[Hashable] = set()
"""Programs by what makes jax compile one: those that a thread is at work on, and those that are there."""


def _begun(function: Callable[[Any, Batch], Tree], model: Any, part: Batch) -> Tree:
    """The result of `jitted`, on its way; of threads that are the first to need a program one alone compiles it."""
    leaves, kind = jax.tree_util.tree_flatten((model, part))
    shapes = tuple((np.shape(x), x.dtype) if eqx.is_array(x) else x for x in leaves)
    program = function, kind, shapes, part.dt.device
    if program in _compiled:
        return jitted(function, model, part)
    with _compiling.setdefault(program, Lock()):
        result = jitted(function, model, part)
        _compiled.add(program)
    return result
