"""Two common particle gradients, both biased where the score form is not."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, cholesky, total, triangle
from trackers.core.filter import Gaussian
from trackers.core.motion import AbstractMotion
from trackers.core.particle.filter import ParticleFilter, Particles
from trackers.core.particle.random import draws
from trackers.core.particle.resampling import LOG_ZERO
from trackers.core.state import State, dimension, retract


class Reparameterised(ParticleFilter):
    """Pathwise derivative of the moves, with stop-gradient resampling: Ścibior and Wood (2021, algorithm 1).

    Correct for smooth densities. Biased at walls, because the probability of dying has no pathwise derivative.
    """

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Particles:
        key, offset, w = draws(belief.key, motion.noise_dimension, self.n_particles, belief.log_weights.dtype)
        # Resampling by a search in the cumulative weights shares no code with the filter's own.
        weights = jnp.exp(jax.lax.stop_gradient(belief.log_weights))
        resample = jnp.sum(weights * weights) * (self.fraction * self.n_particles) > 1.0
        ends = jnp.cumsum(weights)
        targets = (jnp.arange(self.n_particles, dtype=ends.dtype) + offset) * (ends[-1] / self.n_particles)
        ancestors = jnp.minimum(jnp.searchsorted(ends, targets), self.n_particles - 1)
        states, inherited = jax.tree_util.tree_map(lambda x: x[..., ancestors], (belief.states, belief.log_weights))
        states = jax.tree_util.tree_map(lambda a, b: jnp.where(resample, a, b), states, belief.states)
        log_weights = jnp.where(resample, self.offspring(inherited), belief.log_weights)

        def step(state: State, w: list[Any]) -> State:
            return motion.step(state, inputs, dt, Vector.of(w))

        moved = jax.vmap(step, in_axes=-1, out_axes=-1)(states, w)
        if self.potential is not None:
            view = jax.vmap(motion.view, in_axes=-1, out_axes=-1)
            potential = jax.vmap(self.potential.log_weight, in_axes=-1, out_axes=-1)(view(states), view(moved))
            log_weights = jnp.maximum(log_weights + potential, LOG_ZERO)
        return Particles(moved, log_weights, key)

    def init(self, belief: Gaussian, key: Any) -> Particles:
        drawn = super().init(belief, key)
        n, dtype = dimension(belief.mean), belief.cov[0].dtype
        _, _, w = draws(key, n, self.n_particles, dtype)
        L = cholesky(dict(zip(triangle(n), belief.cov, strict=True)), range(n), 16 * float(jnp.finfo(dtype).eps))
        steps = [total(L[i, j] * w[j] for j in range(i + 1)) for i in range(n)]
        states = jax.vmap(lambda step: retract(belief.mean, list(step)), in_axes=-1, out_axes=-1)(steps)
        return drawn._replace(states=states, log_weights=jax.lax.stop_gradient(drawn.log_weights))

    def offspring(self, ancestors: Any) -> Any:
        """Log-weights (N,) after resampling: equal in value, with the derivative of the ancestors' log-weights."""
        return self.equal(ancestors) + (ancestors - jax.lax.stop_gradient(ancestors))

    def equal(self, ancestors: Any) -> Any:
        """Equal log-weights (N,) without derivative; a copy of a particle of weight zero keeps weight zero."""
        return jnp.where(ancestors > 0.5 * LOG_ZERO, jnp.full_like(ancestors, -math.log(self.n_particles)), LOG_ZERO)


class Naive(Reparameterised):
    """Automatic differentiation of the filter as written: resampled weights and ancestor indices have no derivative."""

    def offspring(self, ancestors: Any) -> Any:
        return self.equal(ancestors)
