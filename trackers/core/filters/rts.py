"""The Rauch–Tung–Striebel smoother (Rauch, Tung and Striebel 1965): gain, backward step, fixed interval, fixed lag.

With x, P the filtered state and covariance of a time step, F, G the motion's Jacobians to the next one, x⁻ = step(x),
P⁻ = FPFᵀ + GGᵀ the prediction, and ₊ the next step's smoothed belief:

    C = PFᵀ(P⁻)⁻¹        xˢ = x + C(xˢ₊ − x⁻)        Pˢ = (I − CF)P(I − CF)ᵀ + C(GGᵀ + Pˢ₊)Cᵀ

The covariance is a sum of squares (Joseph's form, positive semi-definite whatever the rounding error of C), not
P + C(Pˢ₊ − P⁻)Cᵀ. Beliefs and gains hold all trajectories, last in every array. Covariances are arrays (n, n, B), not
scalars as in the filter: C has no structural zeros, and programs of single entries compile for minutes with 15 states.
Matrix products are not mapped by `vmap`, which would put trajectories first, where loops over them do not vectorise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from trackwright.trackers.core.model.algebra import Scalar, SparseRow, compute_once, full, times, total, triangle
from trackwright.trackers.core.model.covariance import (
    AnyCovariance,
    Gaussian,
    OneArray,
    side_by_side,
    size_of,
    transposed_product,
    with_covariances,
)
from trackwright.trackers.core.model.inputs import Elapsed
from trackwright.trackers.core.model.state import State, local, retract

Matrices = Float[Array, "n n B"]

# Trajectories smoothed side by side: enough for LLVM to vectorise loops over them, few enough for XLA to compile the
# loop over times to one kernel (it does not for three components of 23 states).
BLOCK = 32


class RtsGain(NamedTuple):
    """The backward step of one time step: filtered belief, x⁻, Cᵀ (`gain`), GGᵀ (`noise`), (I − CF)P(I − CF)ᵀ (`base`).

    `connected`: whether the next step continues this track. `simultaneous`: whether it is at the same time.
    """

    filtered: Gaussian
    predicted: State
    gain: Matrices
    noise: Matrices
    base: Matrices
    connected: Scalar
    simultaneous: Scalar


def rts_gain(
    belief: Gaussian, predicted: State, F: Sequence[SparseRow], G: Sequence[SparseRow], connected: Scalar,
    simultaneous: Scalar,
) -> RtsGain:  # fmt: skip
    """The gains of one time step, from the filtered beliefs, their predictions and the motion's Jacobians F and G."""
    n, P = len(F), belief.cov
    assert isinstance(P, jax.Array)
    zero = jnp.zeros_like(P[0, 0])
    shared = [zero + total(times(g, G[j][q]) for q, g in G[i].items() if q in G[j]) for i, j in triangle(n)]
    noise = compute_once(_matrices(shared))
    FP = _sparse_product(F, P)
    C_transposed = _solved(compute_once(_sparse_product(F, FP.swapaxes(0, 1)) + noise), FP)
    unit = np.eye(n).reshape(n, n, 1)
    # (I − CF)ᵀ = I − FᵀCᵀ.
    F_transposed = [{i: row[j] for i, row in enumerate(F) if j in row} for j in range(n)]
    rest = compute_once(jnp.asarray(unit, P.dtype) - _sparse_product(F_transposed, C_transposed))
    base = compute_once(_congruence(rest, P))
    return RtsGain(belief, predicted, C_transposed, noise, base, connected, simultaneous)


def rts_step(rts_gain: RtsGain, after: Gaussian) -> Gaussian:
    """The smoothed beliefs of a time step, from the smoothed beliefs `after` of the next one."""
    assert isinstance(after.cov, jax.Array)
    C_transposed = rts_gain.gain
    difference = jax.vmap(local, in_axes=-1, out_axes=-1)(rts_gain.predicted, after.mean)
    step = compute_once(total(row * d[None] for row, d in zip(C_transposed, difference, strict=True)))
    mean = jax.vmap(lambda x, step: retract(x, list(step)), in_axes=-1, out_axes=-1)(rts_gain.filtered.mean, step)
    cov = compute_once(rts_gain.base + _congruence(C_transposed, compute_once(rts_gain.noise + after.cov)))
    # Two steps at one time have one state; the filtered covariance may be singular there, without an inverse.
    smoothed = _chosen(rts_gain.simultaneous, after, Gaussian(mean, cov))
    chosen: Gaussian = _chosen(rts_gain.connected, smoothed, rts_gain.filtered)
    return chosen


