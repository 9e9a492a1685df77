"""Where the rows of a problem are, in chunks, and how its compiled functions are run on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.run.chunks import placed, run_chunks
from trackwright.tuning.point import Point
from trackwright.tuning.unstacked import lengths_of

Function = Callable[[Point, Batch], Any]
"""What is compiled: of a point and a chunk."""

Reduced = Callable[[Any, Batch], Any]
"""What is computed on the host, from the arrays of a compiled function and its chunk, before a result travels."""

Blocks = Sequence[Float[np.ndarray, "S p"]]
"""Vectors of a problem, those of one block in one compiled call."""


class Computation(NamedTuple):
    """What is computed of each chunk: `reduced(function(point, chunk), chunk)` at each block of vectors.

    `realisation`: number of the random draws.
    """

    function: Function
    blocks: Blocks
    reduced: Reduced
    realisation: int = 0


class Parts(ABC):
    """The chunks of a problem, wherever they are; `rows`: of each chunk, the rows of each trajectory (B,)."""

    rows: list[Int[np.ndarray, " B"]]

    def run(
        self,
        function: Function,
        blocks: Blocks,
        reduced: Reduced,
        which: Sequence[int] | None = None,
        realisation: int = 0,
    ) -> list[list[Any]]:
        """The `Computation` of each chunk in `which`, default all."""
        computation = Computation(function, blocks, reduced, realisation)
        return self.compute(computation, range(len(self.rows)) if which is None else which)

    @abstractmethod
    def compute(self, computation: Computation, which: Sequence[int]) -> list[list[Any]]:
        """The results of these chunks, in their order."""


Place = Callable[[Point, Iterable[Batch]], Parts]
"""Takes a point, whose vectors do not matter, and the chunks of a problem to where they are computed."""


class LocalParts(Parts):
    """The chunks of a problem in this process, on its devices."""

    def __init__(self, point: Point, pieces: Iterable[Batch]) -> None:
        self.point, self.chunks = point, list(placed(pieces))
        self.rows = [lengths_of(chunk) for chunk in self.chunks]

    def compute(self, computation: Computation, which: Sequence[int]) -> list[list[Any]]:
        """As `Parts`."""
        return on_chunks(self.point, [self.chunks[k] for k in which], computation)


def on_chunks(point: Point, chunks: Sequence[Batch], computation: Computation) -> list[list[Any]]:
    """The results of each chunk, which is on its device."""
    if computation.realisation:
        chunks = [fresh_keys(chunk, computation.realisation) for chunk in chunks]
    points = [point.at(block) for block in computation.blocks]
    found = iter(run_chunks(computation.function, [(point, chunk) for chunk in chunks for point in points]))
    return [[computation.reduced(next(found), chunk) for _ in points] for chunk in chunks]


def on_chunk(point: Point, piece: Batch, computation: Computation) -> list[Any]:
    """The results of one chunk, which another process holds with its point: block by block, in one thread."""
    (chunk,) = placed([piece])
    return [on_chunks(point, [chunk], computation._replace(blocks=[block]))[0][0] for block in computation.blocks]


def fresh_keys(part: Batch, realisation: int) -> Batch:
    """The batch with the random keys of another realisation."""
    return eqx.tree_at(lambda b: b.key, part, _folded(part.key, realisation))


@jax.jit
def _folded(keys: UInt32[Array, "2 B"], realisation: int) -> UInt32[Array, "2 B"]:
    """Raw keys (2, B) with a number folded in."""
    fold = jax.vmap(lambda k: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(k), realisation)), -1, -1)
    return fold(keys)
