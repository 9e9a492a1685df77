"""Batches run in chunks of one shape: the bits of a trajectory depend on the chunk's size, not on its neighbours."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Shaped

from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.covariance import FEW, compiler_options, few, side_by_side
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.programs import kept_program
from trackwright.trackers.core.run.scan import Output

Tree = TypeVar("Tree")

CHUNK = 512  # trajectories per chunk: enough to amortise the overhead of a step, few enough for the cache


# Most trajectories that run in pieces of few with a large state, and in gradients with a small and a larger one. There
# the program of few compiles in a half to a quarter of the time, and a row costs as much or less.
FEW_LARGE, FEW_GRADIENTS = 40, (16, 64)

LARGE, LARGE_IN_GRADIENTS = 15, 10  # noises of a motion from which on the state counts as large
# Rows from which on these run one by one, which costs least; a call takes a millisecond, as long as hundreds of rows.
LONG = 1000


def as_numbers(tree: Tree, dtype: DTypeLike) -> Tree:
    """The tree with its floats as NumPy arrays of `dtype`, but for arrays of jax, which remain where they are."""

    def floating(x: Any) -> bool:
        if isinstance(x, float | np.ndarray | jax.Array):
            return isinstance(x, float) or jnp.issubdtype(x.dtype, jnp.floating)
        return eqx.is_array_like(x) and jnp.issubdtype(jnp.result_type(x), jnp.floating)

    leaves, structure = jax.tree_util.tree_flatten(tree)
    for k, x in enumerate(leaves):
        if floating(x):
            leaves[k] = jnp.asarray(x, dtype) if isinstance(x, jax.Array) else np.asarray(x, dtype)
    result: Tree = jax.tree_util.tree_unflatten(structure, leaves)
    return result


def as_dtype(tree: Tree, dtype: DTypeLike) -> Tree:
    """The tree with its floats as arrays of `dtype` on the device, so that other values reuse the compiled program."""
    leaves, structure = jax.tree_util.tree_flatten(as_numbers(tree, dtype))
    numbers = [k for k, x in enumerate(leaves) if isinstance(x, np.ndarray) and x.dtype == dtype]
    # Numbers go to the device together: one by one they take longer than a short run.
    for k, array in zip(numbers, jax.device_put([leaves[k] for k in numbers]), strict=True):
        leaves[k] = array
    result: Tree = jax.tree_util.tree_unflatten(structure, leaves)
    return result


def most_few(tracker: Any, gradient: bool = False) -> int:
    """The most trajectories that run in pieces of few, by the noises of the tracker's motions."""

    def is_motion(x: Any) -> bool:
        return isinstance(x, AbstractMotion)

    leaves = jax.tree_util.tree_leaves(tracker, is_leaf=is_motion)
    noises = max((x.noise_dimension for x in leaves if is_motion(x)), default=0)
    if gradient:
        return FEW_GRADIENTS[noises >= LARGE_IN_GRADIENTS]
    return FEW_LARGE if noises >= LARGE else FEW


