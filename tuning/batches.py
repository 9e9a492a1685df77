"""Batches of a fit, stacked piece by piece when one is asked for, so that few rows are in memory; their weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.covariance import FEW
from trackwright.trackers.core.run.chunks import CHUNK, piece_size, pieces


def padded_size(batch: Batch, chunk: int, most: int) -> int:
    """The trajectories of all pieces of a batch, with padding."""
    size = piece_size(batch.size, len(batch.dt), chunk, most)
    return size * -(-batch.size // size)


def lengths_of(batch: Batch) -> Int[np.ndarray, " B"]:
    """The rows of each trajectory."""
    return np.asarray(batch.valid).sum(axis=0)


@dataclass(frozen=True)
class Pieces:
    """The `pieces` of all batches, made anew whenever they are looked through."""

    batches: Sequence[Batch]
    chunk: int = CHUNK
    most: int = FEW

    def __iter__(self) -> Iterator[Batch]:
        for batch in self.batches:
            yield from pieces(batch, self.chunk, self.most)


Weigh = Literal["recordings", "rows"]
"""What has the same say in an objective: each recording, or each row."""


def trajectory_weights(
    batches: Sequence[Batch], recordings: Sequence[Sequence[str]], weigh: Weigh, needs_truth: bool
) -> list[Float[np.ndarray, " B"]]:
    """The weight of each trajectory of the batches, with which the rows of every recording add up to the same number.

    `recordings`: of each batch, the recording of each of its trajectories. Rows with known truth count where the
    objective `needs_truth`, else all rows. The weighted number of rows is the number of rows, so that
    recordings of one length have weight 1. All weights are 1 if rows have the same weight.
    """
    if weigh == "rows" or not batches:
        return [np.ones(batch.size) for batch in batches]
    names = [np.asarray(of_batch) for of_batch in recordings]
    rows = [_rows(batch, needs_truth) for batch in batches]
    joined, total = np.concatenate(names), np.concatenate(rows)
    distinct, index = np.unique(joined, return_inverse=True)
    by_recording = np.bincount(index.ravel(), total, minlength=len(distinct))
    counted = by_recording > 0
    say = np.ones(len(distinct))
    say[counted] = total.sum() / counted.sum() / by_recording[counted]
    return np.split(say[index.ravel()], np.cumsum([len(of_batch) for of_batch in names])[:-1])


def by_chunks(weights: Sequence[Float[np.ndarray, " B"]] | None, sizes: Sequence[int]) -> Float[np.ndarray, " n"]:
    """The weights of the trajectories of all chunks, from batches of these sizes with padding; default 1.

    Chunks are padded with trajectories without rows, whose weight does not matter.
    """
    of_batches = [np.ones(size) for size in sizes] if weights is None else weights
    return np.concatenate([np.append(x, np.ones(size - len(x))) for x, size in zip(of_batches, sizes, strict=True)])


def _rows(batch: Batch, needs_truth: bool) -> Float[np.ndarray, " B"]:
    """The number of rows of each trajectory that an objective counts."""
    counted = np.asarray(batch.valid)
    if needs_truth and batch.truth:
        counted = counted & np.any([np.asarray(known) for _, known in batch.truth.values()], axis=0)
    return counted.sum(axis=0).astype(float)
