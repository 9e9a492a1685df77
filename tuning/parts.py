"""The objective of a tracker at vectors as functions to be compiled, and the chunks of rows that they are run on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.tunable import AbstractTunable
from trackwright.trackers.core.run.chunks import called, outputs, placed, run_chunks
from trackwright.trackers.core.run.latency import scored_truth
from trackwright.trackers.core.run.scan import Output, Score
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.batches import lengths_of
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, Vector, with_parameters

BESIDE = 2
"""Numbers of a row beside the terms of the objective: its `AbstractObjective.squares`."""


class Point(eqx.Module):
    """A tracker, an objective and S vectors of its parameters: the argument of the compiled functions."""

    tracker: AbstractTracker
    objective: AbstractObjective
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    examples: tuple[AbstractTunable, ...]
    vectors: Float[Array, "S p"]

    def __init__(
        self,
        tracker: AbstractTracker,
        objective: AbstractObjective,
        parameters: Sequence[Parameter],
        vectors: Float[Array, "S p"],
    ):
        self.tracker, self.objective, self.vectors = tracker, objective, vectors
        self.names = tuple(p.names for p in parameters)
        self.labels = tuple(p.label for p in parameters)
        self.examples = tuple(p.example for p in parameters)

    def at(self, vectors: Float[np.ndarray, "*S p"]) -> Point:
        """This point at other vectors (S, p) or one."""
        return eqx.tree_at(lambda p: p.vectors, self, jnp.asarray(np.atleast_2d(vectors), self.vectors.dtype))

    def tracker_at(self, vector: Vector) -> AbstractTracker:
        """The tracker with the parameters of one vector."""
        parts = zip(self.names, self.examples, self.labels, strict=True)
        return with_parameters(self.tracker, [Parameter(*part) for part in parts], vector)

    def map_vectors(self, function: Callable[[Float[Array, " p"]], Any]) -> Any:
        """`function` of every vector, results stacked along a new first axis."""
        if len(self.vectors) == 1:
            return jax.tree_util.tree_map(lambda x: x[None], function(self.vectors[0]))
        return jax.vmap(function)(self.vectors)


def plain_sums(point: Point, batch: Batch) -> tuple[Float[Array, "S k B"]]:
    """The sums per vector, term and trajectory (S, k, B)."""
    return (point.map_vectors(lambda v: jnp.stack(point.tracker_at(v).accumulate(batch, point.objective.terms))),)


def plain_rows(point: Point, batch: Batch) -> tuple[Float[Array, "S k T B"]]:
    """The terms of every row per vector and trajectory, then its squares (S, k + 2, T, B), for few trajectories.

    The host adds the terms in double precision, and derivatives of rows come with the sums'.
    """
    scores = _scores(point.objective)
    return (point.map_vectors(lambda v: jnp.stack(point.tracker_at(v).accumulate(batch, scores, every_row=True))),)


def rows_of_runs(pairs: Sequence[tuple[Point, Batch]]) -> list[tuple[Float[np.ndarray, "1 k T B"]]]:
    """`plain_rows` of points with one vector each, by the program with which `AbstractTracker.run` tracks the batch."""
    tracked = []
    for point, batch in pairs:
        tracker = point.tracker_at(np.asarray(point.vectors[0]))
        # Estimates have no more than the objective needs.
        tracker = tracker.for_positions() if point.objective.of_position else tracker
        tracked.append(((tracker, None), batch._replace(truth={})))
    runs = run_chunks(outputs, tracked)
    return [
        (np.asarray(called(_scored, point.objective, (run, batch)))[None],)
        for (run, _), (point, batch) in zip(runs, pairs, strict=True)
    ]


def _scored(objective: AbstractObjective, run: tuple[Output, Batch]) -> Float[Array, "k T B"]:
    """The numbers of every row as in `plain_rows`, from its estimate."""
    output, batch = run
    return jnp.stack(jax.vmap(_scores(objective))(output, scored_truth(batch, output.age)))


def _scores(objective: AbstractObjective) -> Score:
    def scores(output: Output, truth: Any) -> tuple[Any, ...]:
        return *objective.terms(output, truth), *objective.squares(output, truth)

    return scores


@dataclass(frozen=True)
class WithDerivatives:
    """What `function` returns of a point, `plain_sums` or `plain_rows`, and its derivatives (S, k, p, …).

    `numbers`: of the vectors with derivatives, all tangents at once; the derivatives by all others are zero.
    """

    function: Callable[[Point, Batch], tuple[Array]]
    numbers: tuple[int, ...]

    def __call__(self, point: Point, batch: Batch) -> tuple[Any, Any]:
        def at(vectors: Float[Array, "S p"]) -> Any:
            return self.function(eqx.tree_at(lambda p: p.vectors, point, vectors), batch)[0]

        def along(direction: Float[Array, " p"]) -> tuple[Any, Any]:
            """The values, and their derivatives along one direction, the same for every vector."""
            return jax.jvp(at, (point.vectors,), (jnp.broadcast_to(direction, point.vectors.shape),))

        p = point.vectors.shape[1]
        directions = jnp.eye(p, dtype=point.vectors.dtype)[jnp.array(self.numbers)]
        # Vectors inside and directions outside: in the other order jax traces half as much again.
        values, derivatives = jax.vmap(along, out_axes=(None, 2))(directions)
        if len(self.numbers) == p:
            return values, derivatives
        every = jnp.zeros((*values.shape[:2], p, *values.shape[2:]), derivatives.dtype)
        return values, every.at[:, :, jnp.array(self.numbers)].set(derivatives)


Function = Callable[[Point, Batch], Any]
"""What is compiled: of a point and a chunk."""

Reduced = Callable[[Any, Batch], Any]
"""What is computed on the host, from the arrays of a compiled function and its chunk."""

Blocks = Sequence[Float[np.ndarray, "S p"]]
"""Vectors of a problem, one block in one compiled call."""


class Computation(NamedTuple):
    """What is computed of each chunk: `reduced(function(point, chunk), chunk)` at each block of vectors.

    `realisation`: number of the random draws.
    """

    function: Function
    blocks: Blocks
    reduced: Reduced
    realisation: int = 0


class Parts:
    """The chunks of a problem, on the devices of this process; `rows`: of each, the rows of each trajectory (B,).

    `point`: one whose vectors do not matter.
    """

    def __init__(self, point: Point, pieces: Iterable[Batch]) -> None:
        self.point, self.chunks = point, list(placed(pieces))
        self.rows: list[Int[np.ndarray, " B"]] = [lengths_of(chunk) for chunk in self.chunks]

    def compute(self, computation: Computation) -> list[list[Any]]:
        """The results of all chunks, in their order."""
        chunks = self.chunks
        if computation.realisation:
            chunks = [fresh_keys(chunk, computation.realisation) for chunk in chunks]
        points = [self.point.at(block) for block in computation.blocks]
        # Values of rows are computed by the program that tracks recordings.
        run = rows_of_runs if computation.function is plain_rows else partial(run_chunks, computation.function)
        results = iter(run([(point, chunk) for chunk in chunks for point in points]))
        return [[computation.reduced(next(results), chunk) for _ in points] for chunk in chunks]


def fresh_keys(part: Batch, realisation: int) -> Batch:
    """The batch with the random keys of another realisation."""
    return eqx.tree_at(lambda b: b.key, part, _folded(part.key, realisation))


@jax.jit
def _folded(keys: UInt32[Array, "2 B"], realisation: int) -> UInt32[Array, "2 B"]:
    """Raw keys (2, B) with a number folded in."""
    fold = jax.vmap(lambda k: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(k), realisation)), -1, -1)
    return fold(keys)