def fixed_interval(
    gain_of: Callable[..., Any], rts_step: Callable[[Any, Any], Any], estimate_of: Callable[[Any], Any], filtered: Any,
    connected: Bool[Array, "T B"], dt: Float[Array, "T B"], inputs: Any,
) -> Any:  # fmt: skip
    """The smoothed estimates of all T rows, by a scan backwards over the times of each trajectory.

    `filtered`: the beliefs. Of the step from each row to the next: `connected`, whether that row continues the track,
    `dt` s, and known `inputs`; the values of the last row are unused. `gain_of(belief, connected, dt, inputs)`:
    the gain of a step. `estimate_of`: the estimates of beliefs.
    """
    n_rows, size = dt.shape
    at_once = side_by_side(BLOCK, size)
    block = at_once if size % at_once == 0 else size
    # A row at the time of the next one shares its belief. The other rows are ranked from the last one.
    ranked = ~connected | (dt != 0)
    rank = jnp.cumsum(ranked[::-1].astype(jnp.int32), axis=0)[::-1] - 1
    every_row, every_column = jnp.arange(n_rows, dtype=jnp.int32)[:, None], jnp.arange(size, dtype=jnp.int32)
    row_of = (
        jnp.zeros_like(rank)
        .at[jnp.where(ranked, rank, n_rows), every_column]
        .set(jnp.broadcast_to(every_row, rank.shape), mode="drop")
    )
    estimates_of = OneArray()

    def backwards(first: jax.Array) -> jax.Array:
        """The estimates of the trajectories of one block by rank, (T, numbers, block)."""
        rows, ranks = (jax.lax.dynamic_slice_in_dim(x, first, block, axis=-1) for x in (row_of, rank[0]))
        # Gathered before the loop: XLA's cost model charges each step with the whole array of a gather.
        columns = first + jnp.arange(block, dtype=jnp.int32)
        steps = jax.tree_util.tree_map(
            lambda x: jnp.moveaxis(x[rows, ..., columns], 1, -1), (filtered, connected, dt, inputs)
        )
        last = in_matrices(jax.tree_util.tree_map(lambda x: x[0], steps[0]))

        def smoothed(after: Any, belief: Any, *step: Any) -> tuple[Any, jax.Array]:
            before = rts_step(gain_of(in_matrices(belief), *step), after)
            return before, estimates_of.packed(estimate_of(before))

        nothing = jax.eval_shape(lambda: estimates_of.packed(estimate_of(last)))

        def body(after: Any, one: tuple[jax.Array, Any]) -> tuple[Any, jax.Array]:
            number, step = one
            return jax.lax.cond(
                number <= jnp.max(ranks),
                lambda: smoothed(after, *step),
                lambda: (after, jnp.zeros(nothing.shape, nothing.dtype)),
            )

        return jax.lax.scan(body, last, (jnp.arange(n_rows, dtype=jnp.int32), steps))[1]

    firsts = jnp.arange(0, size, block, dtype=jnp.int32)
    by_rank = jax.lax.map(backwards, firsts) if len(firsts) > 1 else backwards(firsts[0])[None]
    blocks, within = (every_column // block)[None, None], (every_column % block)[None, None]

    def of_rows(start: int, end: int) -> jax.Array:
        numbers = jnp.arange(start, end, dtype=jnp.int32)[None, :, None]
        return by_rank.at[blocks, rank[:, None], numbers, within].get(mode="promise_in_bounds")

    # Leaf by leaf: one more pass over an array of all numbers costs nearly as much as smoothing.
    return estimates_of.unpacked_from(of_rows)


def in_matrices(beliefs: Any) -> Any:
    """Beliefs with covariances (…, n, n, B)."""

    return with_covariances(beliefs, lambda cov: _matrices(cov) if isinstance(cov, tuple) else cov)


def in_scalars(beliefs: Any) -> Any:
    """Beliefs `in_matrices` with the upper triangle of each covariance as a tuple (…, B)."""

    def one(cov: Any) -> AnyCovariance:
        return tuple(cov[..., i, j, :] for i, j in triangle(cov.shape[-2]))

    return with_covariances(beliefs, one)


def fixed_lag(
    gain_of: Callable[..., Any], rts_step: Callable[[Any, Any], Any], filtered: Any, steps: tuple[Any, ...],
    dt: Float[Array, "steps B"], lag: Scalar,
) -> Any:  # fmt: skip
    """The smoothed beliefs of all time steps but the last, batch-last, each from measurements at most `lag` s later.

    All windows run backwards in parallel, each from its last step, until all have reached their first one.
    """
    filtered = in_matrices(filtered)
    gains = jax.vmap(lambda belief, *rest: gain_of(in_matrices(belief), *rest))(*steps)

    def trajectory(gains: Any, filtered: Any, dt: Any) -> Any:
        first = jnp.arange(len(dt), dtype=jnp.int32)
        times = Elapsed.of(jnp.concatenate([jnp.zeros_like(dt[:1]), dt]), 2 * lag)
        # The last step of each window; times since 1970 in double precision are rounded to a quarter of a microsecond.
        end = times.last_within(jnp.broadcast_to(lag + 1e-6, times.whole.shape))[:-1]
        # The windows take the place of the trajectories.
        gains, filtered = jax.tree_util.tree_map(lambda x: jnp.moveaxis(x, 0, -1), (gains, filtered))
        initial = jax.tree_util.tree_map(lambda x: x[..., end], filtered)

        def body(state: tuple[Any, Any]) -> tuple[Any, Any]:
            index, belief = state
            previous = jnp.maximum(index - 1, 0)
            after = rts_step(jax.tree_util.tree_map(lambda x: x[..., previous], gains), belief)
            running = index > first
            return jnp.where(running, index - 1, index), _chosen(running, after, belief)

        smoothed = jax.lax.while_loop(lambda state: jnp.any(state[0] > first), body, (end, initial))[1]
        return jax.tree_util.tree_map(lambda x: jnp.moveaxis(x, -1, 0), smoothed)

    return jax.vmap(trajectory, in_axes=-1, out_axes=-1)(gains, filtered, dt)


def _matrices(upper: Sequence[jax.Array]) -> jax.Array:
    """The symmetric matrices (…, n, n, B) of an upper triangle of entries (…, B)."""
    n = size_of(upper)
    # One concatenation: XLA selects among the parts of nested ones for every number.
    entries = jnp.stack([x for row in full(upper, n) for x in row], axis=-2)
    return entries.reshape(*entries.shape[:-2], n, n, entries.shape[-1])


def _chosen(condition: Bool[Array, " B"], yes: Any, no: Any) -> Any:
    """The tree `yes` of the trajectories for which the condition holds, else `no`."""
    return jax.tree_util.tree_map(lambda a, b: jnp.where(condition.reshape((1,) * (a.ndim - 1) + (-1,)), a, b), yes, no)


def _sparse_product(rows: Sequence[SparseRow], A: Matrices) -> Matrices:
    """The product of a matrix of sparse rows and A."""

    def one(row: SparseRow) -> Any:
        return total(A[j] if isinstance(entry, float) else entry[None] * A[j] for j, entry in row.items())

    return compute_once(jnp.stack([one(row) if row else jnp.zeros_like(A[0]) for row in rows]))


def _congruence(A: Matrices, P: Matrices) -> Matrices:
    """AᵀPA of a symmetric P."""
    return transposed_product(A, compute_once(transposed_product(P, A)))


def _solved(cov: Matrices, right: Matrices) -> Matrices:
    """The pseudo-inverse of a covariance times a matrix, by LDLᵀ; directions without variance drop out.

    Row by row: LLVM vectorises the loop over the columns of one row, but not a loop over rows of few trajectories.
    """
    n, tolerance = cov.shape[0], 16 * float(jnp.finfo(cov.dtype).eps)
    upper, solution = [cov[i, i:] for i in range(n)], list(right)
    for j in range(n):
        pivot = upper[j][0]
        positive = pivot > tolerance * cov[j, j]
        inverse = compute_once(jnp.where(positive, 1.0 / jnp.where(positive, pivot, 1.0), 0.0))
        # Row j of Lᵀ, its diagonal included.
        row = compute_once(upper[j] * inverse[None])
        for i in range(j + 1, n):
            upper[i] = upper[i] - upper[j][i - j][None] * row[i - j :]
            solution[i] = solution[i] - row[i - j][None] * solution[j]
        upper[j + 1 : j + 2] = compute_once(upper[j + 1 : j + 2])
        solution[j + 1 : j + 2] = compute_once(solution[j + 1 : j + 2])
        upper[j], solution[j] = row, compute_once(solution[j] * inverse[None])
    for i in reversed(range(n)):
        later = total(upper[i][k - i][None] * solution[k] for k in range(i + 1, n))
        solution[i] = compute_once(solution[i] - later)
    return compute_once(jnp.stack(solution))
