"""The objective of a tracker as a function of unconstrained vectors: compiled once, many vectors in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num, Shaped

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.filters.particle.filter import AbstractParticleFilter
from trackwright.trackers.core.model.covariance import few
from trackwright.trackers.core.run.chunks import CHUNK, as_dtype, most_few
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.tuning.batches import Pieces, by_chunks, padded_size
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, flatten
from trackwright.tuning.parts import BESIDE, Computation, Parts, Point, WithDerivatives, plain_rows, plain_sums
from trackwright.tuning.priors import Penalty, Prior

Vectors = Float[np.ndarray, "*S p"]
Terms = Float[np.ndarray, "many k n"]
Values = Float[np.ndarray, " many"]
"""Unconstrained vectors of p numbers, S of them or one; the terms of a number of them, and their values."""

MAX_VECTORS = 8
"""Most vectors in one compiled call: with some dozens of trajectories, eight cost little more than one."""

REMEMBERED = 100
"""Vectors whose sums are kept, of few trajectories: an optimum, for one, was evaluated as a step before."""

MAX_GRADIENT_RATIO = 1e3
"""Gradient size of a trajectory, relative to the median, above which the trajectory is excluded."""


class Evaluation(NamedTuple):
    """An objective of k sums at S vectors of p numbers over n trajectories.

    `used` (S, n): the trajectories that count at each vector. `values` (S,), `gradients` (S, p): the objective over
    these and its derivatives; `sums` (S, k). `terms` (S, k, n), `term_gradients` (S, k, p, n): each trajectory's part
    of the sums, times its weight, and its derivatives, not finite where a filter diverged. `filter_runs`: trajectories
    filtered, once per vector.
    """

    values: Float[np.ndarray, " S"]
    gradients: Float[np.ndarray, "S p"]
    sums: Float[np.ndarray, "S k"]
    terms: Float[np.ndarray, "S k n"]
    term_gradients: Float[np.ndarray, "S k p n"]
    used: Bool[np.ndarray, "S n"]
    filter_runs: int

    def at(self, k: int) -> Evaluation:
        """The evaluation at vector `k` alone."""
        alone = {name: x[k : k + 1] for name, x in self._asdict().items() if name != "filter_runs"}
        return Evaluation(**alone, filter_runs=self.filter_runs // len(self.values))

    @property
    def finite(self) -> Bool[np.ndarray, " S"]:
        """Whether value and gradient of each vector (S,) are finite."""
        finite: Bool[np.ndarray, " S"] = np.isfinite(self.values) & np.isfinite(self.gradients).all(axis=1)
        return finite


class Problem:
    """The objective of a tracker over batches as a function of unconstrained vectors, compiled once per shape.

    `prior`: added to a likelihood, of which `discount` is the part that counts: errors that last carry the information
    of fewer rows. `weights`: of the trajectories of each batch, default 1; the terms of a trajectory and their
    derivatives are multiplied by its weight. `keep`: takes the rows to where they are computed, in this
    process or on workers. `sizes`: trajectories of each batch, with padding. `stochastic`: whether the tracker uses
    random numbers. `moving`: the numbers by which derivatives are computed, all unless it is known that the others have
    no effect.

    A filter on the verge of losing a track has derivatives without bound, which would dominate all others. So
    `evaluate` leaves such a trajectory out of value and gradient alike, besides those that are not finite: its gradient
    is its value's. Which trajectories these are depends on the vector, and values over different trajectories are
    not comparable: a line search compares `values_over` those that count at both of its points. `values`, without
    derivatives, leaves out only what is not finite; it ranks points and starts, and is compared with itself alone.
    """

    def __init__(
        self,
        tracker: AbstractTracker,
        batches: Sequence[Batch],
        objective: AbstractObjective,
        parameters: Sequence[Parameter],
        chunk: int = CHUNK,
        weights: Sequence[Float[np.ndarray, " B"]] | None = None,
    ):
        self.objective, self.parameters = objective, list(parameters)
        self.prior, self.discount = Prior.of(self.parameters, "flat"), 1.0
        dtype = batches[0].columns(0, 1).dt.dtype
        self.tracker = as_dtype(tracker, dtype)
        start = jnp.asarray(flatten(self.parameters)[None], dtype)
        self.start = Point(self.tracker, self.objective, self.parameters, start)
        most = most_few(self.tracker, gradient=True)
        self.parts = Parts(self.start, Pieces(batches, chunk, most))
        self.sizes = [padded_size(batch, chunk, most) for batch in batches]
        self.weights = by_chunks(weights, self.sizes)
        self.valid = np.concatenate(self.parts.rows) > 0
        trajectories = max(len(rows) for rows in self.parts.rows)
        # As many vectors as keep a compiled call about as large as a full chunk. Few trajectories gain nothing by more
        # than one, nor does a filter with a particle axis, which would compute both sides of its conditions at every
        # row.
        fitting = CHUNK // (1 << (trajectories - 1).bit_length())
        self.few, self.stochastic = few(trajectories), is_stochastic(self.tracker)
        self.moving = tuple(range(start.shape[1]))
        alone = self.few or has_particles(self.tracker) or not self.parameters
        self.vectors_per_call = 1 if alone else max(1, min(MAX_VECTORS, fitting))
        self.lately: dict[tuple[Any, ...], Sequence[tuple[np.ndarray, ...]]] = {}

    def evaluate(
        self, vectors: Vectors, weights: Num[np.ndarray, "*many n"] | None = None, realisation: int = 0
    ) -> Evaluation:
        """The objective and its gradient at vectors (S, p), over the trajectories that are usable there.

        `weights` (n,) or (S, n): multiplicity of each trajectory, besides its own weight. `realisation`: number of the
        random draws, where the tracker uses any.
        """
        by_part = self._run(self.with_derivatives, vectors, realisation)
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
        runs = self.n_trajectories * len(terms)
        return Evaluation(values + prior.values, gradients + prior.gradients, sums, terms, term_gradients, used, runs)

    def values_over(self, count: Shaped[np.ndarray, "many n"], vectors: Vectors, terms: Terms) -> Values:
        """The objective (S,) at vectors (S, p) from its `terms` (S, k, n) there, over chosen trajectories.

        `count` (S, n): multiplicity of each trajectory, 0 to leave it out.
        """
        sums = weighted_sum(terms, count)
        return self.values_of(sums) + self.prior_penalty(vectors, sums).values

    def n_excluded(self, evaluation: Evaluation) -> int:
        """The number of trajectories left out of an evaluation, at the vector with the fewest."""
        return int(self.valid.sum() - evaluation.used.sum(axis=1).max())

    def values(self, vectors: Vectors) -> Values:
        """The objective (S,) at vectors (S, p) over all trajectories that are finite there, at a third of the cost.

        `evaluate` leaves out more, those without usable derivatives; elsewhere the two are one function.
        """
        return self.finite_values(vectors, self.terms(vectors))

    def finite_values(self, vectors: Vectors, terms: Terms) -> Values:
        """`values` (S,) from the terms (S, k, n) at vectors (S, p)."""
        return self.values_over(np.isfinite(terms).all(axis=1), vectors, terms)

    @property
    def n_trajectories(self) -> int:
        """The number of trajectories that one vector filters."""
        return int(self.valid.sum())

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

    def point(self, vectors: Vectors) -> Point:
        """The argument of `with_derivatives` at vectors (S, p)."""
        return self.start.at(vectors)

    @property
    def with_derivatives(self) -> WithDerivatives:
        """The function of a point and a chunk that `evaluate` runs."""
        return WithDerivatives(plain_rows if self.few else plain_sums, self.moving)

    def _run(self, function: Callable[..., Any], vectors: Vectors, realisation: int) -> list[tuple[np.ndarray, ...]]:
        """The arrays of `function` for every chunk at all vectors, float64 on the host."""
        vectors = np.atleast_2d(np.asarray(vectors, float))
        size, width = len(vectors), self.vectors_per_call
        padded = np.concatenate([vectors, np.repeat(vectors[-1:], -size % width, axis=0)])
        blocks = list(padded.reshape(len(padded) // width, width, vectors.shape[1]))
        # Of the repeated vectors of an only block nothing travels.
        reduced = partial(_summed_rows if self.few else _first_vectors, min(width, size))
        realisation = realisation if self.stochastic else 0
        computation = Computation(function, blocks, reduced, realisation)
        by_part = self._run_once(computation) if self.few else self.parts.compute(computation)
        return [
            tuple(np.concatenate([np.asarray(x, float) for x in xs])[:size] for xs in zip(*of_part, strict=True))
            for of_part in by_part
        ]

    def _run_once(self, computation: Computation) -> list[list[tuple[np.ndarray, ...]]]:
        """As `Parts.compute`, without those vectors, a block each, that it had lately."""
        blocks = computation.blocks
        keys = [(computation.function, computation.realisation, block.tobytes()) for block in blocks]
        new = {key: block for key, block in zip(keys, blocks, strict=True) if key not in self.lately}
        if new:
            by_part = self.parts.compute(computation._replace(blocks=list(new.values())))
            self.lately |= dict(zip(new, zip(*by_part, strict=True), strict=True))
        by_vector = [self.lately[key] for key in keys]
        self.lately = dict(list(self.lately.items())[-REMEMBERED:])
        return [list(of_part) for of_part in zip(*by_vector, strict=True)]


def is_stochastic(tracker: AbstractTracker) -> bool:
    """Whether the tracker uses random numbers."""
    return isinstance(getattr(tracker, "filter", None), AbstractParticleFilter)


def has_particles(tracker: AbstractTracker) -> bool:
    """Whether the filter's belief has an axis of particles or grid cells."""
    return isinstance(tracker, Tracker) and tracker.filter.has_particle_axis


def _first_vectors(count: int, sums: tuple[np.ndarray, ...], chunk: Batch) -> tuple[np.ndarray, ...]:
    """The sums of the trajectories of a chunk at the first `count` vectors."""
    return tuple(x[:count] for x in sums)


def _summed_rows(count: int, rows: tuple[np.ndarray, ...], chunk: Batch) -> tuple[np.ndarray, ...]:
    """The sums of the rows of few trajectories, without the numbers beside the terms, at the first `count` vectors."""
    return tuple(np.sum(x[:count, :-BESIDE], axis=-2, dtype=float) for x in rows)


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
