"""What a fit makes small, as a function of unconstrained vectors: compiled once, many vectors in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.chunks import CHUNK, as_dtype, chunks, run_chunks
from trackers.core.particle.filter import ParticleFilter
from trackers.core.recording import Batch
from trackers.core.scan import has_particle_axis
from trackers.core.tracker import AbstractTracker, Tracker
from tuning.gauss_newton import row_terms
from tuning.objectives import AbstractObjective
from tuning.parameters import Parameter, with_parameters
from tuning.priors import Penalty, Prior, penalty

WIDTH = 8
"""The most vectors that one compiled call takes: with few recordings, eight cost little more than one."""


class Evaluations(NamedTuple):
    """An objective at S vectors of p numbers over n trajectories, made of k sums.

    `terms` and `slopes` are those of each trajectory, not finite for one that is lost; `used`: those that had a say.
    `curvatures` (S, p, p) are those of the objective by `tuning.gauss_newton`, where asked for, else NaN.
    """

    values: np.ndarray
    gradients: np.ndarray
    sums: np.ndarray
    terms: np.ndarray
    slopes: np.ndarray
    used: np.ndarray
    curvatures: np.ndarray


class Problem:
    """The objective of a tracker over batches as a function of unconstrained vectors, compiled once per shape.

    `filter_runs` counts trajectories filtered, one for each vector; `n_excluded`: trajectories without usable derivatives
    at that one of the last vectors where they were fewest. `priors` count beside a likelihood; nothing else can be
    weighed against them.
    """

    def __init__(
        self,
        tracker: AbstractTracker,
        batches: Sequence[Batch],
        objective: AbstractObjective,
        parameters: Sequence[Parameter],
        chunk: int = CHUNK,
        priors: Sequence[Prior] = (),
    ):
        self.priors = tuple(priors)
        self.objective, self.parameters = objective.informed(tracker), list(parameters)
        self.dtype = batches[0].dt.dtype
        self.tracker = as_dtype(tracker, self.dtype)
        self.chunks = [part for batch in batches for part in chunks(batch, chunk)]
        self.valid = np.concatenate([np.asarray(part.valid).any(axis=0) for part in self.chunks])
        trajectories = max(part.size for part in self.chunks)
        # As many vectors at once as keep a compiled call about as large as a full chunk. A filter with an axis of its
        # own gains nothing by more than one, and would compute both sides of its conditions at every row.
        has_particles = isinstance(self.tracker, Tracker) and has_particle_axis(self.tracker)
        self.width = 1 if has_particles else max(1, min(WIDTH, CHUNK // (1 << (trajectories - 1).bit_length())))
        self.filter_runs = 0
        self.n_excluded = 0

    def evaluate(
        self,
        vectors: np.ndarray,
        weights: np.ndarray | None = None,
        parts: Sequence[int] | None = None,
        curvature: bool = False,
        turn: int = 0,
    ) -> Evaluations:
        """The objective and its gradient at vectors (S, p), without trajectories that aren't finite.

        `weights` (n,) or (S, n): how often each trajectory counts. `parts`: the chunks that count, default all.
        `curvature`: of a likelihood, whose memory then grows with the rows. `turn`: another turn has other random
        numbers, where the tracker draws any.
        """
        found = self._over(curved_sums if curvature else term_sums, vectors, parts, turn)
        terms, slopes, *information = (np.concatenate(xs, axis=-1) for xs in zip(*found, strict=True))
        finite = np.isfinite(terms).all(axis=1)
        used = finite & np.stack([_steady(s) for s in slopes])
        count = np.ones(1) if weights is None else np.atleast_2d(np.asarray(weights, float))
        sums = _added(terms, finite * count)
        slope = _added(slopes, used * count)
        values, by_sum = (np.asarray(x, float) for x in figures(self.objective, jnp.asarray(sums)))
        valid = self._valid(parts)
        self.n_excluded = int(np.min(np.sum(~used & valid, axis=1)))
        with np.errstate(invalid="ignore"):  # where nothing is scored figure and gradient are NaN
            gradients = np.einsum("sk,skp->sp", by_sum, slope)
        # The priors of a part of the trajectories weigh as much less as they are fewer.
        said = self.against(vectors, sums, float(valid.sum() / self.valid.sum()))
        values, gradients = values + said.values, gradients + said.gradients
        curvatures = np.full((len(values), slope.shape[-1], slope.shape[-1]), np.nan)
        if curvature:
            curved = used & np.isfinite(information[0]).all(axis=(1, 2))
            curvatures = _added(information[0], curved * count) / self._units(sums)[:, None, None] + said.curvature
        return Evaluations(values, gradients, sums, terms, slopes, used & valid, curvatures)

    def values(self, vectors: np.ndarray, turn: int = 0) -> np.ndarray:
        """The objective (S,) at vectors (S, p), without derivatives: a third of the work."""
        terms = self.terms(vectors, turn)
        sums = _added(terms, np.isfinite(terms).all(axis=1))
        return self.figures(sums) + self.against(vectors, sums).values

    def terms(self, vectors: np.ndarray, turn: int = 0) -> np.ndarray:
        """The sums per vector, term and trajectory (S, k, n), without derivatives."""
        return np.concatenate([t for (t,) in self._over(plain_sums, vectors, None, turn)], axis=-1)

    def figures(self, sums: np.ndarray) -> np.ndarray:
        """The objective (S,) that sums (S, k) make."""
        return np.asarray(figures(self.objective, jnp.asarray(sums))[0], float)

    def against(self, vectors: np.ndarray, sums: np.ndarray, share: float = 1.0) -> Penalty:
        """What the priors add to the objective (S,) and its derivatives, where a likelihood has these sums (S, k)."""
        vectors = np.atleast_2d(np.asarray(vectors, float))
        said = penalty(self.priors, self.parameters, vectors)
        if not self.priors:
            return said
        scale = share / self._units(sums)
        return Penalty(said.values * scale, said.gradients * scale[:, None], said.curvature * scale[:, None, None])

    def _units(self, sums: np.ndarray) -> np.ndarray:
        return np.array([self.objective.log_likelihood_units(s) for s in sums])

    @property
    def random(self) -> bool:
        """Whether the tracker draws random numbers."""
        return is_random(self.tracker)

    def at(self, vectors: np.ndarray) -> Point:
        """What `term_sums` takes, at vectors (S, p)."""
        return Point(self.tracker, self.objective, self.parameters, jnp.asarray(np.atleast_2d(vectors), self.dtype))

    def _over(
        self, function: Any, vectors: np.ndarray, parts: Sequence[int] | None, turn: int
    ) -> list[tuple[np.ndarray, ...]]:
        """What `function` gives for every chunk, of all vectors in blocks of one width, float64 on the host."""
        vectors = np.atleast_2d(np.asarray(vectors, float))
        size = len(vectors)
        self.filter_runs += size * int(self._valid(parts).sum())
        padded = np.concatenate([vectors, np.repeat(vectors[-1:], -size % self.width, axis=0)])
        blocks = [self.at(block) for block in padded.reshape(-1, self.width, vectors.shape[1])]
        some = self.chunks if parts is None else [self.chunks[k] for k in parts]
        if self.random and turn:
            some = [fresh_keys(part, turn) for part in some]
        found = run_chunks(function, [(block, part) for part in some for block in blocks])
        return [
            tuple(np.concatenate([np.asarray(x, float) for x in xs])[:size] for xs in zip(*of_part, strict=True))
            for of_part in (found[k : k + len(blocks)] for k in range(0, len(found), len(blocks)))
        ]

    def _valid(self, parts: Sequence[int] | None) -> np.ndarray:
        if parts is None:
            return self.valid
        starts = np.cumsum([0, *(part.size for part in self.chunks)])
        return np.concatenate([self.valid[starts[k] : starts[k + 1]] for k in parts])


def is_random(tracker: AbstractTracker) -> bool:
    """Whether the tracker draws random numbers."""
    return isinstance(getattr(tracker, "filter", None), ParticleFilter)


def fresh_keys(part: Batch, turn: int) -> Batch:
    """The part with other random keys of its trajectories, for another turn."""
    return eqx.tree_at(lambda b: b.key, part, _folded(part.key, turn))


@jax.jit
def _folded(keys: jax.Array, turn: int) -> jax.Array:
    """Raw keys (2, B) with a number folded in."""
    fold = jax.vmap(lambda key: jax.random.key_data(jax.random.fold_in(jax.random.wrap_key_data(key), turn)), -1, -1)
    return fold(keys)


def _added(x: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The sums over trajectories of (S, …, n), each as often as `counts` (S, n) says; others may be NaN."""
    counts = counts.reshape(len(counts), *[1] * (x.ndim - 2), -1)
    return np.sum(np.where(counts > 0, x, 0.0) * counts, axis=-1)


