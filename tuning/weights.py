"""Weights of trajectories in a fit: each recording has the same say, however long it is, unless rows are to count."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from trackwright.tuning.unstacked import AnyBatch, Unstacked

Weigh = Literal["recordings", "rows"]
"""What has the same say in an objective: each recording, or each row."""


def trajectory_weights(
    batches: Sequence[AnyBatch], recordings: Sequence[Sequence[str]], weigh: Weigh, needs_truth: bool
) -> list[Float[np.ndarray, " B"]]:
    """The weight of each trajectory of the batches, with which the rows of every recording add up to the same number.

    `recordings`: of each batch, the recording of each of its trajectories. Rows with known truth count where the
    objective `needs_truth`, else all rows. The weighted number of rows is that of the rows themselves, so that
    recordings of one length have weight 1. All weights are 1 if rows have the same weight.
    """
    if weigh == "rows" or not batches:
        return [np.ones(batch.size) for batch in batches]
    names = [np.asarray(own) for own in recordings]
    rows = [_rows(batch, needs_truth) for batch in batches]
    every, total = np.concatenate(names), np.concatenate(rows)
    found, index = np.unique(every, return_inverse=True)
    by_recording = np.bincount(index.ravel(), total, minlength=len(found))
    counted = by_recording > 0
    say = np.ones(len(found))
    say[counted] = total.sum() / counted.sum() / by_recording[counted]
    return np.split(say[index.ravel()], np.cumsum([len(own) for own in names])[:-1])


def by_chunks(weights: Sequence[Float[np.ndarray, " B"]] | None, sizes: Sequence[int]) -> Float[np.ndarray, " n"]:
    """The weights of the trajectories of all chunks, from those of batches of these sizes with padding; default 1.

    Chunks are padded with trajectories without rows, whose weight does not matter.
    """
    own = [np.ones(size) for size in sizes] if weights is None else weights
    return np.concatenate([np.append(x, np.ones(size - len(x))) for x, size in zip(own, sizes, strict=True)])


def _rows(batch: AnyBatch, needs_truth: bool) -> Float[np.ndarray, " B"]:
    """The number of rows of each trajectory that an objective counts."""
    if isinstance(batch, Unstacked):
        return np.array([_rows(batch.columns(k, k + 1), needs_truth)[0] for k in range(batch.size)])
    counted = np.asarray(batch.valid)
    if needs_truth and batch.truth:
        counted = counted & np.any([np.asarray(known) for _, known in batch.truth.values()], axis=0)
    return counted.sum(axis=0).astype(float)
