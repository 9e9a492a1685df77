"""Batches in chunks of one shape, so that the numbers of a trajectory do not depend on the others in its batch."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import DTypeLike

from trackers.core.covariance import compiler_options, few
from trackers.core.recording import Batch
from trackers.core.traced_programs import found_program

Tree = TypeVar("Tree")

CHUNK = 512
"""Trajectories per chunk: enough to amortise the overhead of a step, few enough for the cache."""


LONG = 1000
"""Rows from which on few recordings run one by one: a call takes a millisecond, as long as hundreds of rows."""


def as_dtype(tree: Tree, dtype: DTypeLike) -> Tree:
    """The tree with its floats as arrays of `dtype`, so that other values reuse the compiled program."""

    def floating(x: Any) -> bool:
        return eqx.is_array_like(x) and jnp.issubdtype(jnp.result_type(x), jnp.floating)

    leaves, structure = jax.tree_util.tree_flatten(tree)
    chosen = [k for k, x in enumerate(leaves) if floating(x)]
    # Numbers are converted by NumPy and go to the device together: one by one they take longer than a short run.
    numbers = [k for k in chosen if not isinstance(leaves[k], jax.Array)]
    for k, array in zip(numbers, jax.device_put([np.asarray(leaves[k], dtype) for k in numbers]), strict=True):
        leaves[k] = array
    for k in chosen:
        leaves[k] = jnp.asarray(leaves[k], dtype)
    result: Tree = jax.tree_util.tree_unflatten(structure, leaves)
    return result


def chunks(batch: Batch, chunk: int) -> Iterator[Batch]:
    """The batch in parts of `chunk` trajectories, by turns on the host's devices, or all on `jax.default_device`.

    No part is sharded: XLA fuses the program for several devices differently, which changes last bits.
    """
    only = jax.config.jax_default_device  # type: ignore[attr-defined]
    devices = jax.local_devices() if only is None else [only]
    # A small batch gets a small chunk, a power of two so that few shapes are compiled. Few long recordings run one by
    # one: they gain nothing side by side, and one program serves them all.
    alone = few(batch.size) and len(batch.dt) >= LONG
    chunk = 1 if alone else min(chunk, 1 << (batch.size - 1).bit_length())
    for k, start in enumerate(range(0, batch.size, chunk)):
        yield jax.device_put(batch.columns(start, start + chunk), devices[k % len(devices)])


def n_workers() -> int:
    """The number of chunks that run in parallel: one per device, on CPUs one per core."""
    devices = len(jax.local_devices())
    # The cores available to this process, where the system reports them.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(devices, cores) if jax.default_backend() == "cpu" else devices


def run_chunks(function: Callable[[Any, Batch], Tree], pairs: Sequence[tuple[Any, Batch]]) -> list[Tree]:
    """`function(model, part)` for each pair, `part` from `chunks`; results as NumPy arrays, in order."""
    double = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    programs = Programs()

    def run(pair: tuple[Any, Batch]) -> Tree:
        # The x64 setting is local to a thread.
        with jax.enable_x64(double):
            return jax.tree_util.tree_map(np.asarray, programs.dispatch(function, *pair))

    if len(pairs) == 1:
        return [run(pairs[0])]
    with ThreadPoolExecutor(min(n_workers(), len(pairs))) as pool:
        waiting = [pool.submit(run, pair) for pair in pairs]
        try:
            return [one.result() for one in waiting]
        finally:
            pool.shutdown(cancel_futures=True)


def _applied(function: Callable[[Any, Any], Tree], model: Any, part: Any) -> Tree:
    """`function(model, part)`, compiled once per function, tree structure, shapes and device."""
    return function(model, part)


jitted = eqx.filter_jit(_applied)
jitted_for_few = eqx.filter_jit(_applied, compiler_options=compiler_options(1))  # type: ignore[call-overload]


class Programs:
    """The programs of one call of `run_chunks`: if several threads need a new one, one of them compiles it."""

    def __init__(self) -> None:
        self.compiling: defaultdict[Hashable, Lock] = defaultdict(Lock)
        self.compiled: set[Hashable] = set()

    def dispatch(self, function: Callable[[Any, Batch], Tree], model: Any, part: Batch) -> Tree:
        """The result of `jitted`, whose computation may still run."""
        leaves, kind = jax.tree_util.tree_flatten((model, part))
        shapes = tuple((np.shape(x), x.dtype) if eqx.is_array(x) else x for x in leaves)
        program = kind, shapes, part.dt.device
        if program in self.compiled:
            return called(function, model, part, compiler_options(part.size))
        with self.compiling[program]:
            result = called(function, model, part, compiler_options(part.size))
            self.compiled.add(program)
        return result


def called(
    function: Callable[[Any, Any], Tree], model: Any, part: Any, options: dict[str, str | bool] | None = None
) -> Tree:
    """`function(model, part)` by a compiled program, which is found without tracing where that is possible.

    `options`: those of `compiler_options`.
    """
    program = found_program(function, model, part, options)
    if program is None:
        result: Tree = (jitted if options is None else jitted_for_few)(function, model, part)
        return result
    found: Tree = program(model, part)
    return found
