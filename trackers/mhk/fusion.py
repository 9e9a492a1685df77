"""Kalman fusion of medians with the acceleration that a hidden Markov model sees in them: Huang et al. 2018, section 3.

    o  displacement from one fix to the next, beyond that of the velocity before        o = ½ a Δt² + noise
    a  posterior mean of the acceleration given o, in force for the next interval of that length

The paper doesn't say which acceleration enters the prediction (9). Its chain has no memory, so that its own prediction
is zero; what is left is the acceleration of the last displacement, taken to last one interval more.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector
from trackers.core.ekf import ExtendedKalman, Gaussian, Innovation
from trackers.core.motion import AbstractMotion, Kinematic, Noise
from trackers.core.sensor import AbstractSensor, Reading
from trackers.core.tunable import Scale
from trackers.mhk.accelerations import AccelerationSphere
from trackers.mhk.chain import heard, moved


class Accelerating(NamedTuple):
    """A belief: position and velocity, the chain, the last fix, the velocity and the seconds since, and a and its rest.

    `weights`: (N,), empty for a chain without memory. `acceleration` holds for `rest` s to come.
    """

    kalman: Gaussian
    weights: Any
    last: Vector
    velocity: Vector
    elapsed: Scalar
    acceleration: Vector
    rest: Scalar


class AccelerationFilter(eqx.Module):
    """The Kalman filter (9)–(20) whose prediction takes the acceleration of the hidden Markov model.

    `sigma_displacement`: m, noise of a displacement. `rate`: 1/s, how often the acceleration is drawn anew; None for
    at every fix, as printed. Its state is `Kinematic` in three dimensions, its sensor shows the position.
    """

    sphere: AccelerationSphere
    sigma_displacement: Noise
    rate: Noise | None
    filter: ExtendedKalman

    def __init__(self, sphere: AccelerationSphere, sigma_displacement: float, rate: float | None):
        self.sphere, self.filter = sphere, ExtendedKalman()
        self.sigma_displacement = Scale(sigma_displacement, "m")
        self.rate = None if rate is None else Scale(rate, "1/s")

    def init(self, belief: Gaussian, key: Any) -> Accelerating:
        """No acceleration yet, and the chain at its shares."""
        zero = jnp.zeros_like(belief.cov[0])
        shares = self.sphere.blocks().shares.astype(zero.dtype)
        weights = shares[:0] if self.rate is None else shares
        mean = belief.mean
        return Accelerating(belief, weights, mean.position, mean.velocity, zero, Vector(zero, zero, zero), zero)

    def moments(self, belief: Accelerating) -> tuple[Kinematic, tuple[Scalar, ...]]:
        """Position and velocity with their covariance."""
        return self.filter.moments(belief.kalman)

    def predict(self, belief: Accelerating, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Accelerating:
        """Equations (8)–(13): the velocity's way, and what the acceleration adds as long as it holds."""
        after = self.filter.predict(belief.kalman, motion, inputs, dt)
        part = jnp.minimum(dt, belief.rest)
        a = belief.acceleration
        position = after.mean.position + a * (part * dt - 0.5 * part * part)
        mean = Kinematic(position, after.mean.velocity + a * part)
        weights = belief.weights
        if self.rate is not None:
            weights = moved(weights, self.sphere.blocks().shares, jnp.exp(-self.rate.value * dt))
        return belief._replace(
            kalman=Gaussian(mean, after.cov), weights=weights, elapsed=belief.elapsed + dt, rest=belief.rest - part
        )

    def update(
        self, belief: Accelerating, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Accelerating, Innovation]:
        """Equations (14)–(20), and the chain's posterior mean for the next prediction."""
        kalman, said = self.filter.update(belief.kalman, motion, sensor, reading, inputs)
        fix = Vector(*(reading.values[k] for k in range(3)))
        seen = reading.seen[0] & reading.seen[1] & reading.seen[2]
        beyond = fix - belief.last - belief.velocity * belief.elapsed
        weights, acceleration = self.posterior(belief.weights, beyond, belief.elapsed)

        def chosen(new: Any, old: Any) -> Any:
            return jnp.where(seen, new, old)

        velocity = kalman.mean.velocity
        after = Accelerating(
            kalman,
            chosen(weights, belief.weights),
            Vector.of(chosen(n, o) for n, o in zip(fix, belief.last, strict=True)),
            Vector.of(chosen(n, o) for n, o in zip(velocity, belief.velocity, strict=True)),
            chosen(jnp.zeros_like(belief.elapsed), belief.elapsed),
            Vector.of(chosen(n, o) for n, o in zip(acceleration, belief.acceleration, strict=True)),
            chosen(belief.elapsed, belief.rest),
        )
        return after, said

    def posterior(self, weights: Any, beyond: Vector, elapsed: Scalar) -> tuple[Any, Vector]:
        """The chain's probabilities given a displacement beyond the velocity's, m, in `elapsed` s, and their mean."""
        blocks = self.sphere.blocks()
        reach = 0.5 * elapsed * elapsed
        scale = 1.0 / self.sigma_displacement.value**2
        # −½ |o − reach·a|² / σ² less the term that is the same for all states.
        accelerations = blocks.accelerations
        along = accelerations @ beyond.array()
        squares = jnp.sum(accelerations * accelerations, axis=1)
        log_likelihoods = scale * reach * (along - 0.5 * reach * squares)
        prior = blocks.shares if self.rate is None else weights
        after, _ = heard(prior, log_likelihoods)
        mean = after @ accelerations
        return (weights if self.rate is None else after), Vector(mean[0], mean[1], mean[2])
