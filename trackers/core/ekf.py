"""The extended Kalman filter over named states, one trajectory and one step.

    x  state            F  ∂step/∂x          H  −∂(whitened residual)/∂x    P  covariance of the small step about x
    w  unit noise       G  ∂step/∂w          k  gain of one channel         s  variance of one whitened innovation

Readings arrive whitened, so each channel is one scalar update in Joseph form: no Cholesky factor of an innovation
covariance, a masked channel is a zero row, and in single precision a diffuse prior survives a precise reading
where joint updates don't. Where many channels see few directions of the state (eight phases see two angles), they
are first compressed to as many equivalent channels as there are directions, which is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import (
    Scalar,
    SparseRow,
    Vector,
    cholesky,
    compute_once,
    congruence,
    full,
    gram,
    inverse_or_zero,
    total,
    triangle,
)
from trackers.core.linearise import linearise
from trackers.core.motion import AbstractMotion
from trackers.core.rts_step import RtsGain, rts_gain, rts_step
from trackers.core.sensor import AbstractSensor, Reading
from trackers.core.state import State, coordinates, local_after, retract


class Gaussian(NamedTuple):
    """A belief: the state's mean and the covariance of the small step about it, upper triangle row by row."""

    mean: State
    cov: tuple[Scalar, ...]


class Innovation(NamedTuple):
    """What one reading said: log-likelihood, normalised innovation squared, its degrees of freedom, and wraps."""

    log_likelihood: Scalar
    nis: Scalar
    nis_dof: Scalar
    wrapped: Scalar


