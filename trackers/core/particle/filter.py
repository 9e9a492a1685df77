"""The bootstrap particle filter over named states, one trajectory and one step (Gordon, Salmond and Smith 1993).

Weights are kept as logarithms and resampling stands at the start of a step, so that estimates are taken before it.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, cholesky, inverse_or_zero, total, triangle
from trackers.core.ekf import Gaussian, Innovation
from trackers.core.motion import AbstractMotion
from trackers.core.particle.potential import AbstractPotential
from trackers.core.particle.random import draws
from trackers.core.particle.resampling import NOTHING, effective_sample_size, exponential
from trackers.core.particle.score import drawn_with_scores, normal_density, with_score
from trackers.core.sensor import AbstractSensor, Reading, Residual
from trackers.core.state import State, dimension, local, retract


class Particles(NamedTuple):
    """A belief: states whose leaves end with an axis of N particles, their log-weights (N,), and a raw key (2,).

    `weights`: exp(log_weights) where someone knows it already, so that not every pass makes it again; else None.
    """

    states: State
    log_weights: Any
    key: Any
    weights: Any = None

    def linear(self) -> Any:
        """The weights (N,) themselves, with the derivative that their logarithms have."""
        return jnp.exp(self.log_weights) if self.weights is None else exponential(self.log_weights, self.weights)


class AbstractOutputMap(eqx.Module):
    """What a filter shows of a state, where that is another quantity: a place on the floor for one on a line."""

    @abstractmethod
    def moments(self, states: State, weights: Any) -> tuple[State, tuple[Scalar, ...]]:
        """The shown quantity of the mean state, and the upper triangle of its spread about that.

        `states`: leaves that end with an axis along `weights`, which add to 1.
        """


class ParticleFilter(eqx.Module):
    """`n_particles` weighted states; fewer than `fraction`·N effective ones are drawn again, systematically.

    Equations (1.22)–(1.30) of the assembly-line thesis, with E for the mean in (1.29); see `docs/papers.md`. Of a state
    with a `report`, estimates are the shown quantity of the weighted mean and its spread about that.

    Its derivative has the score form of `trackers/core/particle/score.py`, which needs `log_density` of the motion where that
    is tuned. `discount`: what an offspring keeps of its ancestor's derivative (MOP-α); less than 1 is less scatter and
    a bias. `potential`: weighs every move by itself, as `Walls` do; its log-likelihood stands with the next reading's.
    """

    n_particles: int = eqx.field(static=True, default=1000)
    fraction: float = eqx.field(static=True, default=0.5)
    report: AbstractOutputMap | None = None
    discount: float = eqx.field(static=True, default=1.0)
    potential: AbstractPotential | None = None

    @property
    def has_particle_axis(self) -> bool:
        """True: the belief has an axis of its own."""
        return True

    def init(self, belief: Gaussian, key: Any) -> Particles:
        """Particles drawn from a normal belief, all of weight 1/N (1.22); `key` (2,): raw random key."""
        n, dtype = dimension(belief.mean), belief.cov[0].dtype
        key, _, w = draws(key, n, self.n_particles, dtype)
        pairs = dict(zip(triangle(n), belief.cov, strict=True))
        L = cholesky(pairs, range(n), 16 * float(jnp.finfo(dtype).eps))
        steps = [total(L[i, j] * w[j] for j in range(i + 1)) for i in range(n)]
        states = jax.vmap(lambda step: retract(belief.mean, list(step)), in_axes=-1, out_axes=-1)(steps)
        # Their score differs from trajectory to trajectory: so must they, or jax (0.10) mixes up the axes of both.
        even = 0.0 * w[0] - math.log(self.n_particles)
        states = jax.lax.stop_gradient(states)
        log_weights = with_score(even, belief, states, log_density=normal_density)
        return Particles(states, log_weights, key, jax.lax.stop_gradient(jnp.exp(even)))

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Particles:
        """The belief `dt` seconds later (1.23), drawn again before where too few particles carry the weight."""
        dtype = belief.log_weights.dtype
        key, place, w = draws(belief.key, motion.noise_dimension, self.n_particles, dtype)
        weights = jax.lax.stop_gradient(belief.linear())
        few = effective_sample_size(weights) < self.fraction * self.n_particles
        states, log_weights, weights = drawn_with_scores(
            few, place, belief.states, belief.log_weights, weights, discount=self.discount
        )

        def step(state: State, w: list[Any]) -> State:
            return motion.step(state, inputs, dt, Vector.of(w))

        moved = jax.vmap(step, in_axes=-1, out_axes=-1)(states, w)
        log_weights = with_score(log_weights, motion, states, inputs, dt, w, log_density=density_of_draws)
        moved = jax.lax.stop_gradient(moved)
        if self.potential is not None:
            moves = jax.vmap(motion.view, in_axes=-1, out_axes=-1)
            said = jax.vmap(self.potential.log_weight, in_axes=-1, out_axes=-1)(moves(states), moves(moved))
            log_weights, weights = jnp.maximum(log_weights + said, NOTHING), None
        return Particles(moved, log_weights, key, weights)

    def update(
        self, belief: Particles, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Particles, Innovation]:
        """The belief after one reading (1.24)–(1.27), and what the reading said.

        The log-likelihood is that of the reading given all before: the logarithm of the sum of the weights after, which
        add to 1 before. The NIS is that of the whitened residual's mean in the spread that particles and noise give it.
        """

        seen = weighed(belief.states, motion, sensor, reading, inputs)
        whitened, densities = seen.whitened, seen.log_density
        weighted = jnp.maximum(belief.log_weights + densities, NOTHING)
        top = jax.lax.stop_gradient(jnp.max(weighted))
        heights = jnp.exp(weighted - top)
        height = jnp.sum(heights)
        # With no weight left there is no belief: not finite, so that the tracker starts again.
        after = jnp.where(top > 0.5 * NOTHING, top + jnp.log(height), jnp.nan)
        kept = jnp.where(weighted > 0.5 * NOTHING, weighted - after, NOTHING + 0 * after)
        weights = belief.linear()
        if self.potential is not None:
            weights = weights / jnp.maximum(jnp.sum(weights), jnp.finfo(weights.dtype).tiny)
        nis = normalised_square(whitened, weights, seen.dof)
        wrapped = 0.0 * after if seen.wrapped is None else jnp.sum(weights * seen.wrapped)
        innovation = Innovation(after, nis, seen.nis_dof, wrapped)
        known = jax.lax.stop_gradient(heights * jnp.where(top > 0.5 * NOTHING, 1.0 / height, jnp.nan))
        return belief._replace(log_weights=kept, weights=known), innovation

    def moments(self, belief: Particles) -> tuple[State, tuple[Scalar, ...]]:
        """The weighted mean (1.28) and the covariance's upper triangle, of the shown quantity where there is one."""
        return weighted_moments(belief.states, belief.linear(), self.report)


