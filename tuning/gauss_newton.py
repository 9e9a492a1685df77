"""Curvature of a likelihood from its innovations alone: Gauss–Newton, or scoring with the expected information.

For a row of m numbers with innovation ν of covariance S, NIS q = νᵀS⁻¹ν and l = log det S, the expected information is

    ∂νᵀ S⁻¹ ∂ν + tr(S⁻¹∂S S⁻¹∂S)/2  ≈  (∂q + q/m ∂l)²/(4q) + (∂l)²/(2m)

an equality for m = 1 and a lower bound of its second part otherwise. It is never indefinite, takes no second
derivative, and holds far from the optimum too, where squares of scores do not.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from trackers.core.recording import Batch

SMALLEST = 1e-3
"""NIS below which a row says nothing of ∂ν that rounding would not drown."""


def row_terms(
    tracker_of: Any, terms: Any, vector: jax.Array, batch: Batch
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """Of one vector: sums of an objective's terms (k, B), their derivatives (k, p, B), and the information (p, p, B).

    `tracker_of`: the tracker with the numbers of a vector. Rows' derivatives are kept, so memory grows with the rows.
    """

    def rows(v: jax.Array) -> tuple[Any, Any]:
        output = tracker_of(v).scan(batch)
        added = jnp.stack([jnp.sum(x, axis=0) for x in jax.vmap(terms)(output, batch.truth)])
        return (added, output.nis, output.log_likelihood), (added, output.nis, output.nis_dof)

    (slopes, by_nis, by_likelihood), (values, nis, nis_dof) = jax.jacfwd(rows, has_aux=True)(vector)
    m, q = jnp.maximum(nis_dof, 1.0), jnp.maximum(nis, SMALLEST)
    # 2 log-likelihood = −l − q − m log 2π; a row that read nothing has no derivatives.
    p = len(vector)
    by_log = [-2.0 * by_likelihood[..., i] - by_nis[..., i] for i in range(p)]
    apart = [by_nis[..., i] + q / m * by_log[i] for i in range(p)]
    information = [
        [jnp.sum(apart[i] * apart[j] / (4.0 * q) + by_log[i] * by_log[j] / (2.0 * m), axis=0) for j in range(p)]
        for i in range(p)
    ]
    return values, (jnp.moveaxis(slopes, -1, 1), jnp.stack([jnp.stack(row) for row in information]))
