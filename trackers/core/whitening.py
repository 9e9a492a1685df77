"""Whitening of correlated channels by the Cholesky factor of the covariance of the channels seen."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp

from trackers.core.algebra import Scalar, total


def whiten(
    differences: Sequence[Scalar], covariance: Sequence[Sequence[Scalar]], seen: Sequence[Scalar]
) -> tuple[list[Scalar], list[Scalar]]:
    """L⁻¹d with LLᵀ the covariance of the channels seen, zero for masked channels, and the diagonal of L.

    `covariance`: n rows, symmetric positive definite. Its log determinant is twice the sum of the logarithms of the
    diagonal over the channels seen.
    """
    L: list[list[Scalar]] = []
    result: list[Scalar] = []
    for i, (d, saw) in enumerate(zip(differences, seen, strict=True)):
        row: list[Scalar] = []
        for j in range(i):
            remainder = covariance[i][j] - total(row[k] * L[j][k] for k in range(j))
            row.append(jnp.where(seen[j], remainder / L[j][j], 0.0))
        row.append(jnp.sqrt(covariance[i][i] - total(x * x for x in row)))
        L.append(row)
        result.append(jnp.where(saw, (d - total(x * w for x, w in zip(row, result, strict=False))) / row[i], 0.0))
    return result, [row[i] for i, row in enumerate(L)]