def density_of_draws(motion: AbstractMotion, states: State, inputs: Any, dt: Scalar, w: list[Any]) -> Any:
    """The log densities (N,) of the noise draws `w` of N moves; nothing is drawn in no time."""

    def density(state: State, w: list[Any]) -> Scalar:
        return jnp.where(dt > 0, motion.log_density(state, inputs, dt, Vector.of(w)), 0.0)

    return jax.vmap(density, in_axes=-1, out_axes=-1)(states, w)


class Weighed(NamedTuple):
    """What a reading says of N states: whitened residuals and log densities (N,), wraps (N,) where the sensor has any.

    `nis_dof`: of independent numbers read. `dof`: degrees of freedom, None for normal noise.
    """

    whitened: list[Any]
    log_density: Any
    wrapped: Any
    nis_dof: Scalar
    dof: Scalar | None


def weighed(states: State, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any) -> Weighed:
    """What the reading says of states whose leaves end with an axis of N."""

    def residual(state: State) -> Residual:
        return sensor.residual(reading, list(sensor.measure(motion.view(state), inputs)))

    def every(state: State) -> tuple[list[Scalar], Scalar, Scalar | None]:
        result = residual(state)
        # Most sensors read no angles: their wraps are a Python False, over which there is nothing to sum.
        wrapped = (
            None if result.wrapped is False else jnp.where(result.wrapped, 1.0, 0.0).astype(result.log_scale.dtype)
        )
        return list(result.whitened), log_density(result), wrapped

    first = residual(jax.tree_util.tree_map(lambda x: x[..., 0], states))
    return Weighed(*jax.vmap(every, in_axes=-1, out_axes=-1)(states), first.nis_dof, first.dof)


def weighted_moments(
    states: State, weights: Any, report: AbstractOutputMap | None = None
) -> tuple[State, tuple[Scalar, ...]]:
    """Mean and covariance (upper triangle) of states whose leaves end with an axis along `weights`, which add to 1.

    With a `report`: what it makes of the states.
    """
    if report is not None:
        return report.moments(states, weights)
    mean = weighted_mean(states, weights)
    about = jax.vmap(lambda s: local(mean, s), in_axes=-1, out_axes=-1)(states)
    return mean, second_moments(about, weights)


def weighted_mean(states: State, weights: Any) -> State:
    """The mean of states whose leaves end with an axis along `weights`, which add to 1."""
    first = jax.tree_util.tree_map(lambda x: x[..., 0], states)
    apart = jax.vmap(lambda s: local(first, s), in_axes=-1, out_axes=-1)(states)
    return retract(first, [jnp.sum(weights * step) for step in apart])


def second_moments(values: list[Any], weights: Any) -> tuple[Scalar, ...]:
    """Σ weight·a·b for every two of the values (N,), in the order of an upper triangle."""
    return tuple(jnp.sum(weights * values[i] * values[j]) for i, j in triangle(len(values)))


def log_density(result: Residual) -> Scalar:
    """The log density of a reading, from its whitened residual."""
    if result.dof is None:
        return result.log_scale - 0.5 * total(r * r for r in result.whitened)
    dof = result.dof
    return result.log_scale - 0.5 * (dof + 1.0) * total(jnp.log1p(r * r / dof) for r in result.whitened)


def normalised_square(whitened: list[Any], weights: Any, dof: Scalar | None) -> Scalar:
    """r̄ᵀ(I + C)⁻¹r̄, with r̄ and C the particles' mean and covariance of the whitened residual.

    Of a heavy tail each decorrelated part is weighted by what Student's t expects of so large a one.
    """
    m = len(whitened)
    mean = [jnp.sum(weights * r) for r in whitened]
    spread = second_moments([r - a for r, a in zip(whitened, mean, strict=True)], weights)
    cov = {(i, j): c + 1.0 if i == j else c for (i, j), c in zip(triangle(m), spread, strict=True)}
    L = cholesky(cov, range(m), 0.0)
    parts: list[Scalar] = []
    for i in range(m):
        parts.append((mean[i] - total(L[i, j] * parts[j] for j in range(i))) * inverse_or_zero(L[i, i]))
    squares = [p * p for p in parts]
    return total(squares if dof is None else [s * (dof + 1.0) / (dof + s) for s in squares])
