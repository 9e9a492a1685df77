"""Scores of single rows, and the information (BHHH) of a likelihood from their squares alone.

    s_t  derivative of row t's log-likelihood by the unconstrained vector, (p,)      J = Σ s_t s_tᵀ, (p, p)

At the true parameters of a true model the s_t are uncorrelated with mean zero, and J estimates the information (Berndt,
Hall, Hall and Hausman 1974): positive semidefinite, and without second derivatives.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Batch
from trackwright.tuning.point import row_terms
from trackwright.tuning.problem import Problem


class RowInformation(NamedTuple):
    """Per vector and trajectory: log-likelihoods (S, n), scores (S, p, n) and information (S, p, p, n), in nats."""

    log_likelihoods: Float[np.ndarray, "S n"]
    scores: Float[np.ndarray, "S p n"]
    information: Float[np.ndarray, "S p p n"]


def row_information(problem: Problem, vectors: Float[np.ndarray, "S p"], block: int = 1) -> RowInformation:
    """The summed scores of the rows and the sums of their squares at `vectors` (S, p).

    Scores of `block` consecutive rows are added before they are squared, which makes the information valid for errors
    correlated over that many rows. Padding trajectories contribute zeros. Memory grows with the rows.
    """
    found = problem.parts.run(row_terms, list(np.atleast_2d(vectors)[:, None]), partial(_information, block))
    parts = [[np.stack(xs) for xs in zip(*each, strict=True)] for each in found]
    return RowInformation(*(np.concatenate(xs, axis=-1) for xs in zip(*parts, strict=True)))


def _information(
    block: int, found: Any, chunk: Batch
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "p n"], Float[np.ndarray, "p p n"]]:
    """Log-likelihood, scores and information of each trajectory of a chunk, from `row_terms` at one vector."""
    log_likelihoods, scores = (np.asarray(x[0, -1]) for x in found)
    starts = np.arange(0, len(log_likelihoods), block)
    blocked = np.add.reduceat(scores.astype(float), starts, axis=1)
    information = np.einsum("ibn,jbn->ijn", blocked, blocked)
    return log_likelihoods.sum(axis=0, dtype=float), blocked.sum(axis=1), information
