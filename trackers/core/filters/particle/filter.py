"""The bootstrap particle filter (Gordon, Salmond and Smith 1993) over named states, for one trajectory and one step.

Leaves of the states end with an axis of N particles. Weights are kept as logarithms. A step resamples first, then
propagates, then weights, so that estimates are taken before resampling. Random numbers come from Threefry-2x32 (Salmon
et al. 2011), unrolled: `jax.random` has the same generator in a loop that passes memory five times; XLA fuses the
unrolled form into one pass.

The derivative is in score form. A draw has no derivative through a wall or through the choice of an ancestor, but its
density has one. So states are held fixed, and the derivative of a log-weight is the accumulated score ∂ log p(noise
draws) of its particle, passed from ancestor to offspring; a weighted sum then has the derivative of its expectation
(Poyiadjis, Doucet and Singh 2011, section 2.2; with a discount MOP-α, Tan, Hooker and Ionides 2024). Values are
unchanged, bit by bit.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, DTypeLike, Float, UInt32

from trackwright.trackers.core.filters.filter import AbstractFilter, Innovation
from trackwright.trackers.core.filters.particle.resampling import (
    LOG_ZERO,
    Weights,
    cached_exp,
    effective_sample_size,
    resample,
)
from trackwright.trackers.core.model.algebra import Scalar, Vector, cholesky, solve_lower, total, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs, RawKey, threefry
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Residual
from trackwright.trackers.core.model.state import State, dimension, local, retract


class Particles(NamedTuple):
    """A belief: N states (leaves end with an axis of N), their log-weights (N,), and a raw random key (2,).

    `weights`: cached exp(log_weights), or None.
    """

    states: State
    log_weights: Weights
    key: RawKey
    weights: Weights | None = None

    def linear(self) -> Weights:
        """The weights (N,), with the derivative of exp(log_weights)."""
        return jnp.exp(self.log_weights) if self.weights is None else cached_exp(self.log_weights, self.weights)


class AbstractPotential(eqx.Module):
    """A factor of a particle's weight that depends on its last move alone.

    `view_fields`: the fields of `motion.view` that it needs.
    """

    view_fields: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def log_weight(self, before: Any, after: Any) -> Scalar:
        """The log of the factor, from `motion.view` of the states before and after the move.

        0 for an ordinary move, `LOG_ZERO` for an impossible one.
        """


class AbstractOutputMap(eqx.Module):
    """A map from states to the estimated quantity, as from arclength on a path to a position on the floor."""

    @abstractmethod
    def moments(self, states: State, weights: Weights) -> tuple[State, tuple[Scalar, ...]]:
        """The mapped quantity of the mean state, and the covariance about it as an upper triangle.

        `states`: leaves end with an axis of N. `weights`: (N,), with sum 1.
        """


class AbstractParticleFilter(AbstractFilter[Particles]):
    """A filter whose belief is `Particles`, so that its likelihood is random."""

    has_particle_axis: ClassVar[bool] = True

    @property
    @abstractmethod
    def bootstrap(self) -> ParticleFilter:
        """The bootstrap filter whose number of particles and potential it has: itself, or the one that it modifies."""


class ParticleFilter(AbstractParticleFilter):
    """Bootstrap particle filter with systematic resampling where the effective sample size is below `fraction`·N.

    Equations (1.22)–(1.30) of the assembly-line thesis, with E for the mean in (1.29); see `docs/papers.md`. Its random
    numbers have 16 bits: no noise draw exceeds 4.3 standard deviations. `output_map`: estimates are of the mapped
    quantity. `potential`: log-weights of moves, as `Walls`; they enter the log-likelihood of the next measurement.

    The derivative is in score form; tuning the motion needs its `log_density`.
    `discount`: the fraction of an ancestor's score that offspring keep (MOP-α); less variance, but a bias.
    """

    n_particles: int = eqx.field(static=True, default=1000)
    fraction: float = eqx.field(static=True, default=0.5)
    output_map: AbstractOutputMap | None = None
    discount: float = eqx.field(static=True, default=1.0)
    potential: AbstractPotential | None = None

    @property
    def bootstrap(self) -> ParticleFilter:
        return self

    @property
    def view_fields(self) -> tuple[str, ...]:
        return () if self.potential is None else self.potential.view_fields

    def init(self, belief: Gaussian, key: RawKey) -> Particles:
        """N particles drawn from a Gaussian belief, of weight 1/N (1.22); `key` (2,): raw random key."""
        n, dtype = dimension(belief.mean), belief.cov[0].dtype
        key, _, w = draws(key, n, self.n_particles, dtype)
        pairs = dict(zip(triangle(n), belief.cov, strict=True))
        L = cholesky(pairs, range(n), 16 * float(jnp.finfo(dtype).eps))
        steps = [total(L[i, j] * w[j] for j in range(i + 1)) for i in range(n)]
        states = jax.vmap(lambda step: retract(belief.mean, list(step)), in_axes=-1, out_axes=-1)(steps)
        # 0·w makes the log-weights depend on the trajectory, as their score does; else jax (0.10) confuses the axes.
        uniform = 0.0 * w[0] - math.log(self.n_particles)
        states = jax.lax.stop_gradient(states)
        log_weights = with_score(uniform, belief, states, log_density=normal_log_density)
        return Particles(states, log_weights, key, jax.lax.stop_gradient(jnp.exp(uniform)))

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Particles:
        """The belief `dt` s later (1.23), resampled before where the effective sample size is too small."""
        dtype = belief.log_weights.dtype
        key, offset, w = draws(belief.key, motion.noise_dimension, self.n_particles, dtype)
        weights = jax.lax.stop_gradient(belief.linear())
        needed = effective_sample_size(weights) < self.fraction * self.n_particles
        states, log_weights, weights = resample_with_score(
            needed, offset, belief.states, belief.log_weights, weights, discount=self.discount
        )

        def step(state: State, w: list[Scalar]) -> State:
            return motion.step(state, inputs, dt, Vector.of(w))

        predicted = jax.vmap(step, in_axes=-1, out_axes=-1)(states, w)
        log_weights = with_score(log_weights, motion, states, inputs, dt, w, log_density=noise_log_density)
        predicted = jax.lax.stop_gradient(predicted)
        if self.potential is None:
            return Particles(predicted, log_weights, key, weights)
        views = jax.vmap(motion.view, in_axes=-1, out_axes=-1)
        potentials = jax.vmap(self.potential.log_weight, in_axes=-1, out_axes=-1)(views(states), views(predicted))
        return Particles(predicted, jnp.maximum(log_weights + potentials, LOG_ZERO), key)

    def update(
        self, belief: Particles, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Particles, Innovation]:
        """The belief after one reading (1.24)–(1.27), and the reading's `Innovation`.

        Log-likelihood: the log of the sum of the new weights, where the old ones have sum 1. NIS: of the particles'
        mean whitened residual, with the covariances of the particles and of the noise added.
        """
        result = particle_residuals(belief.states, motion, sensor, reading, inputs)
        whitened, densities = result.whitened, result.log_density
        unnormalised = jnp.maximum(belief.log_weights + densities, LOG_ZERO)
        top = jax.lax.stop_gradient(jnp.max(unnormalised))
        scaled = jnp.exp(unnormalised - top)
        scaled_sum = jnp.sum(scaled)
        # All weights zero: the log-likelihood is NaN, so that the tracker starts again.
        log_likelihood = jnp.where(top > 0.5 * LOG_ZERO, top + jnp.log(scaled_sum), jnp.nan)
        log_weights = jnp.where(
            unnormalised > 0.5 * LOG_ZERO, unnormalised - log_likelihood, LOG_ZERO + 0 * log_likelihood
        )
        weights = belief.linear()
        if self.potential is not None:
            weights = weights / jnp.maximum(jnp.sum(weights), jnp.finfo(weights.dtype).tiny)
        nis = weighted_nis(whitened, weights, result.dof)
        wrapped = 0.0 * log_likelihood if result.wrapped is None else jnp.sum(weights * result.wrapped)
        innovation = Innovation(log_likelihood, nis, result.nis_dof, wrapped)
        cached = jax.lax.stop_gradient(scaled * jnp.where(top > 0.5 * LOG_ZERO, 1.0 / scaled_sum, jnp.nan))
        return belief._replace(log_weights=log_weights, weights=cached), innovation

    def moments(self, belief: Particles) -> tuple[State, tuple[Scalar, ...]]:
        """The weighted mean (1.28) and the covariance's upper triangle, of the mapped quantity if there is a map."""
        return weighted_moments(belief.states, belief.linear(), self.output_map)


