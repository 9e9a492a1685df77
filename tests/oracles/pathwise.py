"""Two common particle gradients, both biased where the score form is not."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from tests.oracles.particle_worlds import AbstractModified
from trackwright.trackers.core.filters.particle.filter import ParticleFilter, Particles, draws
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Scalar, Vector, cholesky, total, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.state import State, dimension, retract


class Pathwise(AbstractModified):
    """The pathwise derivative of the moves of `particles`; `inherit`: whether offspring inherit that of the weights."""

    particles: ParticleFilter
    inherit: bool = eqx.field(static=True)

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Particles:
        n, potential = self.particles.n_particles, self.particles.potential
        key, offset, w = draws(belief.key, motion.noise_dimension, n, belief.log_weights.dtype)
        # Resampling by a search in the cumulative weights shares no code with the filter's own.
        weights = jnp.exp(jax.lax.stop_gradient(belief.log_weights))
        resample = jnp.sum(weights * weights) * (self.particles.fraction * n) > 1.0
        ends = jnp.cumsum(weights)
        targets = (jnp.arange(n, dtype=ends.dtype) + offset) * (ends[-1] / n)
        ancestors = jnp.minimum(jnp.searchsorted(ends, targets), n - 1)
        states, inherited = jax.tree_util.tree_map(lambda x: x[..., ancestors], (belief.states, belief.log_weights))
        states = jax.tree_util.tree_map(lambda a, b: jnp.where(resample, a, b), states, belief.states)
        log_weights = jnp.where(resample, self.offspring(inherited), belief.log_weights)

        def step(state: State, w: list[Any]) -> State:
            return motion.step(state, inputs, dt, Vector.of(w))

        moved = jax.vmap(step, in_axes=-1, out_axes=-1)(states, w)
        if potential is not None:
            view = jax.vmap(motion.view, in_axes=-1, out_axes=-1)
            factors = jax.vmap(potential.log_weight, in_axes=-1, out_axes=-1)(view(states), view(moved))
            log_weights = jnp.maximum(log_weights + factors, LOG_ZERO)
        return Particles(moved, log_weights, key)

    def init(self, belief: Gaussian, key: Any) -> Particles:
        drawn = self.particles.init(belief, key)
        n, dtype = dimension(belief.mean), belief.cov[0].dtype
        _, _, w = draws(key, n, self.particles.n_particles, dtype)
        L = cholesky(dict(zip(triangle(n), belief.cov, strict=True)), range(n), 16 * float(jnp.finfo(dtype).eps))
        steps = [total(L[i, j] * w[j] for j in range(i + 1)) for i in range(n)]
        states = jax.vmap(lambda step: retract(belief.mean, list(step)), in_axes=-1, out_axes=-1)(steps)
        return drawn._replace(states=states, log_weights=jax.lax.stop_gradient(drawn.log_weights))

    def offspring(self, ancestors: Any) -> Any:
        """Equal log-weights (N,), given those of the ancestors; a copy of a particle of weight zero keeps it."""
        uniform = jnp.full_like(ancestors, -math.log(self.particles.n_particles))
        equal = jnp.where(ancestors > 0.5 * LOG_ZERO, uniform, LOG_ZERO)
        return equal + (ancestors - jax.lax.stop_gradient(ancestors)) if self.inherit else equal


REPARAMETERISED = partial(Pathwise, inherit=True)
"""Pathwise derivative with stop-gradient resampling: Ścibior and Wood (2021, algorithm 1).

Correct for smooth densities. Biased at walls, because the probability of dying has no pathwise derivative.
"""

NAIVE = partial(Pathwise, inherit=False)
"""Automatic differentiation of the filter as written: resampled weights and ancestor indices have no derivative."""
