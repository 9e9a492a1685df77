"""The Rauch–Tung–Striebel smoother (Rauch, Tung and Striebel 1965): gain, backward step, fixed interval, fixed lag.

With x, P the filtered state and covariance of a time step, F, G the motion's Jacobians to the next one, x⁻ = step(x),
P⁻ = FPFᵀ + GGᵀ the prediction, and ₊ the next step's smoothed belief:

    C = PFᵀ(P⁻)⁻¹        xˢ = x + C(xˢ₊ − x⁻)        Pˢ = (I − CF)P(I − CF)ᵀ + CGGᵀCᵀ + CPˢ₊Cᵀ

The covariance is a sum of squares (Joseph's form, positive semi-definite whatever the rounding error of C), not
P + C(Pˢ₊ − P⁻)Cᵀ. Matrices here are arrays, not scalars as in the filter: C has no structural zeros, and programs of
single entries compile for minutes with 15 states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from trackers.core.algebra import Jacobian, Scalar, compute_once, total
from trackers.core.covariance import OneArray, Upper, in_form_of, matrix
from trackers.core.filter import Gaussian
from trackers.core.select import select
from trackers.core.state import State, local, retract

Matrix = Float[Array, "n n"]

BLOCK = 64
"""Time steps whose gains are computed side by side, for few trajectories."""


class RtsGain(NamedTuple):
    """The backward step of one time step: filtered belief, x⁻, C, and the terms of Pˢ without Pˢ₊ (`base`).

    `connected`: the next step continues this track. `simultaneous`: it is at the same time.
    """

    filtered: Gaussian
    predicted: State
    gain: Matrix
    base: Matrix
    connected: Scalar
    simultaneous: Scalar


def rts_gain(
    belief: Gaussian, predicted: State, jacobian: Jacobian, connected: Scalar, simultaneous: Scalar
) -> RtsGain:
    """The gain of one time step of one trajectory, from its filtered belief (mean, cov) and its prediction.

    `jacobian`: of the motion with respect to state and noise, (F G).
    """
    multiply = _product(belief.cov)
    n = len(jacobian.array)
    P, F, G = matrix(belief.cov), jacobian.array[:, :n], jacobian.array[:, n:]
    P, F, G = compute_once((P, F, G))
    FP = compute_once(multiply(F, P))
    C = compute_once(_times_inverse(FP.T, compute_once(multiply(FP, F.T) + multiply(G, G.T))))
    I_CF, CG = compute_once((jnp.eye(n, dtype=P.dtype) - multiply(C, F), multiply(C, G)))
    base = multiply(compute_once(multiply(I_CF, P)), I_CF.T) + multiply(CG, CG.T)
    return RtsGain(belief, predicted, C, compute_once(base), connected, simultaneous)


def rts_step(rts_gain: RtsGain, after: Gaussian) -> Gaussian:
    """The smoothed belief of a time step, from the smoothed belief `after` of the next one."""
    n, multiply = rts_gain.gain.shape[0], _product(after.cov)
    step = total(rts_gain.gain[:, j] * d for j, d in enumerate(local(rts_gain.predicted, after.mean)))
    CP = compute_once(multiply(rts_gain.gain, matrix(after.cov)))
    cov = rts_gain.base + multiply(CP, rts_gain.gain.T)
    mean = retract(rts_gain.filtered.mean, [step[i] for i in range(n)])
    smoothed = rts_gain.filtered._replace(mean=mean, cov=in_form_of(after.cov, cov))
    # Two steps at one time have one state; the filtered covariance may be singular there, without an inverse.
    chosen: Gaussian = select(rts_gain.connected, select(rts_gain.simultaneous, after, smoothed), rts_gain.filtered)
    return chosen


def fixed_interval(
    gain_of: Callable[..., Any], rts_step: Callable[[Any, Any], Any], last: Any, steps: tuple[Any, ...], few: bool
) -> Any:
    """The smoothed beliefs of all time steps but the last, batch-last, by one scan backwards from the last.

    `gain_of(*step)`: the gain of a step of one trajectory. `last`: the filtered belief of the last step. `few`: of few
    trajectories; then the gains of `BLOCK` time steps are computed side by side.
    """
    step = jax.vmap(rts_step, in_axes=-1, out_axes=-1)
    gains_of = jax.vmap(gain_of, in_axes=-1, out_axes=-1)
    if not few:

        def body(after: Any, one: tuple[Any, ...]) -> tuple[Any, Any]:
            before = step(gains_of(*one), after)
            return before, before

        return jax.lax.scan(body, last, steps, reverse=True)[1]
    rows = jax.tree_util.tree_leaves(steps)[0].shape[0]
    missing = -rows % BLOCK
    beliefs_of = OneArray()

    def blocks(x: Array) -> Array:
        # The recursion ends in the padding.
        padded = jnp.concatenate([jnp.zeros((missing, *x.shape[1:]), x.dtype), x])
        return padded.reshape(-1, BLOCK, *x.shape[1:])

    def row(after: Any, gain: Any) -> tuple[Any, Array]:
        before = step(gain, after)
        return before, beliefs_of.packed(before)

    def block(after: Any, steps: tuple[Any, ...]) -> tuple[Any, Array]:
        return jax.lax.scan(row, after, jax.vmap(gains_of)(*steps), reverse=True)

    found = jax.lax.scan(block, last, jax.tree_util.tree_map(blocks, steps), reverse=True)[1]
    return beliefs_of.unpacked(found.reshape(-1, *found.shape[2:])[missing:])


def fixed_lag(
    gain_of: Callable[..., Any],
    rts_step: Callable[[Any, Any], Any],
    filtered: Any,
    steps: tuple[Any, ...],
    dt: Float[Array, "steps B"],
    lag: Scalar,
) -> Any:
    """The smoothed beliefs of all time steps but the last, batch-last, each from measurements at most `lag` s later.

    All windows run backwards in parallel, each from its own last step, until they have reached their first one.
    """
    gains = jax.vmap(jax.vmap(gain_of, in_axes=-1, out_axes=-1))(*steps)

    def trajectory(gains: Any, filtered: Any, dt: Any) -> Any:
        first = jnp.arange(len(dt), dtype=jnp.int32)
        times = jnp.concatenate([jnp.zeros_like(dt[:1]), jnp.cumsum(dt)])
        # The last step of each window; 2 eps of the longest time make 0.1 s + 0.2 s equal 0.3 s.
        slack = 2 * jnp.finfo(dt.dtype).eps * times[-1]
        end = jnp.searchsorted(times, times[:-1] + lag + slack, side="right").astype(jnp.int32) - 1
        initial = jax.tree_util.tree_map(lambda x: x[end], filtered)

        def body(state: tuple[Any, Any]) -> tuple[Any, Any]:
            index, belief = state
            previous = jnp.maximum(index - 1, 0)
            smoothed = jax.vmap(rts_step)(jax.tree_util.tree_map(lambda x: x[previous], gains), belief)
            running = index > first
            belief = jax.tree_util.tree_map(lambda a, b: jnp.where(_like(running, a), a, b), smoothed, belief)
            return jnp.where(running, index - 1, index), belief

        return jax.lax.while_loop(lambda state: jnp.any(state[0] > first), body, (end, initial))[1]

    return jax.vmap(trajectory, in_axes=-1, out_axes=-1)(gains, filtered, dt)


def _like(condition: Bool[Array, " T"], array: Shaped[Array, "T ..."]) -> Bool[Array, "T ..."]:
    """The condition with as many axes as the array."""
    return condition.reshape(condition.shape + (1,) * (array.ndim - 1))


def _product(upper: Upper) -> Callable[[Matrix, Matrix], Matrix]:
    """The product of two matrices, in the form of the covariances."""
    return _outer_products if isinstance(upper, tuple) else jnp.matmul


def _outer_products(A: Float[Array, "i j"], B: Float[Array, "j k"]) -> Float[Array, "i k"]:
    """AB as a sum of outer products: XLA vectorises these over trajectories, unlike products of small matrices."""
    terms = [jnp.outer(A[:, k], B[k]) for k in range(A.shape[1])]
    return total(terms) if terms else jnp.zeros((A.shape[0], B.shape[1]), A.dtype)


def _times_inverse(rows: Float[Array, "m n"], cov: Float[Array, "n n"]) -> Float[Array, "m n"]:
    """Rows times the pseudo-inverse of a covariance, by its Cholesky factor; directions without variance drop out."""
    n, tolerance = cov.shape[0], 16 * float(jnp.finfo(cov.dtype).eps)
    columns, inverses, remainder = [], [], cov
    for j in range(n):
        positive = remainder[j, j] > tolerance * cov[j, j]
        inverse = jnp.where(positive, 1.0 / jnp.sqrt(jnp.where(positive, remainder[j, j], 1.0)), 0.0)
        column = jnp.where(jnp.arange(n) >= j, remainder[:, j] * inverse, 0.0)
        remainder = compute_once(remainder - jnp.outer(column, column))
        columns.append(column)
        inverses.append(inverse)
    L = jnp.stack(columns, axis=1)
    forward, backward = [], []
    for j in range(n):
        forward.append(rows[:, j] * inverses[j])
        rows = compute_once(rows - jnp.outer(forward[j], L[:, j]))
    rows = jnp.stack(forward, axis=1)
    for j in reversed(range(n)):
        backward.append(rows[:, j] * inverses[j])
        rows = compute_once(rows - jnp.outer(backward[-1], L[j]))
    return jnp.stack(backward[::-1], axis=1)
