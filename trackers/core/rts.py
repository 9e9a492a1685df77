"""The Rauch–Tung–Striebel smoother (Rauch, Tung and Striebel 1965): gain, backward step, fixed interval, fixed lag.

With x, P the filtered state and covariance of a time step, F, G the motion's Jacobians to the next one, x⁻ = step(x),
P⁻ = FPFᵀ + GGᵀ the prediction, and ₊ the next step's smoothed belief:

    C = PFᵀ(P⁻)⁻¹        xˢ = x + C(xˢ₊ − x⁻)        Pˢ = (I − CF)P(I − CF)ᵀ + C(GGᵀ + Pˢ₊)Cᵀ

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
from trackers.core.covariance import (
    AnyCovariance,
    OneArray,
    in_form_of,
    matrix,
    noise_covariance,
    product_of,
)
from trackers.core.elapsed import Elapsed
from trackers.core.filter import Gaussian
from trackers.core.select import select
from trackers.core.state import State, local, retract

Matrix = Float[Array, "n n"]

VECTOR = 8
"""Numbers of a vector register (AVX, single precision)."""


class RtsGain(NamedTuple):
    """The backward step of one time step: filtered belief, x⁻, C, GGᵀ (`noise`), and (I − CF)P(I − CF)ᵀ (`base`).

    Of few trajectories the matrices are those of `_whole_vectors`. `connected`: the next step continues this track.
    `simultaneous`: it is at the same time.
    """

    filtered: Gaussian
    predicted: State
    gain: Matrix
    noise: Matrix
    base: Matrix
    connected: Scalar
    simultaneous: Scalar


def rts_gain(
    belief: Gaussian, predicted: State, jacobian: Jacobian, connected: Scalar, simultaneous: Scalar
) -> RtsGain:
    """The gain of one time step of one trajectory, from its filtered belief (mean, cov) and its prediction.

    `jacobian`: of the motion with respect to state and noise, (F G).
    """
    multiply, P = _product(belief.cov), compute_once(_whole_vectors(belief.cov))
    n, inputs = jacobian.structure.shape
    if isinstance(belief.cov, tuple):
        F, G = (compute_once(jacobian.transposed(slice(n), part).T) for part in (slice(n), slice(n, inputs)))
        FP, noise = compute_once((multiply(F, P), multiply(G, G.T)))
        C = compute_once(_solved(compute_once(multiply(FP, F.T) + noise), FP).T)
        I_CF = compute_once(jnp.eye(n, dtype=P.dtype) - multiply(C, F))
        transposed = I_CF.T
    else:
        # Transposed factors are stored, each product is computed by itself: in a loop with other operations it is not
        # vectorised.
        Ft = compute_once(_whole_vectors(jacobian.transposed(slice(n), slice(n))))
        F, noise = compute_once((Ft.T, _whole_vectors(noise_covariance(jacobian))))
        FP = compute_once(multiply(F, P))
        C = compute_once(_solved(compute_once(compute_once(multiply(FP, Ft)) + noise), FP).T)
        I_CF = compute_once(jnp.eye(len(P), dtype=P.dtype) - compute_once(multiply(C, F)))
        transposed = compute_once(I_CF.T)
    base = compute_once(multiply(compute_once(multiply(I_CF, P)), transposed))
    return RtsGain(belief, predicted, C, noise, base, connected, simultaneous)


def rts_step(rts_gain: RtsGain, after: Gaussian) -> Gaussian:
    """The smoothed belief of a time step, from the smoothed belief `after` of the next one."""
    C, multiply = rts_gain.gain, _product(after.cov)
    difference = local(rts_gain.predicted, after.mean)
    n = len(difference)
    step = total(C[:, j] * d for j, d in enumerate(difference))
    if isinstance(after.cov, tuple):
        later = compute_once(multiply(C, rts_gain.noise + matrix(after.cov)))
        cov = rts_gain.base + multiply(later, C.T)
    else:
        later = compute_once(multiply(C, compute_once(rts_gain.noise + _whole_vectors(after.cov))))
        cov = compute_once(rts_gain.base + compute_once(multiply(later, compute_once(C.T))))[:n, :n]
    mean = retract(rts_gain.filtered.mean, [step[i] for i in range(n)])
    smoothed = rts_gain.filtered._replace(mean=mean, cov=in_form_of(after.cov, cov))
    # Two steps at one time have one state; the filtered covariance may be singular there, without an inverse.
    chosen: Gaussian = select(rts_gain.connected, select(rts_gain.simultaneous, after, smoothed), rts_gain.filtered)
    return chosen


def fixed_interval(
    gain_of: Callable[..., Any],
    rts_step: Callable[[Any, Any], Any],
    estimate_of: Callable[[Any], Any],
    last: Any,
    steps: tuple[Any, ...],
    few: bool,
) -> Any:
    """The smoothed estimates of all time steps but the last, batch-last, by one scan backwards from the last.

    `steps`: filtered beliefs, whether the next step continues the track, dt to it, its inputs. `gain_of(*step)`: the
    gain of a step of one trajectory. `estimate_of`: the estimates of a batch's beliefs. `last`: the filtered beliefs of
    the last step. `few`: of few trajectories; steps at the time of the next one copy its belief there.
    """
    step = jax.vmap(rts_step, in_axes=-1, out_axes=-1)
    gains_of = jax.vmap(gain_of, in_axes=-1, out_axes=-1)
    estimates_of = OneArray()

    def smoothed(after: Any, one: tuple[Any, ...]) -> Any:
        if not few:
            return step(gains_of(*one), after)
        filtered, connected, dt, _ = one
        copied = jax.vmap(select, in_axes=-1, out_axes=-1)
        return jax.lax.cond(
            jnp.any(connected & (dt != 0)),
            lambda: step(gains_of(*one), after),
            lambda: copied(connected, after, filtered),
        )

    def body(after: Any, one: tuple[Any, ...]) -> tuple[Any, Any]:
        before = smoothed(after, one)
        estimate = estimate_of(before)
        return before, estimates_of.packed(estimate) if few else estimate

    found = jax.lax.scan(body, last, steps, reverse=True)[1]
    return estimates_of.unpacked(found) if few else found


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
        times = Elapsed.of(jnp.concatenate([jnp.zeros_like(dt[:1]), dt]), 2 * lag)
        # The last step of each window; the slack makes 0.1 s + 0.2 s equal 0.3 s.
        slack = 4 * jnp.finfo(dt.dtype).eps * lag
        end = times.last_within(jnp.broadcast_to(lag + slack, times.whole.shape))[:-1]
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


def _whole_vectors(cov: AnyCovariance) -> Matrix:
    """A covariance as a matrix; one of few trajectories with zeros up to a multiple of `VECTOR`.

    A product of 23 columns takes twice as long as one of 24. Zeros change nothing: a direction without variance drops
    out of the pseudo-inverse.
    """
    more = 0 if isinstance(cov, tuple) or len(cov) <= VECTOR else -len(cov) % VECTOR
    return jnp.pad(matrix(cov), (0, more)) if more else matrix(cov)


def _product(upper: AnyCovariance) -> Callable[[Matrix, Matrix], Matrix]:
    """The product of two matrices, in the form of the covariances."""
    return _outer_products if isinstance(upper, tuple) else product_of


def _outer_products(A: Float[Array, "i j"], B: Float[Array, "j k"]) -> Float[Array, "i k"]:
    """AB as a sum of outer products: XLA vectorises these over trajectories, unlike products of small matrices."""
    terms = [jnp.outer(A[:, k], B[k]) for k in range(A.shape[1])]
    return total(terms) if terms else jnp.zeros((A.shape[0], B.shape[1]), A.dtype)


def _solved(cov: Float[Array, "n n"], right: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """The pseudo-inverse of a covariance times a matrix, by elimination; directions without variance drop out."""
    n, tolerance = cov.shape[0], 16 * float(jnp.finfo(cov.dtype).eps)
    whole = jnp.concatenate([cov, right], axis=1)
    for j in range(n):
        # The first column is the one eliminated; those before it are gone.
        column, at_j = whole[:, 0], jnp.arange(n) == j
        positive = column[j] > tolerance * cov[j, j]
        inverse = jnp.where(positive, 1.0 / jnp.where(positive, column[j], 1.0), 0.0)
        others, scale = jnp.where(at_j, 0.0, column), jnp.where(at_j, inverse, 1.0)
        row = whole[j, 1:] * inverse
        whole = compute_once((whole[:, 1:] - jnp.outer(others, row)) * scale[:, None])
    return whole
