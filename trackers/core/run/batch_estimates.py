"""The estimates of a batch: its chunks, one program for all of them, and their outputs joined."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np

from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.covariance import few
from trackwright.trackers.core.run.chunks import as_dtype, as_numbers, pieces, placed, run_chunks
from trackwright.trackers.core.run.initial import trajectories_of
from trackwright.trackers.core.run.scan import Output


class Scans(Protocol):
    """A tracker, as its chunks see it."""

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]: ...


def batch_estimates(tracker: Scans, batch: Batch, chunk: int, state: Any = None, continues: bool = False) -> Estimates:
    """The estimates of a batch in chunks of `chunk` trajectories.

    `state`: that of all trajectories before the first row, as `scan` takes it; None for no track. With `continues` the
    state after the last row is their `final`.
    """
    # No truth: it would be copied for nothing.
    parts = pieces(batch._replace(truth={}), chunk)
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


def outputs(model: tuple[Scans, Any], batch: Batch) -> tuple[Output, Any]:
    """The outputs of a tracker, without the state after them, for `run_chunks`."""
    return model[0].scan(batch, model[1])[0], None


def outputs_and_state(model: tuple[Scans, Any], batch: Batch) -> tuple[Output, Any]:
    """The outputs of a tracker and the state after them, for `run_chunks`."""
    return model[0].scan(batch, model[1])


def joined(parts: Sequence[tuple[Output, Any]], batch: Batch) -> tuple[Output, Any]:
    """The outputs of all trajectories, with the covariances as one array (entries, T, B), and the states after them.

    The trajectories are last as the parts have them: another order is a slow copy.
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
    for entry, arrays in zip(cov, zip(*(one.cov for one in each), strict=True), strict=True):
        filled(arrays, entry)
    whole = jax.tree_util.tree_map(all_of, *(one._replace(cov=()) for one in each))
    final = jax.tree_util.tree_map(lambda *x: np.concatenate(x)[: batch.size], *[after for _, after in parts])
    return whole._replace(cov=cov), final
