"""The extended Kalman filter over named states, for one trajectory and one time step.

    x  state            F  ∂step/∂x          H  −∂(whitened residual)/∂x    P  covariance of the small step about x
    w  unit noise       G  ∂step/∂w          k  gain of one channel         s  variance of one whitened innovation

Residuals are whitened, so that each channel is one scalar update in Joseph form: no Cholesky factor of an innovation
covariance, a masked channel is a zero row, and a diffuse prior survives a precise reading in single precision, where a
joint update does not. Many channels that observe few directions of the state (eight phases, two angles) are first
compressed to one equivalent channel per direction, which is exact.

Student's t noise is approximated by one reweighting of each channel, (ν + 1)/(ν + innovation²/s), and by a predictive
density that is a t of the same ν and scale √s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter, Innovation
from trackwright.trackers.core.model.algebra import (
    Jacobian,
    Scalar,
    SparseRow,
    Vector,
    compute_once,
    congruence,
    inverse_or_zero,
    total,
)
from trackwright.trackers.core.model.covariance import (
    AnyCovariance,
    Gaussian,
    added,
    dot,
    product,
    propagated,
    row_for,
    unconnected,
    updated,
    zero_of,
    zeros,
)
from trackwright.trackers.core.model.inputs import Inputs, RawKey
from trackwright.trackers.core.model.linearise import jacobian, linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.state import State, component_names, coordinates, local_after, retract

SPREAD = 3.0  # standard deviations of the position within which a reading's bend adds to the noise

ANY = (1.0, 0.6, 0.35)  # any combination of the axes of the position, of which what the others leave is taken

BENT = 0.2  # variance of what a reading bends, over its linear part's, above which it counts


class AbstractExtendedKalman(AbstractSmoothableFilter[Gaussian]):
    """Prediction and smoothing of filters whose motion is linearised at the current mean."""

    def init(self, belief: Gaussian, key: RawKey) -> Gaussian:
        """The filter's belief, given the prior; `key` is unused."""
        return belief

    def moments(self, belief: Gaussian) -> tuple[State, AnyCovariance]:
        """The mean state and the covariance's upper triangle."""
        return belief.mean, belief.cov

    def predict(self, belief: Gaussian, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Gaussian:
        """The belief `dt` s later: mean through the motion, covariance FPFᵀ + GGᵀ."""
        mean, cov = belief
        motion = motion.at(belief)
        if not isinstance(cov, tuple):
            mean, F_and_G = jacobian_of(motion, mean, inputs, dt)
            return Gaussian(mean, propagated(cov, F_and_G))
        for stage in motion.stages:
            mean, F, G = sparse_jacobians(motion, stage, mean, inputs, dt)
            grown = congruence(F, cov, G)
            # Unchanged entries already have their barrier.
            cov = tuple(a if a is b else compute_once(a) for a, b in zip(grown, cov, strict=True))
        return Gaussian(compute_once(mean), cov)

    def rts_gain(self, belief: Gaussian, motion: AbstractMotion, connected: Scalar, dt: Scalar, inputs: Inputs) -> Any:
        """The RTS gains to the next time step, `dt` s later; `connected`: whether that step continues the track."""
        from trackwright.trackers.core.filters.rts import rts_gain

        def linearised(belief: Gaussian, inputs: Inputs, dt: Scalar) -> tuple[State, list[SparseRow], list[SparseRow]]:
            at = motion.at(belief)
            return sparse_jacobians(at, at.step, belief.mean, inputs, dt)

        # Structural ones stay Python floats.
        by_trajectory = eqx.filter_vmap(linearised, in_axes=-1, out_axes=eqx.if_array(-1))
        predicted, F, G = by_trajectory(belief, inputs, dt)
        return rts_gain(belief, predicted, F, G, connected, dt == 0)

    def rts_step(self, rts_gain: Any, after: Gaussian) -> Gaussian:
        """The smoothed beliefs of a time step, given the next one's."""
        from trackwright.trackers.core.filters.rts import rts_step

        return rts_step(rts_gain, after)


class ExtendedKalman(AbstractExtendedKalman):
    """The extended Kalman filter: motion and sensors are linearised at the current mean."""

    def update(
        self, belief: Gaussian, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Gaussian, Innovation]:
        """The belief after one reading, and the reading's `Innovation`."""
        point, rebuild = coordinates(belief.mean)
        has_student_t: list[bool] = []
        residual = sensor.residual_near(motion.view(belief.mean), reading, inputs)

        def residual_of(*values: Scalar) -> list[Scalar]:
            result = residual(motion.view(rebuild(values)))
            has_student_t[:] = [result.dof is not None]
            wrapped = jnp.where(result.wrapped, 1.0, 0.0)
            dof = 0.0 if result.dof is None else result.dof
            return [*result.whitened, result.log_scale, result.nis_dof, wrapped, dof, result.rest]

        (*whitened, log_scale, nis_dof, wrapped, dof, apart), rows = linearise(residual_of, point)
        jacobian = [{j: -v for j, v in row.items()} for row in rows[: len(whitened)]]
        if sensor.curved:
            factors = flattening(residual_of, point, whitened, jacobian, belief)
            whitened = [f * x for f, x in zip(factors, whitened, strict=True)]
            jacobian = [{j: f * v for j, v in row.items()} for f, row in zip(factors, jacobian, strict=True)]
            log_scale = log_scale + total(jnp.log(f) for f in factors)
        # Student's t weights each channel by itself; compression would spread an outlier over all of them.
        student_t = has_student_t[0]
        channels = compute_once((whitened, jacobian))
        left, H, rest = (*channels, jnp.zeros_like(nis_dof)) if student_t else compute_once(compressed(*channels))
        rest = rest + apart
        each = [row_for(belief.cov, h, len(point)) for h in H]
        step, cov, nis, log_density = sequential_updates(belief.cov, left, each, len(point), dof if student_t else None)
        innovation = Innovation(log_scale + log_density - 0.5 * rest, nis + rest, nis_dof, wrapped)
        mean = retract(belief.mean, step)
        return Gaussian(mean, above_resolution(cov, coordinates(mean)[0])), innovation


def flattening(
    residual: Callable[..., Sequence[Scalar]], point: Sequence[Scalar], whitened: Sequence[Scalar],
    rows: Sequence[SparseRow], belief: Gaussian,
) -> list[Scalar]:  # fmt: skip
    """By what whitened channels are multiplied, so that the noise covers what bends within the spread of the position.

    The bend is what a residual differs from its tangent `SPREAD` standard deviations off in independent directions: one
    that each of the first channels sees, and the one that is left, which turn with the world. A quarter of its mean
    square adds to the variance where it counts; other updates stay as they are.
    """
    first = component_names(belief.mean).index("position.0")
    place = range(first, first + len(belief.mean.position))
    axes = [{i: v for i, v in row.items() if i in place} for row in rows[: len(place) - 1]]
    axes.append({i: ANY[i - first] for i in place})
    roots, factor = square_roots(belief.cov, axes, len(point))
    # More than one direction that is left would not turn with the world.
    for i in range(len(axes) - 1):
        roots[-1] = roots[-1] * jnp.where(factor[i, i] > 0.0, 1.0, 0.0)
    steps = [[sign * SPREAD * root[i] for i in range(len(point))] for root in roots for sign in (1.0, -1.0)]
    away = [residual(*(x + s for x, s in zip(point, step, strict=True))) for step in steps]
    factors = []
    for k, (value, row) in enumerate(zip(whitened, rows, strict=True)):
        linear = [total(v * step[i] for i, v in row.items()) for step in steps]
        bend = total((r[k] - value + t) ** 2 for r, t in zip(away, linear, strict=True)) / len(steps)
        counts = bend > BENT / (2.0 * SPREAD**2) * total(t * t for t in linear)
        factors.append(jax.lax.stop_gradient(jnp.where(counts, 1.0 / jnp.sqrt(1.0 + 0.25 * bend), 1.0)))
    return factors


def square_roots(
    cov: AnyCovariance, rows: Sequence[SparseRow], n: int
) -> tuple[list[Any], dict[tuple[int, int], Scalar]]:
    """Of combinations h of the state by `rows`: covariances (n each) of the state with independent unit normals.

    Also the combinations in these, a lower triangle, by which h − its mean = factor·y. Components without variance
    drop out.
    """
    tolerance = 16 * float(jnp.finfo(jnp.result_type(cov[0])).eps)
    roots: list[Any] = []
    factor: dict[tuple[int, int], Scalar] = {}
    for i, row in enumerate(rows):
        h = row_for(cov, row, n)
        rest = product(cov, h, n)
        whole = dot(h, rest)
        for j, root in enumerate(roots):
            factor[i, j] = dot(h, root)
            rest = rest - root * factor[i, j]
        pivot = whole - total(factor[i, j] ** 2 for j in range(i))
        positive = pivot > tolerance * whole
        factor[i, i] = jnp.where(positive, jnp.sqrt(jnp.where(positive, pivot, 1.0)), 0.0)
        roots.append(compute_once(rest * inverse_or_zero(factor[i, i])))
    return roots, factor


def above_resolution(cov: AnyCovariance, point: Sequence[Scalar]) -> AnyCovariance:
    """The covariance with the rounding of the mean added: single precision resolves 1 cm at 100 km.

    The standard deviation of a component's rounding is its value times the relative spacing of numbers; fixes and
    ranges of that size are rounded alike. In double precision nothing is added.
    """
    eps = float(jnp.finfo(zero_of(cov).dtype).eps)
    return cov if eps < 1e-12 else added(cov, [eps * jax.lax.stop_gradient(x) for x in point])


def sparse_jacobians(
    motion: AbstractMotion, stage: Any, state: State, inputs: Inputs, dt: Scalar
) -> tuple[State, list[SparseRow], list[SparseRow]]:
    """The state after one stage of a motion without noise, and the sparse Jacobians F (state) and G (noise)."""
    point, rebuild = coordinates(state)
    zero = jnp.zeros_like(point[0])
    n = len(point)
    predicted = stage(state, inputs, dt, Vector.of([zero] * motion.noise_dimension))

    def step(*values: Scalar) -> list[Scalar]:
        before = rebuild(values[:n])
        return local_after(predicted, before, values[:n], stage(before, inputs, dt, Vector.of(values[n:])))

    _, rows = linearise(step, [*point, *[zero] * motion.noise_dimension])
    F = [{j: v for j, v in row.items() if j < n} for row in rows]
    G = [{j - n: v for j, v in row.items() if j >= n} for row in rows]
    return predicted, compute_once(F), compute_once(G)


def jacobian_of(motion: AbstractMotion, state: State, inputs: Inputs, dt: Scalar) -> tuple[State, Jacobian]:
    """The state `dt` s later without noise, and the Jacobian (F G) with respect to state and noise as one array."""
    point, rebuild = coordinates(state)
    zero = jnp.zeros_like(point[0])
    n = len(point)

    def step(*values: Scalar) -> State:
        return motion.step(rebuild(values[:n]), inputs, dt, Vector.of(values[n:]))

    return jacobian(step, [*point, *[zero] * motion.noise_dimension])


def compressed(
    residual: Sequence[Scalar], H: Sequence[SparseRow]
) -> tuple[Sequence[Scalar], Sequence[SparseRow], Scalar]:
    """One whitened channel per observed direction of the state, and the residual sum of squares that no state explains.

    With H = QLᵀ, Q of orthonormal columns, the equivalent channels are Lᵀ with residual Qᵀr, and the remaining sum of
    squares is from r − QQᵀr. By Gram–Schmidt, column after column: the Cholesky factor of HᵀH loses twice as many
    digits where a direction is hardly observed, as the distance by an array.
    """
    columns = sorted({j for row in H for j in row})
    if len(H) <= len(columns):
        return residual, H, jnp.zeros_like(residual[0])
    tolerance = 16 * float(jnp.finfo(jnp.asarray(residual[0]).dtype).eps)
    zero = jnp.zeros_like(residual[0])
    left = {j: [row.get(j, zero) for row in H] for j in columns}
    whole = {j: total(x * x for x in left[j]) for j in columns}
    remainder, equivalent, rows = list(residual), [], []
    for a, j in enumerate(columns):
        square = total(x * x for x in left[j])
        # What is not observed, as with antennas on a line, drops out instead of becoming infinite.
        observed = square > tolerance * whole[j]
        root = jnp.sqrt(jnp.where(observed, square, 1.0))
        unit = [jnp.where(observed, x / root, 0.0) for x in left[j]]
        row = {j: jnp.where(observed, root, 0.0)}
        for i in columns[a + 1 :]:
            row[i] = total(u * x for u, x in zip(unit, left[i], strict=True))
            left[i] = [x - row[i] * u for u, x in zip(unit, left[i], strict=True)]
        along = total(u * r for u, r in zip(unit, remainder, strict=True))
        remainder = [r - along * u for u, r in zip(unit, remainder, strict=True)]
        equivalent.append(along)
        rows.append(row)
    return equivalent, rows, total(r * r for r in remainder)


def sequential_updates(
    cov: AnyCovariance, residual: Sequence[Scalar], H: Sequence[SparseRow | Array], n: int, dof: Scalar | None = None
) -> tuple[Any, AnyCovariance, Scalar, Scalar]:
    """Scalar updates in Joseph form, one per channel: the small step, the covariance, the NIS and the log density.

    P⁺ = (I − khᵀ) P (I − khᵀ)ᵀ + kkᵀ with k = Ph/s and s = hᵀPh + 1. With Student's t of `dof` ν the noise variance is
    divided by the weight (ν + 1)/(ν + innovation²/s). The log density is without `Residual.log_scale`.
    """
    step = zeros(cov, n)
    nis = log_density = zero_of(cov)
    coarse = 256 * float(jnp.finfo(nis.dtype).eps)
    for r, h in zip(residual, H, strict=True):
        Ph = product(cov, h, n)
        a = jnp.maximum(dot(h, Ph), 0.0)
        innovation = r - dot(h, step)
        square = innovation * innovation / (1.0 + a)
        # A covariance in single precision cannot hold 10 km beside 1 mm: one reading reduces a variance as far as the
        # number format allows, later ones further. The bound follows the variances that hᵀPh sums: where a position and
        # a bias cancel, hᵀPh is nothing but rounding. In double precision the bound is never active.
        resolved = coarse * unconnected(cov, h, n)
        noise = jnp.maximum(1.0, resolved)
        if dof is None:
            log_density = log_density - 0.5 * (square + jnp.log(1.0 + a))
        else:
            weight = (dof + 1.0) / (dof + square)
            noise = jnp.maximum(1.0 / weight, resolved)
            log_density = log_density - 0.5 * ((dof + 1.0) * jnp.log1p(square / dof) + jnp.log(1.0 + a))
            square = square * weight
        k, cov = updated(cov, Ph, h, a, noise)
        step = step + k * innovation
        nis = nis + square
    return step, cov, nis, log_density
