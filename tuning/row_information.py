"""Scores of single rows, and the information (BHHH) of a likelihood from their squares alone.

    s_t  derivative of row t's log-likelihood by the unconstrained vector, (p,)      J = Σ s_t s_tᵀ, (p, p)

At the true parameters of a true model the s_t are uncorrelated with mean zero, and J estimates the information (Berndt,
Hall, Hall and Hausman 1974): positive semidefinite, and without second derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackers.core.chunks import run_chunks
from trackers.core.recording import Batch
from tuning.problem import Point, Problem


class RowInformation(NamedTuple):
    """Per vector and trajectory: log-likelihoods (S, n), scores (S, p, n) and information (S, p, p, n), in nats."""

    log_likelihoods: Float[Array | np.ndarray, "S n"]
    scores: Float[Array | np.ndarray, "S p n"]
    information: Float[Array | np.ndarray, "S p p n"]


class _BlockPoint(eqx.Module):
    """A point, and the number of rows whose scores are added before they are squared."""

    point: Point
    block: int = eqx.field(static=True)


def row_information(problem: Problem, vectors: Float[np.ndarray, "S p"], block: int = 1) -> RowInformation:
    """The summed scores of the rows and the sums of their squares at `vectors` (S, p); one compiled call per chunk.

    Scores of `block` consecutive rows are added before they are squared, which makes the information valid for errors
    correlated over that many rows. Padding trajectories contribute zeros. Memory grows with the rows.
    """
    point = _BlockPoint(problem.point(vectors), block)
    found = run_chunks(_over_vectors, [(point, part) for part in problem.chunks])
    return RowInformation(*(np.concatenate([np.asarray(x, float) for x in xs], -1) for xs in zip(*found, strict=True)))


def _over_vectors(model: _BlockPoint, batch: Batch) -> RowInformation:
    """All vectors one after another, with the memory of one."""
    return RowInformation(*jax.lax.map(lambda vector: _at(model, vector, batch), model.point.vectors))


def _at(
    model: _BlockPoint, vector: Float[Array, " p"], batch: Batch
) -> tuple[Float[Array, " n"], Float[Array, "p n"], Float[Array, "p p n"]]:
    def rows(v: Float[Array, " p"]) -> tuple[Float[Array, "T n"], Float[Array, "T n"]]:
        log_likelihoods = model.point.tracker_at(v).scan(batch)[0].log_likelihood
        return log_likelihoods, log_likelihoods

    scores, log_likelihoods = jax.jacfwd(rows, has_aux=True)(vector)
    count, trajectories, p = scores.shape
    blocks = -(-count // model.block)
    padding = jnp.zeros((blocks * model.block - count, trajectories, p), scores.dtype)
    blocked = jnp.concatenate([scores, padding]).reshape(blocks, model.block, trajectories, p).sum(axis=1)
    # Entry by entry: (blocks, trajectories, p, p) at once would need p times the memory of the scores.
    information = [[jnp.sum(blocked[..., i] * blocked[..., j], axis=0) for j in range(p)] for i in range(p)]
    return jnp.sum(log_likelihoods, axis=0), jnp.sum(scores, axis=0).T, jnp.array(information)
