"""Covariances in two forms: a scalar for each entry for many trajectories, one array of all entries for few.

A covariance is its upper triangle, row by row. As a tuple of scalars each entry is one vector over trajectories, and
structural zeros cost nothing: the form for hundreds of trajectories. With few of them an operation costs the same
whether it works on one entry or on a matrix, and thousands of operations compile for minutes: there it is one array,
entries last. The functions here take either form and return the same; both agree to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core import algebra
from trackers.core.algebra import Scalar, SparseRow, Vector, compute_once, dense, full, times, total, triangle

FEW = 8
"""Largest number of trajectories whose covariances are arrays; both forms: `python -m experiments.bench.lanes`."""

Upper = tuple[Scalar, ...] | jax.Array
"""The upper triangle of a covariance, in either form."""

Jacobians = tuple[Sequence[SparseRow], Sequence[SparseRow]]
"""F and G of one stage of a motion."""


def few(trajectories: int) -> bool:
    """Whether the covariances of so many trajectories are arrays."""
    return trajectories <= FEW


def compiler_options(trajectories: int) -> dict[str, str | bool] | None:
    """Options of XLA's compiler for a program of so many trajectories.

    With arrays products of matrices are compiled, not calls of a library: a loop becomes one kernel only without calls.
    """
    return {"xla_cpu_experimental_ynn_fusion_type": ""} if few(trajectories) else None


def as_array(upper: Upper) -> jax.Array:
    """The upper triangle as one array, entries last."""
    return jnp.stack(upper, axis=-1) if isinstance(upper, tuple) else upper


class OneArray:
    """A tree of arrays (…, B) as one array: a loop over rows stores one array in place, not a hundred."""

    structure: Any
    leaves: Sequence[Any]

    def packed(self, tree: Any) -> jax.Array:
        """The leaves of the tree below one another, (numbers, B), in the type of the first."""
        self.leaves, self.structure = jax.tree_util.tree_flatten(tree)
        kind = self.leaves[0].dtype
        return jnp.concatenate([x.reshape(-1, x.shape[-1]).astype(kind) for x in self.leaves])

    def unpacked(self, array: jax.Array) -> Any:
        """The tree of an array (T, numbers, B), with its leaves (T, …, B)."""
        ends = np.cumsum([0, *(x.size // x.shape[-1] for x in self.leaves)])
        leaves = [
            array[:, start:end].reshape(len(array), *x.shape).astype(x.dtype)
            for x, start, end in zip(self.leaves, ends, ends[1:], strict=False)
        ]
        return jax.tree_util.tree_unflatten(self.structure, leaves)


def as_scalars(upper: Upper) -> tuple[Scalar, ...]:
    """The upper triangle as a tuple of scalars."""
    return tuple(upper[..., k] for k in range(upper.shape[-1])) if isinstance(upper, jax.Array) else upper


def by_entry(uppers: Any) -> tuple[jax.Array, ...]:
    """The upper triangles of all time steps and trajectories, (T, entries, B) in the array's form, entry by entry."""
    return uppers if isinstance(uppers, tuple) else tuple(uppers[:, k] for k in range(uppers.shape[1]))


def leading(upper: Upper, n: int, size: int) -> Upper:
    """The upper triangle of the leading block of `size` components, of the covariance of n."""
    kept = [k for k, (_, j) in enumerate(triangle(n)) if j < size]
    return tuple(upper[k] for k in kept) if isinstance(upper, tuple) else upper[..., np.array(kept)]


def congruence(F: Sequence[SparseRow], upper: Upper, G: Sequence[SparseRow]) -> Upper:
    """F P Fᵀ + G Gᵀ, without the structural zeros of F and G."""
    if isinstance(upper, tuple):
        # Entries that are unchanged need no barrier again.
        grown = algebra.congruence(F, upper, G)
        return tuple(a if a is b else compute_once(a) for a, b in zip(grown, upper, strict=True))
    n = len(F)
    rows, columns = np.triu_indices(n)
    P = matrix(upper, n)
    changed = [i for i, row in enumerate(F) if not _is_unit(row, i)]
    if changed:
        needed = np.array(sorted({j for i in changed for j in F[i]}))
        block = _array([F[i].get(int(j)) for i in changed for j in needed], upper, len(changed), len(needed))
        new = np.arange(n)
        new[changed] = n + np.arange(len(changed))
        P = jnp.concatenate([P, block @ P[needed]])[new]
        P = jnp.concatenate([P, P[:, needed] @ block.T], axis=1)[:, new]
    noise = [_inner(G[i], G[j]) for i, j in triangle(n)]
    return P[rows, columns] + (_array(noise, upper, len(noise)) if any(q is not None for q in noise) else 0.0)


def matrix(upper: Upper, n: int) -> jax.Array:
    """The symmetric matrix (n, n) of one trajectory."""
    return dense(upper, n) if isinstance(upper, tuple) else upper[_positions(n)]


def upper_of(matrix: jax.Array, like: Upper) -> Upper:
    """The upper triangle of a matrix (n, n) in the form of another."""
    n = len(matrix)
    return tuple(matrix[i, j] for i, j in triangle(n)) if isinstance(like, tuple) else matrix[np.triu_indices(n)]