def _steady(slopes: np.ndarray) -> np.ndarray:
    """Which trajectories (B,) have derivatives (k, p, B) to go by: finite, and not thousands of times the usual.

    A filter that hesitates between two tracks depends on every number without measure; where all others have
    something to say, such a trajectory has not.
    """
    size = np.sqrt(np.sum(np.where(np.isfinite(slopes), slopes, np.inf) ** 2, axis=(0, 1)))
    moving = size[np.isfinite(size) & (size > 0)]
    return np.isfinite(size) & (size <= 1e3 * np.median(moving)) if len(moving) else np.isfinite(size)


@eqx.filter_jit
def figures(objective: AbstractObjective, sums: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The figures (S,) of sums (S, k), and their derivatives by the sums."""
    return jax.vmap(jax.value_and_grad(objective.value))(sums)


class Point(eqx.Module):
    """A tracker, an objective and the values of its parameters at S vectors: what the compiled function takes."""

    tracker: AbstractTracker
    objective: AbstractObjective
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    examples: tuple[Any, ...]
    vectors: jax.Array

    def __init__(
        self, tracker: AbstractTracker, objective: AbstractObjective, parameters: Sequence[Parameter], vectors: Any
    ):
        self.tracker, self.objective, self.vectors = tracker, objective, vectors
        self.names = tuple(p.names for p in parameters)
        self.labels = tuple(p.label for p in parameters)
        self.examples = tuple(p.example for p in parameters)

    def placed(self, vector: Any) -> AbstractTracker:
        """The tracker with the parameters of one vector."""
        parts = zip(self.names, self.examples, self.labels, strict=True)
        tracker: AbstractTracker = with_parameters(self.tracker, [Parameter(*part) for part in parts], vector)
        return tracker

    def each(self, function: Any) -> Any:
        """What `function` gives of every vector, stacked in front."""
        if len(self.vectors) == 1:
            return jax.tree_util.tree_map(lambda x: x[None], function(self.vectors[0]))
        return jax.vmap(function)(self.vectors)


def plain_sums(point: Point, batch: Batch) -> tuple[jax.Array]:
    """The sums per vector, term and trajectory (S, k, B)."""
    return (point.each(lambda v: jnp.stack(point.placed(v).accumulate(batch, point.objective.terms))),)


def term_sums(point: Point, batch: Batch) -> tuple[jax.Array, jax.Array]:
    """The sums per vector, term and trajectory (S, k, B), and their derivatives (S, k, p, B), all tangents at once."""

    def sums(vectors: jax.Array) -> jax.Array:
        return plain_sums(eqx.tree_at(lambda p: p.vectors, point, vectors), batch)[0]

    def along(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The sums, and their derivatives along one direction, the same for every vector."""
        return jax.jvp(sums, (point.vectors,), (jnp.broadcast_to(direction, point.vectors.shape),))

    # Vectors inside and directions outside: the other way round, what jax traces is half as large again.
    return jax.vmap(along, out_axes=(None, 2))(jnp.eye(point.vectors.shape[1], dtype=point.vectors.dtype))


def curved_sums(point: Point, batch: Batch) -> tuple[jax.Array, jax.Array, jax.Array]:
    """What `term_sums` gives, and the information (S, p, p, B) of a likelihood, from every row's derivatives."""
    values, (slopes, information) = point.each(lambda v: row_terms(point.placed, point.objective.terms, v, batch))
    return values, slopes, information
