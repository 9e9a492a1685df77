"""Particle gradients as they are often taken, both wrong: shown to fail where the score form holds."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, cholesky, total, triangle
from trackers.core.ekf import Gaussian
from trackers.core.motion import AbstractMotion
from trackers.core.particle.filter import ParticleFilter, Particles
from trackers.core.particle.random import draws
from trackers.core.particle.resampling import LOG_ZERO
from trackers.core.state import State, dimension, retract


class Reparameterised(ParticleFilter):
    """Moves differentiated as functions of their noise, ancestors' weights kept with their value stopped.

    Ścibior and Wood (2021, algorithm 1): right where densities are smooth; a wall that a particle would cross with a
    larger noise has no say, since the chance to die has no derivative along a path.
    """

    def predict(self, belief: Particles, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Particles:
        key, place, w = draws(belief.key, motion.noise_dimension, self.n_particles, belief.log_weights.dtype)
        weights = jax.lax.stop_gradient(belief.linear())
        # Drawn again by a search in the cumulative weights, which shares no code with the filter's own resampling.
        weights = jnp.exp(jax.lax.stop_gradient(belief.log_weights))
        few = jnp.sum(weights * weights) * (self.fraction * self.n_particles) > 1.0
        ends = jnp.cumsum(weights)
        places = (jnp.arange(self.n_particles, dtype=ends.dtype) + place) * (ends[-1] / self.n_particles)
        ancestors = jnp.minimum(jnp.searchsorted(ends, places), self.n_particles - 1)
        states, again = jax.tree_util.tree_map(lambda x: x[..., ancestors], (belief.states, belief.log_weights))
        states = jax.tree_util.tree_map(lambda a, b: jnp.where(few, a, b), states, belief.states)
        log_weights = jnp.where(few, self.inherited(again), belief.log_weights)

        def step(state: State, w: list[Any]) -> State:
            return motion.step(state, inputs, dt, Vector.of(w))

        moved = jax.vmap(step, in_axes=-1, out_axes=-1)(states, w)
        if self.potential is not None:
            moves = jax.vmap(motion.view, in_axes=-1, out_axes=-1)
            said = jax.vmap(self.potential.log_weight, in_axes=-1, out_axes=-1)(moves(states), moves(moved))
            log_weights = jnp.maximum(log_weights + said, LOG_ZERO)
        return Particles(moved, log_weights, key)

    def init(self, belief: Gaussian, key: Any) -> Particles:
        drawn = super().init(belief, key)
        n, dtype = dimension(belief.mean), belief.cov[0].dtype
        _, _, w = draws(key, n, self.n_particles, dtype)
        L = cholesky(dict(zip(triangle(n), belief.cov, strict=True)), range(n), 16 * float(jnp.finfo(dtype).eps))
        steps = [total(L[i, j] * w[j] for j in range(i + 1)) for i in range(n)]
        states = jax.vmap(lambda step: retract(belief.mean, list(step)), in_axes=-1, out_axes=-1)(steps)
        return drawn._replace(states=states, log_weights=jax.lax.stop_gradient(drawn.log_weights))

    def inherited(self, ancestors: Any) -> Any:
        """The log-weights (N,) of offspring, of those of their ancestors: even, with the derivative that these have."""
        return self.even(ancestors) + (ancestors - jax.lax.stop_gradient(ancestors))

    def even(self, ancestors: Any) -> Any:
        """The same without derivative; a copy of a particle of weight zero has none."""
        return jnp.where(ancestors > 0.5 * LOG_ZERO, jnp.full_like(ancestors, -math.log(self.n_particles)), LOG_ZERO)


class Naive(Reparameterised):
    """The program differentiated as it stands: a choice of ancestors has no derivative, and equal weights none."""

    def inherited(self, ancestors: Any) -> Any:
        return self.even(ancestors)