def piece_size(trajectories: int, rows: int, chunk: int, most: int = FEW) -> int:
    """The trajectories of each part of a batch, padding included; at most `chunk`, and few in batches up to `most`."""
    at_once = side_by_side(1 if rows >= LONG else FEW, trajectories)
    if at_once < trajectories <= most:
        return min(chunk, -(-trajectories // -(-trajectories // at_once)))
    equal = -(-trajectories // -(-trajectories // chunk))
    if equal <= 2 * FEW:
        return min(chunk, 1 << (equal - 1).bit_length())
    # Three significant bits: few shapes are compiled, and padding adds a quarter at most.
    step = max(FEW, 1 << (equal - 1).bit_length() - 3)
    return min(chunk, -(-equal // step) * step)


def pieces(batch: Batch, chunk: int, most: int = FEW) -> list[Batch]:
    """The batch in parts of `piece_size` trajectories, not yet on a device."""
    size = piece_size(batch.size, len(batch.dt), chunk, most)
    return [batch.columns(start, start + size) for start in range(0, batch.size, size)]


def placed(parts: Iterable[Batch]) -> Iterator[Batch]:
    """The parts by turns on the host's devices, or all on `jax.default_device`.

    No part is sharded: XLA fuses the program for several devices differently, which changes last bits.
    """
    only = jax.config.jax_default_device  # type: ignore[attr-defined]
    devices = jax.local_devices() if only is None else [only]
    for k, part in enumerate(parts):
        yield jax.device_put(part, devices[k % len(devices)])


def chunks(batch: Batch, chunk: int) -> Iterator[Batch]:
    """The parts of a batch of `chunk` trajectories, on their devices."""
    return placed(pieces(batch, chunk))


def n_workers() -> int:
    """The number of chunks that run in parallel: one per device, on CPUs one per core."""
    devices = len(jax.local_devices())
    # The cores available to this process, where the system reports them.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(devices, cores) if jax.default_backend() == "cpu" else devices


def run_chunks(function: Callable[[Any, Batch], Tree], pairs: Sequence[tuple[Any, Batch]]) -> list[Tree]:
    """`function(model, part)` for each pair, `part` from `chunks`; results as NumPy arrays, in order."""
    double = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]
    if len(pairs) == 1:
        return [on_host(function, *pairs[0], called)]
    compiling: defaultdict[Hashable, Lock] = defaultdict(Lock)
    compiled: set[Hashable] = set()

    def dispatch(function: Callable[[Any, Batch], Tree], model: Any, part: Batch) -> Tree:
        """The result of `called`; if several threads need a new program, one of them compiles it."""
        leaves, kind = jax.tree_util.tree_flatten((model, part))
        program = kind, tuple((np.shape(x), x.dtype) if eqx.is_array(x) else x for x in leaves), part.dt.device
        if program in compiled:
            return called(function, model, part)
        with compiling[program]:
            result = called(function, model, part)
            compiled.add(program)
        return result

    def run(pair: tuple[Any, Batch]) -> Tree:
        # The x64 setting is local to a thread.
        with jax.enable_x64(double):
            return on_host(function, *pair, dispatch)

    with ThreadPoolExecutor(min(n_workers(), len(pairs))) as pool:
        waiting = [pool.submit(run, pair) for pair in pairs]
        try:
            return [one.result() for one in waiting]
        finally:
            pool.shutdown(cancel_futures=True)


def on_host(function: Callable[[Any, Batch], Tree], model: Any, part: Batch, call: Callable[..., Any]) -> Tree:
    """`function(model, part)` by a program that `call` finds, as NumPy arrays."""
    return jax.tree_util.tree_map(np.asarray, call(function, model, part))


def _applied(function: Callable[[Any, Any], Tree], model: Any, part: Any) -> Tree:
    """`function(model, part)`, compiled once per function, tree structure, shapes and device."""
    return function(model, part)


# Our loops store one array where they are one kernel, so that derivatives of few trajectories have the options of many.
OPTIONS = compiler_options(CHUNK)
jitted = eqx.filter_jit(_applied, compiler_options=OPTIONS)  # type: ignore[call-overload]


def called(function: Callable[[Any, Any], Tree], model: Any, part: Any) -> Tree:
    """`function(model, part)` by a compiled program, loaded without tracing where possible."""
    program = kept_program(function, model, part, OPTIONS) or partial(jitted, function)
    result: Tree = program(model, part)
    return result


def batch_estimates(tracker: Any, batch: Batch, chunk: int, state: Any = None, continues: bool = False) -> Estimates:
    """The estimates of a batch in chunks of `chunk` trajectories.

    `state`: the scan state of all trajectories before the first row; None for no track. With `continues` the estimates
    have the state after the last row as `final`.
    """
    # No truth: it would be copied for nothing.
    parts = pieces(batch._replace(truth={}), chunk, most_few(tracker))
    # Arrays used once go to the device with the call.
    alone, size = len(parts) == 1, parts[0].size
    model = (as_numbers if alone else as_dtype)(tracker, batch.dt.dtype)
    each = parts if alone else placed(parts)
    pairs = [((model, trajectories_of(state, k * size, (k + 1) * size)), part) for k, part in enumerate(each)]
    output, final = joined(run_chunks(outputs_and_state if continues else outputs, pairs), batch)

    def first(x: np.ndarray) -> np.ndarray:
        return x.transpose(x.ndim - 1, *range(x.ndim - 1))

    mean, age = jax.tree_util.tree_map(first, (output.mean, output.age))
    log_likelihood, nis, nis_dof, wrapped, status = map(first, output[2:7])
    cov = np.moveaxis(output.cov, -1, 1)
    return Estimates(mean, cov, log_likelihood, nis, nis_dof, wrapped, status, age=age, final=final)


def trajectories_of(state: Any, start: int, stop: int) -> Any:
    """The trajectories start … stop − 1 of a state, padded with zeros beyond its end."""

    def cut(x: Shaped[Array | np.ndarray, "B *shape"]) -> Shaped[np.ndarray, "part *shape"]:
        part = np.asarray(x)[start:stop]
        return np.pad(part, [(0, stop - start - len(part)), *[(0, 0)] * (part.ndim - 1)])

    return jax.tree_util.tree_map(cut, state)


def outputs_and_state(model: tuple[Any, Any], batch: Batch) -> tuple[Output, Any]:
    """The outputs of a tracker and the final state; a function for `run_chunks`."""
    result: tuple[Output, Any] = model[0].scan(batch, model[1])
    return result


def outputs(model: tuple[Any, Any], batch: Batch) -> tuple[Output, Any]:
    """`outputs_and_state` without the state."""
    return outputs_and_state(model, batch)[0], None


def joined(parts: Sequence[tuple[Output, Any]], batch: Batch) -> tuple[Output, Any]:
    """The outputs of all trajectories, with the covariances as one array (entries, T, B), and the final states.

    Trajectories stay last, as in the parts: another order is a slow copy.
    """
    (output, final), *others = parts
    if not others and few(batch.size) and output.nis.shape[-1] == batch.size:
        return output._replace(cov=np.stack(output.cov)), final

    def filled(arrays: Sequence[np.ndarray], whole: np.ndarray) -> np.ndarray:
        start = 0
        for array in arrays:
            part = whole[..., start : start + array.shape[-1]]
            # Columns beyond the end of the batch are left out.
            part[...] = array[..., : part.shape[-1]]
            start += array.shape[-1]
        return whole

    def all_of(*arrays: np.ndarray) -> np.ndarray:
        return filled(arrays, np.empty((*arrays[0].shape[:-1], batch.size), arrays[0].dtype))

    each = [output for output, _ in parts]
    cov = np.empty((len(output.cov), len(batch.dt), batch.size), batch.dt.dtype)
    for entry, arrays in zip(cov, zip(*(output.cov for output in each), strict=True), strict=True):
        filled(arrays, entry)
    whole = jax.tree_util.tree_map(all_of, *(output._replace(cov=()) for output in each))
    final = jax.tree_util.tree_map(lambda *x: np.concatenate(x)[: batch.size], *[after for _, after in parts])
    return whole._replace(cov=cov), final