def noise_log_density(
    motion: AbstractMotion, states: State, inputs: Inputs, dt: Scalar, w: list[Float[Array, " N"]]
) -> Float[Array, " N"]:
    """The log densities (N,) of the noise draws `w` of N steps; 0 for dt = 0."""

    def density(state: State, w: list[Scalar]) -> Scalar:
        return jnp.where(dt > 0, motion.log_density(state, inputs, dt, Vector.of(w)), 0.0)

    return jax.vmap(density, in_axes=-1, out_axes=-1)(states, w)


class ParticleResiduals(NamedTuple):
    """One reading against N states: whitened residuals per channel and log densities, (N,) each.

    `wrapped`: (N,) or None. `nis_dof`: rank of the residual. `dof`: of Student's t, None for normal noise.
    """

    whitened: list[Float[Array, " N"]]
    log_density: Float[Array, " N"]
    wrapped: Float[Array, " N"] | None
    nis_dof: Scalar
    dof: Scalar | None


def particle_residuals(
    states: State, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
) -> ParticleResiduals:
    """The residuals of the reading at N states, whose leaves end with an axis of N."""

    def residual(state: State) -> Residual:
        return sensor.residual(reading, list(sensor.measure(motion.view(state), inputs)))

    def every(state: State) -> tuple[list[Scalar], Scalar, Scalar | None]:
        result = residual(state)
        # A sensor without angles has the Python False here: no array to sum.
        wrapped = (
            None if result.wrapped is False else jnp.where(result.wrapped, 1.0, 0.0).astype(result.log_scale.dtype)
        )
        return list(result.whitened), result.log_density, wrapped

    first = residual(jax.tree_util.tree_map(lambda x: x[..., 0], states))
    return ParticleResiduals(*jax.vmap(every, in_axes=-1, out_axes=-1)(states), first.nis_dof, first.dof)


