"""Scores of single rows, and the information (BHHH) of a likelihood from their squares alone.

    s_t  derivative of row t's log-likelihood by the unconstrained vector, (p,)      J = Σ s_t s_tᵀ, (p, p)

At the true parameters of a true model the s_t are uncorrelated with mean zero, and J estimates the information (Berndt,
Hall, Hall and Hausman 1974): positive semidefinite, and without second derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from trackers.core.chunks import run_chunks
from tuning.point import row_terms
from tuning.problem import Problem


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
    points = [problem.point(vector) for vector in np.atleast_2d(vectors)]
    found = run_chunks(row_terms, [(point, part) for part in problem.chunks for point in points])
    each = [_information(np.asarray(terms[0, -1]), np.asarray(slopes[0, -1]), block) for terms, slopes in found]
    count = len(points)
    parts = [[np.stack(xs) for xs in zip(*each[k : k + count], strict=True)] for k in range(0, len(each), count)]
    return RowInformation(*(np.concatenate(xs, axis=-1) for xs in zip(*parts, strict=True)))


def _information(
    log_likelihoods: Float[np.ndarray, "T n"], scores: Float[np.ndarray, "p T n"], block: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "p n"], Float[np.ndarray, "p p n"]]:
    starts = np.arange(0, len(log_likelihoods), block)
    blocked = np.add.reduceat(scores.astype(float), starts, axis=1)
    information = np.einsum("ibn,jbn->ijn", blocked, blocked)
    return log_likelihoods.sum(axis=0, dtype=float), blocked.sum(axis=1), information
