"""The objective of a tracker as a function of unconstrained vectors: compiled once, many vectors in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num, Shaped, UInt32

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.particle.filter import AbstractParticleFilter
from trackwright.trackers.core.model.covariance import few
from trackwright.trackers.core.run.chunks import (
    CHUNK,
    as_dtype,
    called,
    most_few,
    outputs,
    piece_size,
    pieces,
    placed,
    run_chunks,
)
from trackwright.trackers.core.run.latency import scored_truth
from trackwright.trackers.core.run.scan import Output, Score
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, Penalty, Prior, Vector, flatten, with_parameters

Vectors = Float[np.ndarray, "*S p"]
Terms = Float[np.ndarray, "many k n"]
Values = Float[np.ndarray, " many"]
"""Unconstrained vectors of p numbers, S of them or one; the terms of a number of them, and their values."""

MAX_VECTORS = 8  # most vectors in one compiled call: with some dozens of trajectories, eight cost little more than one
MAX_GRADIENT_RATIO = 1e3  # size of a trajectory's gradient, relative to the median, above which it is excluded
BESIDE = 2  # numbers of a row beside the terms of the objective: its `AbstractObjective.squares`


class Point(eqx.Module):
    """A tracker, an objective and S vectors of its parameters: the argument of the compiled functions."""

    tracker: AbstractTracker
    objective: AbstractObjective
    parameters: tuple[Parameter, ...]
    vectors: Float[Array, "S p"]

    def at(self, vectors: Float[np.ndarray, "*S p"]) -> Point:
        """This point at other vectors (S, p) or one."""
        return eqx.tree_at(lambda p: p.vectors, self, jnp.asarray(np.atleast_2d(vectors), self.vectors.dtype))

    def tracker_at(self, vector: Vector) -> AbstractTracker:
        """The tracker with the parameters of one vector."""
        return with_parameters(self.tracker, self.parameters, vector)

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
    tracks = ((point.objective, (run, batch)) for (run, _), (point, batch) in zip(runs, pairs, strict=True))
    return [(np.asarray(called(_scored, *track))[None],) for track in tracks]


def _scored(objective: AbstractObjective, run: tuple[Output, Batch]) -> Float[Array, "k T B"]:
    """The numbers of every row as in `plain_rows`, from its estimate."""
    output, batch = run
    return jnp.stack(jax.vmap(_scores(objective))(output, scored_truth(batch, output.age)))


def _scores(objective: AbstractObjective) -> Score:
    def scores(output: Output, truth: Any) -> tuple[Any, ...]:
        return *objective.terms(output, truth), *objective.squares(output, truth)

    return scores


def sums_with_derivatives(point: Point, batch: Batch) -> tuple[Any, Any]:
    """`plain_sums`, and their derivatives (S, k, p, B)."""
    return _with_derivatives(plain_sums, point, batch)


def rows_with_derivatives(point: Point, batch: Batch) -> tuple[Any, Any]:
    """`plain_rows`, and their derivatives (S, k + 2, p, T, B)."""
    return _with_derivatives(plain_rows, point, batch)


def _with_derivatives(function: Callable[[Point, Batch], tuple[Array]], point: Point, batch: Batch) -> tuple[Any, Any]:
    """What a function returns of a point, and its derivatives, all tangents at once."""

    def at(vectors: Float[Array, "S p"]) -> Any:
        return function(eqx.tree_at(lambda p: p.vectors, point, vectors), batch)[0]

    def along(direction: Float[Array, " p"]) -> tuple[Any, Any]:
        """The values, and their derivatives along one direction, the same for every vector."""
        return jax.jvp(at, (point.vectors,), (jnp.broadcast_to(direction, point.vectors.shape),))

    # Vectors inside and directions outside: in the other order jax traces half as much again.
    return jax.vmap(along, out_axes=(None, 2))(jnp.eye(point.vectors.shape[1], dtype=point.vectors.dtype))


class Evaluation(NamedTuple):
    """An objective of k sums at S vectors of p numbers over n trajectories.

    `used` (S, n): the trajectories that count at each vector. `values` (S,), `gradients` (S, p): the objective over
    these and its derivatives; `sums` (S, k). `terms` (S, k, n), `term_gradients` (S, k, p, n): each trajectory's part
    of the sums, times its weight, and its derivatives, not finite where a filter diverged.
    """

    values: Float[np.ndarray, " S"]
    gradients: Float[np.ndarray, "S p"]
    sums: Float[np.ndarray, "S k"]
    terms: Float[np.ndarray, "S k n"]
    term_gradients: Float[np.ndarray, "S k p n"]
    used: Bool[np.ndarray, "S n"]

    def at(self, k: int) -> Evaluation:
        """The evaluation at vector `k` alone."""
        return Evaluation(*(x[k : k + 1] for x in self))

    @property
    def finite(self) -> Bool[np.ndarray, " S"]:
        """Whether value and gradient of each vector (S,) are finite."""
        finite: Bool[np.ndarray, " S"] = np.isfinite(self.values) & np.isfinite(self.gradients).all(axis=1)
        return finite


class Problem:
    """The objective of a tracker over batches as a function of unconstrained vectors, compiled once per shape.

    `prior`: added to a likelihood, of which `discount` is the part that counts: errors that last carry the information
    of fewer rows. `weights`: of the trajectories of each batch, default 1; the terms of a trajectory and their
    derivatives are multiplied by its weight. `chunks`: the rows, on their devices; `rows`: of each chunk, the rows of
    each trajectory (B,). `sizes`: trajectories of each batch, with padding. `stochastic`: whether the tracker uses
    random numbers. `filter_runs`: trajectories filtered so far, once per vector.

    A filter on the verge of losing a track has derivatives without bound, which would dominate all others. So
    `evaluate` leaves such a trajectory out of value and gradient alike, besides those that are not finite: its gradient
    is its value's. Which trajectories these are depends on the vector, and values over different trajectories are
    not comparable: a line search compares `values_over` those that count at both of its points. `values`, without
    derivatives, leaves out only what is not finite; it ranks points and starts, and is compared with itself alone.
    """

    def __init__(
        self, tracker: AbstractTracker, batches: Sequence[Batch], objective: AbstractObjective,
        parameters: Sequence[Parameter], chunk: int = CHUNK, weights: Sequence[Float[np.ndarray, " B"]] | None = None,
    ):  # fmt: skip
        self.objective, self.parameters = objective, list(parameters)
        self.prior, self.discount, self.filter_runs = Prior.of(self.parameters, "flat"), 1.0, 0
        dtype = batches[0].columns(0, 1).dt.dtype
        self.tracker = as_dtype(tracker, dtype)
        start = jnp.asarray(flatten(self.parameters)[None], dtype)
        self.start = Point(self.tracker, self.objective, tuple(self.parameters), start)
        most = most_few(self.tracker, gradient=True)
        self.chunks = list(placed(part for batch in batches for part in pieces(batch, chunk, most)))
        self.rows: list[Int[np.ndarray, " B"]] = [np.asarray(part.valid).sum(axis=0) for part in self.chunks]
        of_pieces = [piece_size(batch.size, len(batch.dt), chunk, most) for batch in batches]
        self.sizes = [size * -(-batch.size // size) for batch, size in zip(batches, of_pieces, strict=True)]
        given = [np.ones(batch.size) for batch in batches] if weights is None else weights
        padded = (np.append(x, np.ones(size - len(x))) for x, size in zip(given, self.sizes, strict=True))
        self.weights: Float[np.ndarray, " n"] = np.concatenate([*padded])
        self.valid = np.concatenate(self.rows) > 0
        trajectories = max(map(len, self.rows))
        # As many vectors as keep a compiled call about as large as a full chunk. Few trajectories gain nothing by more
        # than one, nor does a filter with a particle axis, which would compute both sides of its conditions at every
        # row.
        fitting = CHUNK // (1 << (trajectories - 1).bit_length())
        self.few, self.stochastic = few(trajectories), is_stochastic(self.tracker)
        has_particles = isinstance(self.tracker, Tracker) and self.tracker.filter.has_particle_axis
        alone = self.few or has_particles or not self.parameters
        self.vectors_per_call = 1 if alone else max(1, min(MAX_VECTORS, fitting))

    def evaluate(
        self, vectors: Vectors, weights: Num[np.ndarray, "*many n"] | None = None, realisation: int = 0
    ) -> Evaluation:
        """The objective and its gradient at vectors (S, p), over the trajectories that are usable there.

        `weights` (n,) or (S, n): multiplicity of each trajectory, besides its own weight. `realisation`: number of the
        random draws, where the tracker uses any.
        """
        function = rows_with_derivatives if self.few else sums_with_derivatives
        by_part = self._run(function, vectors, realisation)
        terms, term_gradients = (np.concatenate(xs, axis=-1) for xs in zip(*by_part, strict=True))
        used = np.isfinite(terms).all(axis=1) & np.stack([_usable(x) for x in term_gradients])
        used &= self.valid
        terms, term_gradients = self.weights * terms, self.weights * term_gradients
        count = used if weights is None else used * np.atleast_2d(np.asarray(weights, float))
        sums = weighted_sum(terms, count)
        values, by_sum = (np.asarray(x, float) for x in value_and_gradient(self.objective, jnp.asarray(sums)))
        with np.errstate(invalid="ignore"):  # without a single scored row value and gradient are NaN
            gradients = np.einsum("sk,skp->sp", by_sum, weighted_sum(term_gradients, count))
        prior = self.prior_penalty(vectors, sums)
        return Evaluation(values + prior.values, gradients + prior.gradients, sums, terms, term_gradients, used)

    def values_over(self, count: Shaped[np.ndarray, "many n"], vectors: Vectors, terms: Terms) -> Values:
        """The objective (S,) at vectors (S, p) from its `terms` (S, k, n) there, over chosen trajectories.

        `count` (S, n): multiplicity of each trajectory, 0 to leave it out.
        """
        sums = weighted_sum(terms, count)
        return self.values_of(sums) + self.prior_penalty(vectors, sums).values

    def values(self, vectors: Vectors) -> Values:
        """The objective (S,) at vectors (S, p) over all trajectories that are finite there, at a third of the cost.

        `evaluate` leaves out more, those without usable derivatives; elsewhere the two are one function.
        """
        return self.finite_values(vectors, self.terms(vectors))

    def finite_values(self, vectors: Vectors, terms: Terms) -> Values:
        """`values` (S,) from the terms (S, k, n) at vectors (S, p)."""
        return self.values_over(np.isfinite(terms).all(axis=1), vectors, terms)

    def terms(self, vectors: Vectors, realisation: int = 0) -> Terms:
        """Each trajectory's part of the sums (S, k, n), without derivatives."""
        function = plain_rows if self.few else plain_sums
        return self.weights * np.concatenate([t for (t,) in self._run(function, vectors, realisation)], axis=-1)

    def values_of(self, sums: Float[np.ndarray, "S k"]) -> Float[np.ndarray, " S"]:
        """The objective (S,) of sums (S, k), without the prior."""
        return np.asarray(value_and_gradient(self.objective, jnp.asarray(sums))[0], float)

    def prior_penalty(self, vectors: Vectors, sums: Float[np.ndarray, "many k"]) -> Penalty:
        """The prior's part of the objective (S,) and its derivatives at vectors (S, p), in the objective's unit.

        `sums` (S, k): of the likelihood there.
        """
        nats = self.prior.penalty(vectors)
        if not self.prior.precision.any():
            return nats
        nats_per_unit = np.array([self.nats_per_unit(s) for s in sums])
        with np.errstate(divide="ignore", invalid="ignore"):  # without a single scored row there is no likelihood
            return Penalty(nats.values / nats_per_unit, nats.gradients / nats_per_unit[:, None])

    def nats_per_unit(self, sums: Float[np.ndarray, " k"]) -> float:
        """The nats of one unit of the objective, as far as they count; NaN for an objective that is no likelihood."""
        return self.discount * self.objective.nats_per_unit(sums)

    def compute(
        self, function: Callable[..., Any], blocks: Sequence[Vectors], reduced: Callable[..., Any], realisation: int = 0
    ) -> list[list[Any]]:
        """`reduced(function(point, chunk), chunk)` of each chunk, at each block of vectors (S, p).

        `realisation`: number of the random draws, where the tracker uses any.
        """
        chunks = self.chunks
        if self.stochastic and realisation:
            chunks = [eqx.tree_at(lambda b: b.key, chunk, _folded(chunk.key, realisation)) for chunk in chunks]
        points = [self.start.at(block) for block in blocks]
        # Values of rows are computed by the program that tracks recordings.
        run = rows_of_runs if function is plain_rows else partial(run_chunks, function)
        results = iter(run([(point, chunk) for chunk in chunks for point in points]))
        return [[reduced(next(results), chunk) for _ in points] for chunk in chunks]

    def _run(self, function: Callable[..., Any], vectors: Vectors, realisation: int) -> list[tuple[np.ndarray, ...]]:
        """The sums of `function` for every chunk at all vectors, float64 on the host."""
        vectors = np.atleast_2d(np.asarray(vectors, float))
        size, width = len(vectors), self.vectors_per_call
        self.filter_runs += size * int(self.valid.sum())
        padded = np.concatenate([vectors, np.repeat(vectors[-1:], -size % width, axis=0)])
        blocks = padded.reshape(len(padded) // width, width, vectors.shape[1])

        def summed(results: tuple[np.ndarray, ...], chunk: Batch) -> tuple[np.ndarray, ...]:
            """The sums; those of rows without the numbers beside the terms."""
            return tuple(np.sum(x[:, :-BESIDE], axis=-2, dtype=float) for x in results) if self.few else results

        return [
            tuple(np.concatenate([np.asarray(x, float) for x in xs])[:size] for xs in zip(*of_part, strict=True))
            for of_part in self.compute(function, list(blocks), summed, realisation)
        ]


def is_stochastic(tracker: AbstractTracker) -> bool:
    """Whether the tracker uses random numbers."""
    return isinstance(getattr(tracker, "filter", None), AbstractParticleFilter)


@jax.jit
def _folded(keys: UInt32[Array, "2 B"], realisation: int) -> UInt32[Array, "2 B"]:
    """Raw keys (2, B) with a number folded in."""
    fold = jax.vmap(lambda k: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(k), realisation)), -1, -1)
    return fold(keys)