def weighted_moments(
    states: State, weights: Weights, output_map: AbstractOutputMap | None = None
) -> tuple[State, tuple[Scalar, ...]]:
    """Mean and covariance (upper triangle) of N states with weights (N,) of sum 1, or of the mapped quantity."""
    if output_map is not None:
        return output_map.moments(states, weights)
    mean = weighted_mean(states, weights)
    deviations = jax.vmap(lambda s: local(mean, s), in_axes=-1, out_axes=-1)(states)
    return mean, second_moments(deviations, weights)


def weighted_mean(states: State, weights: Weights) -> State:
    """The mean of N states with weights (N,) of sum 1, by the small steps from the first one."""
    first = jax.tree_util.tree_map(lambda x: x[..., 0], states)
    steps = jax.vmap(lambda s: local(first, s), in_axes=-1, out_axes=-1)(states)
    return retract(first, [jnp.sum(weights * step) for step in steps])


def second_moments(values: list[Float[Array, " N"]], weights: Weights) -> tuple[Scalar, ...]:
    """Σ weight·a·b for each pair of the values, (N,) each, in the order of an upper triangle."""
    return tuple(jnp.sum(weights * values[i] * values[j]) for i, j in triangle(len(values)))


def weighted_nis(whitened: list[Float[Array, " N"]], weights: Weights, dof: Scalar | None) -> Scalar:
    """NIS r̄ᵀ(I + C)⁻¹r̄, with r̄ and C the particles' mean and covariance of the whitened residual.

    For Student's t each decorrelated component is weighted by (ν + 1)/(ν + its square).
    """
    m = len(whitened)
    mean = [jnp.sum(weights * r) for r in whitened]
    spread = second_moments([r - a for r, a in zip(whitened, mean, strict=True)], weights)
    cov = {(i, j): c + 1.0 if i == j else c for (i, j), c in zip(triangle(m), spread, strict=True)}
    L = cholesky(cov, range(m), 0.0)
    squares = [x * x for x in solve_lower(L, mean)]
    return total(squares if dof is None else [s * (dof + 1.0) / (dof + s) for s in squares])


@cache
def quantiles() -> np.ndarray:
    """The normal quantiles at the midpoints of 65,536 equal probability intervals, scaled to variance 1."""
    upper = scipy.special.ndtri((np.arange(32768, 65536) + 0.5) / 65536)
    return np.concatenate([-upper[::-1], upper]) / np.sqrt(np.mean(upper**2))


