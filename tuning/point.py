"""An objective of a tracker at vectors of its parameters, as functions to be compiled: sums, rows and derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.tunable import AbstractTunable
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.tuning.objectives import AbstractObjective
from trackwright.tuning.parameters import Parameter, with_parameters

BESIDE = ("nis", "nis_dof", "log_likelihood")
"""The numbers of a row beside the terms of the objective."""


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

    def tracker_at(self, vector: Float[Array, " p"]) -> AbstractTracker:
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
    """The terms of every row per vector and trajectory, then `BESIDE` (S, k + 3, T, B), for few trajectories.

    The host adds the terms in double precision, and derivatives of rows come with those of the sums.
    """

    def scores(output: Output, truth: Any) -> tuple[Any, ...]:
        return *point.objective.terms(output, truth), output.nis, output.nis_dof, output.log_likelihood

    return (point.map_vectors(lambda v: jnp.stack(point.tracker_at(v).accumulate(batch, scores, every_row=True))),)


def term_sums(point: Point, batch: Batch) -> tuple[Float[Array, "S k B"], Float[Array, "S k p B"]]:
    """The sums per vector, term and trajectory (S, k, B), and their derivatives (S, k, p, B), all tangents at once."""
    return _with_derivatives(plain_sums, point, batch)


def row_terms(point: Point, batch: Batch) -> tuple[Float[Array, "S k T B"], Float[Array, "S k p T B"]]:
    """The numbers of every row as in `plain_rows`, and their derivatives (S, k + 3, p, T, B)."""
    return _with_derivatives(plain_rows, point, batch)


def _with_derivatives(function: Callable[[Point, Batch], tuple[Array]], point: Point, batch: Batch) -> tuple[Any, Any]:
    """What a function of a point returns, and its derivatives as the third axis."""

    def at(vectors: Float[Array, "S p"]) -> Any:
        return function(eqx.tree_at(lambda p: p.vectors, point, vectors), batch)[0]

    def along(direction: Float[Array, " p"]) -> tuple[Any, Any]:
        """The values, and their derivatives along one direction, the same for every vector."""
        return jax.jvp(at, (point.vectors,), (jnp.broadcast_to(direction, point.vectors.shape),))

    # Vectors inside and directions outside: in the other order jax traces half as much again.
    return jax.vmap(along, out_axes=(None, 2))(jnp.eye(point.vectors.shape[1], dtype=point.vectors.dtype))