def weighted_sum(
    x: Float[np.ndarray, "S *terms n"], weights: Shaped[np.ndarray, "S n"]
) -> Float[np.ndarray, "S *terms"]:
    """The sums over trajectories of (S, …, n) with weights (S, n); values of weight zero may be NaN."""
    weights = weights.reshape(len(weights), *[1] * (x.ndim - 2), -1)
    return np.sum(np.where(weights > 0, x, 0.0) * weights, axis=-1)


def _usable(term_gradients: Float[np.ndarray, "k p B"]) -> Bool[np.ndarray, " B"]:
    """Which trajectories (B,) have usable derivatives (k, p, B): finite, and at most 1000 times the median size."""
    size = np.sqrt(np.sum(np.where(np.isfinite(term_gradients), term_gradients, np.inf) ** 2, axis=(0, 1)))
    moving = size[np.isfinite(size) & (size > 0)]
    return np.isfinite(size) & (size <= MAX_GRADIENT_RATIO * np.median(moving)) if len(moving) else np.isfinite(size)


@eqx.filter_jit
def value_and_gradient(
    objective: AbstractObjective, sums: Float[Array, "S k"]
) -> tuple[Float[Array, " S"], Float[Array, "S k"]]:
    """The objective (S,) of sums (S, k), and its derivatives (S, k) with respect to the sums."""
    return jax.vmap(jax.value_and_grad(objective.value))(sums)
