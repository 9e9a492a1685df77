"""How a row's belief follows from that of the next row: one step of Rauch, Tung and Striebel's (1965) recursion.

With x, P the filtered state and covariance of a row, F, G the motion's Jacobians to the next row, x⁻ = step(x),
P⁻ = FPFᵀ + GGᵀ the prediction:

    C = PFᵀ(P⁻)⁻¹        xˢ = x + C(xˢ₊ − x⁻)        Pˢ = (I − CF)P(I − CF)ᵀ + CGGᵀCᵀ + CPˢ₊Cᵀ

The covariance is a sum of squares (Joseph's form, which holds whatever the rounding of C), not P + C(Pˢ₊ − P⁻)Cᵀ.

In whole matrices, not entry by entry as the filter: C has no zeros, and entries of 15 states compile for minutes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from trackers.core.algebra import Scalar, SparseRow, compute_once, dense, total, triangle
from trackers.core.select import select
from trackers.core.state import State, local, retract


class RtsGain(NamedTuple):
    """How a row's smoothed normal belief follows from the next row's: C, x⁻, and Pˢ without its last term.

    `joined`: the next row goes on with this track; `same`: it is at the same time.
    """

    filtered: Any
    predicted: State
    gain: Any
    base: Any
    joined: Scalar
    same: Scalar


def rts_gain(
    belief: Any,
    moved: State,
    slopes: Sequence[tuple[Sequence[SparseRow], Sequence[SparseRow]]],
    joined: Scalar,
    same: Scalar,
) -> RtsGain:
    """The link of one row of one trajectory to the next row.

    From its belief (mean, cov), its prediction `moved`, and the `slopes` F and G of each stage of the motion.
    """
    zero = jnp.zeros_like(belief.cov[0])
    n = len(slopes[0][0])
    P, moves, noise = dense(belief.cov, n), jnp.eye(n, dtype=zero.dtype), jnp.zeros((n, 0), zero.dtype)
    for F, G in slopes:
        stage = compute_once(_filled(F, n, zero))
        moves = compute_once(_product(stage, moves))
        noise = jnp.concatenate([_product(stage, noise), _filled(G, _width(G), zero)], axis=1)
    P, moves, noise = compute_once((P, moves, noise))
    moved_P = compute_once(_product(moves, P))
    C = compute_once(_divided(moved_P.T, compute_once(_product(moved_P, moves.T) + _product(noise, noise.T))))
    rest, pushed = compute_once((jnp.eye(n, dtype=P.dtype) - _product(C, moves), _product(C, noise)))
    base = _product(compute_once(_product(rest, P)), rest.T) + _product(pushed, pushed.T)
    return RtsGain(belief, moved, C, compute_once(base), joined, same)


def rts_step(rts_gain: RtsGain, after: Any) -> Any:
    """The smoothed belief of a row, from that of the next one."""
    n = rts_gain.gain.shape[0]
    step = total(rts_gain.gain[:, j] * d for j, d in enumerate(local(rts_gain.predicted, after.mean)))
    spread = compute_once(_product(rts_gain.gain, dense(after.cov, n)))
    cov = rts_gain.base + _product(spread, rts_gain.gain.T)
    mean = retract(rts_gain.filtered.mean, [step[i] for i in range(n)])
    smoothed = rts_gain.filtered._replace(mean=mean, cov=tuple(cov[i, j] for i, j in triangle(n)))
    # Two rows at one time have one state; there the filtered covariance may be singular and has no inverse.
    return select(rts_gain.joined, select(rts_gain.same, after, smoothed), rts_gain.filtered)


def _width(rows: Sequence[SparseRow]) -> int:
    return 1 + max((j for row in rows for j in row), default=0)


def _filled(rows: Sequence[SparseRow], columns: int, zero: Scalar) -> Any:
    """Sparse rows as a matrix."""
    return jnp.stack([jnp.stack([zero + row.get(j, 0.0) for j in range(columns)]) for row in rows])


def _product(A: Any, B: Any) -> Any:
    """AB as a sum of outer products, which XLA does for all trajectories at once; it multiplies small matrices one by one."""
    terms = [jnp.outer(A[:, k], B[k]) for k in range(A.shape[1])]
    return total(terms) if terms else jnp.zeros((A.shape[0], B.shape[1]), A.dtype)


def _divided(rows: Any, cov: Any) -> Any:
    """Rows times the inverse of a covariance, by its Cholesky factor; directions without spread drop out."""
    n, tolerance = cov.shape[0], 16 * float(jnp.finfo(cov.dtype).eps)
    columns, inverses, rest = [], [], cov
    for j in range(n):
        positive = rest[j, j] > tolerance * cov[j, j]
        inverse = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, rest[j, j], 1.0)), 0.0)
        column = jnp.where(jnp.arange(n) >= j, rest[:, j] * inverse, 0.0)
        rest = compute_once(rest - jnp.outer(column, column))
        columns.append(column)
        inverses.append(inverse)
    factor = jnp.stack(columns, axis=1)
    forwards, backwards = [], []
    for j in range(n):
        forwards.append(rows[:, j] * inverses[j])
        rows = compute_once(rows - jnp.outer(forwards[j], factor[:, j]))
    rows = jnp.stack(forwards, axis=1)
    for j in reversed(range(n)):
        backwards.append(rows[:, j] * inverses[j])
        rows = compute_once(rows - jnp.outer(backwards[-1], factor[j]))
    return jnp.stack(backwards[::-1], axis=1)