class ExtendedKalman(eqx.Module):
    """The filter that linearises motion and sensors at the current mean."""

    def init(self, belief: Gaussian, key: Any) -> Gaussian:
        """The filter's own belief, from a normal one."""
        return belief

    def moments(self, belief: Gaussian) -> tuple[State, tuple[Scalar, ...]]:
        """The mean state and the covariance's upper triangle."""
        return belief.mean, belief.cov

    def predict(self, belief: Gaussian, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Gaussian:
        """The belief `dt` seconds later."""
        mean, cov = belief
        for stage in motion.stages:
            mean, F, G = self.jacobians(mean, motion, stage, inputs, dt)
            # What a stage leaves as it is need not be shared again.
            cov = tuple(a if a is b else compute_once(a) for a, b in zip(congruence(F, cov, G), cov, strict=True))
        return Gaussian(compute_once(mean), cov)

    def jacobians(
        self, state: State, motion: AbstractMotion, stage: Any, inputs: Any, dt: Scalar
    ) -> tuple[State, list[SparseRow], list[SparseRow]]:
        """The state after one stage without noise, and the derivatives F by the state and G by the noise."""
        point, rebuild = coordinates(state)
        zero = jnp.zeros_like(point[0])
        n = len(point)
        moved = stage(state, inputs, dt, Vector.of([zero] * motion.noise_dimension))

        def step(*values: Scalar) -> list[Scalar]:
            before = rebuild(values[:n])
            return local_after(moved, before, values[:n], stage(before, inputs, dt, Vector.of(values[n:])))

        _, rows = linearise(step, [*point, *[zero] * motion.noise_dimension])
        F = [{j: v for j, v in row.items() if j < n} for row in rows]
        G = [{j - n: v for j, v in row.items() if j >= n} for row in rows]
        return moved, compute_once(F), compute_once(G)

    def update(
        self, belief: Gaussian, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Gaussian, Innovation]:
        """The belief after one reading, and what the reading said."""
        point, rebuild = coordinates(belief.mean)
        heavy: list[bool] = []

        def misfit(*values: Scalar) -> list[Scalar]:
            predicted = sensor.measure(motion.view(rebuild(values)), inputs)
            result = sensor.residual(reading, list(predicted))
            heavy[:] = [result.dof is not None]
            wrapped = jnp.where(result.wrapped, 1.0, 0.0)
            return [
                *result.whitened,
                result.log_scale,
                result.nis_dof,
                wrapped,
                0.0 if result.dof is None else result.dof,
            ]

        values, rows = linearise(misfit, point)
        *whitened, log_scale, nis_dof, wrapped, dof = values
        jacobian = [{j: -v for j, v in row.items()} for row in rows[: len(whitened)]]
        # Student's t judges each channel by itself; a compressed one would spread a wild reading over the others.
        channels = compute_once((whitened, jacobian))
        residual, H, apart = (*channels, jnp.zeros_like(nis_dof)) if heavy[0] else compute_once(compressed(*channels))
        step, cov, nis, log_density = joseph(belief.cov, residual, H, len(point), dof if heavy[0] else None)
        innovation = Innovation(log_scale + log_density - 0.5 * apart, nis + apart, nis_dof, wrapped)
        return Gaussian(retract(belief.mean, step), cov), innovation

    def rts_gain(self, belief: Gaussian, motion: AbstractMotion, joined: Scalar, dt: Scalar, inputs: Any) -> RtsGain:
        """What ties a row's belief to the next row's, `dt` seconds later; `joined` if that goes on with the track."""
        moved, slopes = belief.mean, []
        for stage in motion.stages:
            moved, F, G = self.jacobians(moved, motion, stage, inputs, dt)
            slopes.append((F, G))
        return rts_gain(belief, moved, slopes, joined, dt == 0)

    def rts_step(self, rts_gain: RtsGain, after: Gaussian) -> Gaussian:
        """The smoothed belief of a row, from the next row's."""
        return rts_step(rts_gain, after)


def compressed(
    residual: Sequence[Scalar], H: Sequence[SparseRow]
) -> tuple[Sequence[Scalar], Sequence[SparseRow], Scalar]:
    """As few whitened channels as directions of the state are seen, and the sum of squares that no state explains.

    With HᵀH = LLᵀ the equivalent channels are Lᵀ with residual L⁻¹Hᵀr; what is left is the squared length of
    r − H(HᵀH)⁻¹Hᵀr, by projection: subtracting two large numbers would lose it in single precision.
    """
    columns = sorted({j for row in H for j in row})
    if len(H) <= len(columns):
        return residual, H, jnp.zeros_like(residual[0])
    tolerance = 16 * float(jnp.finfo(jnp.asarray(residual[0]).dtype).eps)
    L = cholesky(gram(H, columns), columns, tolerance)
    projected = {j: total(row[j] * r for row, r in zip(H, residual, strict=True) if j in row) for j in columns}
    equivalent: dict[int, Scalar] = {}
    pivot = {j: inverse_or_zero(L[j, j]) for j in columns}
    for a, j in enumerate(columns):
        equivalent[j] = (projected[j] - total(L[j, k] * equivalent[k] for k in columns[:a])) * pivot[j]
    solution: dict[int, Scalar] = {}
    for a, j in reversed(list(enumerate(columns))):
        solution[j] = (equivalent[j] - total(L[i, j] * solution[i] for i in columns[a + 1 :])) * pivot[j]
    left = [r - total(row[j] * solution[j] for j in row) for row, r in zip(H, residual, strict=True)]
    rows = [{i: L[i, j] for i in columns[a:]} for a, j in enumerate(columns)]
    return [equivalent[j] for j in columns], rows, total(x * x for x in left)


def joseph(
    cov: Sequence[Scalar], residual: Sequence[Scalar], H: Sequence[SparseRow], n: int, dof: Scalar | None = None
) -> tuple[list[Scalar], tuple[Scalar, ...], Scalar, Scalar]:
    """Whitened channels one after another: the small step, the covariance, Σ innovation²/s and the log density.

    P⁺ = (I − khᵀ) P (I − khᵀ)ᵀ + kkᵀ with k = Ph/s and s = hᵀPh + 1. With a `dof`, a channel is weighted by what
    Student's t expects of so large an innovation. The log density leaves out what `Residual.log_scale` holds.
    """
    step: list[Scalar] = [jnp.zeros_like(cov[0])] * n
    upper = tuple(cov)
    nis = log_density = jnp.zeros_like(cov[0])
    coarse = 256 * float(jnp.finfo(nis.dtype).eps)
    for r, h in zip(residual, H, strict=True):
        P = full(upper, n)
        Ph = compute_once([total(P[i][j] * v for j, v in h.items()) for i in range(n)])
        a = jnp.maximum(total(Ph[j] * v for j, v in h.items()), 0.0)
        innovation = r - total(v * step[j] for j, v in h.items())
        square = innovation * innovation / (1.0 + a)
        # A covariance in single precision can't hold 10 km beside 1 mm: one reading narrows a direction by what the
        # number format carries, the next ones do the rest. In double precision this never happens.
        noise = jnp.maximum(1.0, coarse * a)
        if dof is None:
            log_density = log_density - 0.5 * (square + jnp.log(1.0 + a))
        else:
            weight = (dof + 1.0) / (dof + square)
            noise = jnp.maximum(1.0 / weight, coarse * a)
            log_density = log_density - 0.5 * ((dof + 1.0) * jnp.log1p(square / dof) + jnp.log(1.0 + a))
            square = square * weight
        k = [g / (noise + a) for g in Ph]
        step = [x + g * innovation for x, g in zip(step, k, strict=True)]
        # B = (I − khᵀ)P first, then B(I − khᵀ)ᵀ + kkᵀ as B less a row times a column: n² products a channel, and what
        # rounding left of B is still taken out, as in the product of three matrices.
        B = {(i, j): P[i][j] - k[i] * Ph[j] for i in range(n) for j in range(n) if j >= i or j in h}
        rest = compute_once([total(B[i, j] * v for j, v in h.items()) - noise * k[i] for i in range(n)])
        upper = tuple(B[i, j] - rest[i] * k[j] for i, j in triangle(n))
        nis = nis + square
    return step, upper, nis, log_density
