"""Scores of single rows: what each row says of the parameters, and the curvature that follows from it alone.

    s_t  derivative of row t's log-likelihood by the unconstrained vector, (p,)      J = Σ s_t s_tᵀ, (p, p)

At the true parameters the s_t of a true model are uncorrelated with mean zero and J estimates the information (Berndt,
Hall, Hall and Hausman 1974): a curvature of a likelihood that is never indefinite and takes no second derivative.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.chunks import as_dtype, run_chunks
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from tuning.parameters import Parameter, with_parameters


class RowInformation(NamedTuple):
    """Per vector and trajectory: log-likelihoods (S, n), scores (S, p, n) and information (S, p, p, n), in nats."""

    log_likelihoods: np.ndarray
    scores: np.ndarray
    information: np.ndarray


class _Model(eqx.Module):
    """A tracker, which of its tunables are the parameters, and the vectors (S, p) that they are to be taken from."""

    tracker: AbstractTracker
    names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    examples: tuple[Any, ...]
    vectors: jax.Array
    block: int = eqx.field(static=True)


def row_information(
    tracker: AbstractTracker, parts: Sequence[Batch], parameters: Sequence[Parameter], vectors: Any, block: int = 1
) -> RowInformation:
    """The rows' scores added up, and the sums of their squares, at `vectors` (S, p); one compiled call per part.

    `parts`: what `trackers.core.chunks.chunks` makes of a batch; trajectories without a row that is valid say nothing.
    The scores of `block` rows in a row are added before they are squared: with more than one, the information holds for
    readings whose errors last that long, too. Unlike a gradient's its memory grows with the rows.
    """
    dtype = parts[0].dt.dtype
    names, examples = tuple(p.names for p in parameters), tuple(p.example for p in parameters)
    model = _Model(as_dtype(tracker, dtype), names, as_dtype(examples, dtype), jnp.asarray(vectors, dtype), block)
    found = run_chunks(_of_every_vector, [(model, part) for part in parts])
    return RowInformation(*(np.concatenate([np.asarray(x, float) for x in xs], -1) for xs in zip(*found, strict=True)))


def _of_every_vector(model: _Model, batch: Batch) -> RowInformation:
    """Of all vectors one after another, so that memory is that of one."""
    return RowInformation(*jax.lax.map(lambda vector: _of_one(model, vector, batch), model.vectors))


def _of_one(model: _Model, vector: jax.Array, batch: Batch) -> tuple[jax.Array, jax.Array, jax.Array]:
    parameters = [Parameter(n, e, "") for n, e in zip(model.names, model.examples, strict=True)]

    def rows(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = with_parameters(model.tracker, parameters, v).scan(batch).log_likelihood
        return found, found

    scores, log_likelihoods = jax.jacfwd(rows, has_aux=True)(vector)
    count, trajectories, p = scores.shape
    blocks = -(-count // model.block)
    padding = jnp.zeros((blocks * model.block - count, trajectories, p), scores.dtype)
    blocked = jnp.concatenate([scores, padding]).reshape(blocks, model.block, trajectories, p).sum(axis=1)
    # A product of scalars at a time: (blocks, trajectories, p, p) at once would be p times the memory of the scores.
    information = [[jnp.sum(blocked[..., i] * blocked[..., j], axis=0) for j in range(p)] for i in range(p)]
    return jnp.sum(log_likelihoods, axis=0), jnp.sum(scores, axis=0).T, jnp.array(information)
