"""Batches of a fit that are stacked piece by piece, when one is asked for: few rows are in memory at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from trackwright.trackers.core.data.recording import Batch, Columns
from trackwright.trackers.core.run.chunks import CHUNK, piece_size, pieces
from trackwright.trackers.recordings.tracks import by_length
from trackwright.trackers.recordings.trajectories import Trajectory


@dataclass(frozen=True, eq=False)
class Unstacked:
    """Trajectories that a batch of `steps` rows, with padding, would hold: its pieces have the numbers of that batch's.

    Their recordings have ids, as those of folders do.
    """

    trajectories: Sequence[Trajectory]
    steps: int

    @property
    def size(self) -> int:
        """The number of trajectories."""
        return len(self.trajectories)

    def columns(self, start: int, stop: int) -> Batch:
        """The trajectories start … stop − 1, padded with invalid ones beyond the end, as `Batch.columns`."""
        own = [trajectory.recording for trajectory in self.trajectories[start:stop]]
        return Columns.of(own).batch(self.steps).columns(0, stop - start)

    def pieces(self, chunk: int) -> Iterator[Batch]:
        """As `trackers.core.run.chunks.pieces`."""
        size = piece_size(self.size, self.steps, chunk)
        return (self.columns(start, start + size) for start in range(0, self.size, size))


AnyBatch = Batch | Unstacked


def unstacked(trajectories: Sequence[Trajectory]) -> list[Unstacked]:
    """The trajectories in the batches of `trackers.recordings.tracks.batches`."""
    groups = by_length(np.array([len(trajectory.recording) for trajectory in trajectories]))
    return [Unstacked([trajectories[k] for k in numbers], steps) for numbers, steps in groups]


def padded_size(batch: AnyBatch, chunk: int) -> int:
    """The trajectories of all pieces of a batch, with padding."""
    size = piece_size(batch.size, steps_of(batch), chunk)
    return size * -(-batch.size // size)


def steps_of(batch: AnyBatch) -> int:
    """The rows of a batch, with padding."""
    return batch.steps if isinstance(batch, Unstacked) else len(batch.dt)


def lengths_of(batch: AnyBatch) -> Int[np.ndarray, " B"]:
    """The rows of each trajectory."""
    if isinstance(batch, Unstacked):
        return np.array([len(trajectory.recording) for trajectory in batch.trajectories])
    return np.asarray(batch.valid).sum(axis=0)


@dataclass(frozen=True)
class Pieces:
    """The pieces of at most `chunk` trajectories of all batches, made anew whenever they are looked through."""

    batches: Sequence[AnyBatch]
    chunk: int = CHUNK

    def __iter__(self) -> Iterator[Batch]:
        for batch in self.batches:
            yield from batch.pieces(self.chunk) if isinstance(batch, Unstacked) else pieces(batch, self.chunk)