def matched(weights: Sequence[Scalar], covs: Sequence[Upper], deviations: Sequence[Sequence[Scalar]]) -> Upper:
    """The covariance Σ w (P + ddᵀ) of a mixture whose components deviate from its mean by d."""
    if isinstance(covs[0], tuple):
        return tuple(
            total(w * (P[k] + d[i] * d[j]) for w, P, d in zip(weights, covs, deviations, strict=True))
            for k, (i, j) in enumerate(triangle(len(deviations[0])))
        )
    rows, columns = np.triu_indices(len(deviations[0]))
    each = [jnp.stack(list(d)) for d in deviations]
    parts = zip(weights, [as_array(P) for P in covs], each, strict=True)
    found: jax.Array = total(w * (P + d[rows] * d[columns]) for w, P, d in parts)
    return found


def zeros(upper: Upper, n: int) -> Any:
    """A zero vector of n components, a `Vector` or an array."""
    zero = jnp.zeros_like(upper[0])
    return Vector.of([zero] * n) if isinstance(upper, tuple) else jnp.zeros((n,), upper.dtype)


def predicted(stages: Sequence[Jacobians], upper: Upper) -> Upper:
    """The covariance after the stages of a motion with these F and G, one by one or, as an array, all at once."""
    for F, G in stages if isinstance(upper, tuple) else [_composed(stages)]:
        upper = congruence(F, upper, G)
    return upper


def _composed(stages: Sequence[Jacobians]) -> Jacobians:
    """F and G of all stages together."""
    F, G = stages[0]
    for F_next, G_next in stages[1:]:
        F = [_row_product(row, F) for row in F_next]
        G = [_sum(_row_product(row, G), own) for row, own in zip(F_next, G_next, strict=True)]
    return F, G


def _row_product(row: SparseRow, rows: Sequence[SparseRow]) -> SparseRow:
    found: SparseRow = {}
    for j, f in row.items():
        found = _sum(found, {q: times(f, g) for q, g in rows[j].items()})
    return found


def _sum(a: SparseRow, b: SparseRow) -> SparseRow:
    return {q: a[q] + b[q] if q in a and q in b else a.get(q, b.get(q)) for q in sorted({*a, *b})}


def product(upper: Upper, h: SparseRow, n: int) -> Any:
    """P h, a `Vector` or an array (n,)."""
    if isinstance(upper, tuple):
        P = full(upper, n)
        return Vector.of(compute_once([total(P[i][j] * v for j, v in h.items()) for i in range(n)]))
    return jnp.sum(upper[_positions(n)[:, list(h)]] * _array(list(h.values()), upper, len(h))[None], axis=1)


def joseph(upper: Upper, Ph: Any, k: Any, h: SparseRow, noise: Scalar) -> Upper:
    """(I − khᵀ) P (I − khᵀ)ᵀ + `noise` kkᵀ, given Ph."""
    n = len(Ph)
    # B = (I − khᵀ)P, then B(I − khᵀ)ᵀ + noise kkᵀ as a rank-one update of B, n² products.
    if isinstance(upper, tuple):
        # Bh from the rounded B corrects its rounding errors as the product of three matrices does.
        P = full(upper, n)
        B = {(i, j): P[i][j] - k[i] * Ph[j] for i in range(n) for j in range(n) if j >= i or j in h}
        Bh_noise = compute_once([total(B[i, j] * v for j, v in h.items()) - noise * k[i] for i in range(n)])
        return tuple(B[i, j] - Bh_noise[i] * k[j] for i, j in triangle(n))
    # Bh = Ph − k hᵀPh: from the rounded B one recording takes twice as long.
    rows, columns = np.triu_indices(n)
    Bh = product(upper, h, n) - k * total(Ph[j] * v for j, v in h.items())
    return upper - k[rows] * Ph[columns] - (Bh - noise * k)[rows] * k[columns]


def _inner(a: SparseRow, b: SparseRow) -> Scalar | None:
    """The inner product of two sparse rows; None for a structural zero."""
    shared = [times(x, b[q]) for q, x in a.items() if q in b]
    return total(shared) if shared else None


def _is_unit(row: SparseRow, i: int) -> bool:
    """Whether the row leaves component `i` unchanged."""
    return list(row) == [i] and isinstance(row[i], float) and row[i] == 1.0


def _array(entries: Sequence[Scalar | None], like: jax.Array, *shape: int) -> jax.Array:
    """Scalars, None for a structural zero, as one array of this shape."""
    zero = jnp.zeros_like(like[0])
    distinct, index = [zero], np.zeros(len(entries), np.int32)
    for at, value in enumerate(entries):
        if value is not None:
            index[at] = len(distinct)
            distinct.append(jnp.broadcast_to(value, zero.shape).astype(zero.dtype))
    return jnp.stack(distinct)[index.reshape(shape)]


@cache
def _positions(n: int) -> np.ndarray:
    """The position in the upper triangle of each entry of a symmetric matrix, (n, n)."""
    found = np.zeros((n, n), np.int32)
    rows, columns = np.triu_indices(n)
    found[rows, columns] = found[columns, rows] = np.arange(len(rows))
    return found