def draws(
    key: RawKey, rows: int, count: int, dtype: DTypeLike
) -> tuple[RawKey, Float[Array, ""], list[Float[Array, " {count}"]]]:
    """The next key (2,), a uniform number in [0, 1), and `rows` arrays of `count` standard normal numbers.

    `key`: raw, (2,) uint32. A normal number has 16 random bits: the median of one of 65,536 equally likely intervals,
    so that none exceeds 4.3.
    """
    spare = words(key, range(1), 2)[:, 0]
    table = jnp.asarray(quantiles(), dtype)
    normals = []
    for pairs in words(key, range(1, rows + 1), -(-count // 4)).swapaxes(0, 1).reshape(rows, -1):
        bits = jnp.concatenate([pairs >> np.uint32(16), pairs & np.uint32(0xFFFF)])[:count].astype(jnp.int32)
        normals.append(table.at[bits].get(mode="promise_in_bounds"))
    return spare[:, 0], (spare[0, 1] >> np.uint32(9)).astype(dtype) * 2.0**-23, normals


def words(key: RawKey, streams: range, count: int) -> UInt32[Array, "2 k {count}"]:
    """Random words (2, k, count), uint32: both words of the first `count` counters of k streams under a raw key.

    Each entry computes both words and selects one: with two results XLA makes a pass over memory of every round.
    One call for all streams: the rounds are compiled once.
    """
    shape = (2, len(streams), count)
    stream = jax.lax.broadcasted_iota(jnp.uint32, shape, 1) + np.uint32(streams.start)
    x, y = threefry(key, jax.lax.broadcasted_iota(jnp.uint32, shape, 2), stream)
    return jnp.where(jax.lax.broadcasted_iota(jnp.uint32, shape, 0) == 0, x, y)


@eqx.filter_custom_jvp
def with_score(log_weights: Weights, *numbers: Any, log_density: Callable[..., Weights]) -> Weights:
    """The log-weights (N,), unchanged, with the derivative of `log_density(*numbers)`, (N,), added to theirs.

    `log_density` is called only where some of the numbers are differentiated.
    """
    return log_weights


@with_score.def_jvp
def _with_score(primals: Any, tangents: Any, *, log_density: Callable[..., Weights]) -> tuple[Weights, Weights | None]:
    value = with_score(*primals, log_density=log_density)
    tangent, others = tangents[0], jax.tree_util.tree_leaves(tangents[1:], is_leaf=lambda x: x is None)
    leaves, structure = jax.tree_util.tree_flatten(primals[1:])
    differentiated = [k for k, t in enumerate(others) if t is not None]
    if not differentiated:
        return value, tangent

    def density(*numbers: Any) -> Weights:
        replaced = list(leaves)
        for k, x in zip(differentiated, numbers, strict=True):
            replaced[k] = x
        return log_density(*jax.tree_util.tree_unflatten(structure, replaced))

    score = jax.jvp(density, [leaves[k] for k in differentiated], [others[k] for k in differentiated])[1]
    return value, score if tangent is None else tangent + score


@eqx.filter_custom_jvp
def resample_with_score(
    needed: Bool[Array, ""], offset: Float[Array, ""], states: State, log_weights: Weights, weights: Weights, *,
    discount: float,
) -> tuple[State, Weights, Weights]:  # fmt: skip
    """`resample`, with `discount` times the ancestor's score for each offspring."""
    return resample(needed, offset, states, log_weights, weights)


@resample_with_score.def_jvp
def _resample_with_score(primals: Any, tangents: Any, *, discount: float) -> tuple[Any, Any]:
    needed, offset, states, log_weights, weights = primals
    score = tangents[3]
    fixed = jax.tree_util.tree_map(lambda _: None, states)
    if score is None:
        return resample(needed, offset, states, log_weights, weights), (fixed, None, None)
    # The score is resampled with the particles, as if it were part of their state.
    (states, score), log_weights, weights = resample(needed, offset, (states, score), log_weights, weights)
    score = score if discount == 1 else jnp.where(needed, discount * score, score)
    return (states, log_weights, weights), (fixed, score, None)


def normal_log_density(belief: Gaussian, states: State) -> Weights:
    """The log densities (N,), up to a constant, of states (leaves end with an axis of N) under a Gaussian belief.

    A direction without variance contributes nothing; the mean must not depend on a tunable along it.
    """
    n = dimension(belief.mean)
    pairs = dict(zip(triangle(n), belief.cov, strict=True))
    L = cholesky(pairs, range(n), 16 * float(jnp.finfo(belief.cov[0].dtype).eps))
    scale = total(-jnp.log(jnp.where(L[i, i] > 0, L[i, i], 1.0)) for i in range(n))

    def density(state: State) -> Float[Array, ""]:
        return scale - 0.5 * total(x * x for x in solve_lower(L, local(belief.mean, state)))

    return jax.vmap(density, in_axes=-1, out_axes=-1)(states)
