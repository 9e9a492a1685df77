"""Kalman filter driven by the acceleration estimate of a hidden Markov model (Huang et al. 2018, section 3).

    o  displacement between two fixes less the previous velocity's              o = ½ a Δt² + noise
    a  posterior mean of the acceleration given o, applied during the next interval of the same length
    π  stationary distribution of the chain's N states           κ = exp(−rate·dt)  probability of keeping the state

The paper does not define the acceleration in the prediction (9). The chain as printed has no memory and predicts a mean
of zero; here the acceleration of the last displacement applies for one more interval.

The chain keeps its state or draws a new one, A = κ I + (1 − κ) 1πᵀ, so that a step takes O(N). In the paper κ = 0: all
rows of A are the distribution of accelerations, the filtered distribution depends on the last observation alone, and
its prediction is π, with mean zero. With κ > 0 an acceleration lasts 1/rate seconds on average, whatever the sampling
interval.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractFilter, Innovation
from trackwright.trackers.core.model.algebra import Scalar, Vector, product
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian
from trackwright.trackers.core.model.inputs import Inputs, RawKey
from trackwright.trackers.core.model.motion import AbstractMotion, Kinematic, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.mhk.accelerations import AccelerationSphere, mean_acceleration


class MhkBelief(NamedTuple):
    """The belief of `AccelerationFilter`: of the Kalman filter and of the chain, and the current acceleration.

    `weights`: (N,), empty for a chain without memory. `last_fix` m and `last_velocity` m/s: at the last fix, `elapsed`
    s ago. `acceleration` m/s²: applied for another `remaining` s.
    """

    kalman: Gaussian
    weights: jax.Array
    last_fix: Vector
    last_velocity: Vector
    elapsed: Scalar
    acceleration: Vector
    remaining: Scalar


class AccelerationFilter(AbstractFilter[MhkBelief]):
    """The Kalman filter (9)–(20), its prediction driven by the acceleration estimate of the hidden Markov model.

    `sigma_displacement`: noise of a displacement, m. `rate`: draws of a new acceleration, 1/s; None for a draw at every
    fix, as printed. The state is `Kinematic` in three dimensions; the sensor measures the position.
    """

    sphere: AccelerationSphere
    sigma_displacement: Noise
    rate: Noise | None
    filter: ExtendedKalman

    def __init__(self, sphere: AccelerationSphere, sigma_displacement: float, rate: float | None):
        self.sphere, self.filter = sphere, ExtendedKalman()
        self.sigma_displacement = Scale(sigma_displacement, "m", "measurement noise")
        self.rate = None if rate is None else Scale(rate, "1/s")

    def init(self, belief: Gaussian, key: RawKey) -> MhkBelief:
        """The given belief, no acceleration, and the chain at its stationary distribution."""
        zero = jnp.zeros_like(belief.cov[0])
        stationary = self.sphere.blocks().probabilities.astype(zero.dtype)
        weights = stationary[:0] if self.rate is None else stationary
        mean = belief.mean
        return MhkBelief(belief, weights, mean.position, mean.velocity, zero, Vector(zero, zero, zero), zero)

    def moments(self, belief: MhkBelief) -> tuple[Kinematic, AnyCovariance]:
        """Mean and covariance of position and velocity."""
        return self.filter.moments(belief.kalman)

    def predict(self, belief: MhkBelief, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> MhkBelief:
        """Equations (8)–(13): constant velocity, plus the acceleration while it applies."""
        after = self.filter.predict(belief.kalman, motion, inputs, dt)
        accelerated = jnp.minimum(dt, belief.remaining)
        a = belief.acceleration
        position = after.mean.position + a * (accelerated * dt - 0.5 * accelerated * accelerated)
        mean = after.mean._replace(position=position, velocity=after.mean.velocity + a * accelerated)
        weights = belief.weights
        if self.rate is not None:
            weights = chain_predicted(weights, self.sphere.blocks().probabilities, jnp.exp(-self.rate.value * dt))
        return belief._replace(
            kalman=Gaussian(mean, after.cov),
            weights=weights,
            elapsed=belief.elapsed + dt,
            remaining=belief.remaining - accelerated,
        )

    def update(
        self, belief: MhkBelief, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[MhkBelief, Innovation]:
        """Equations (14)–(20), and the posterior mean of the acceleration for the next prediction."""
        kalman, innovation = self.filter.update(belief.kalman, motion, sensor, reading, inputs)
        fix = Vector(*(reading.values[k] for k in range(3)))
        seen = reading.seen[0] & reading.seen[1] & reading.seen[2]
        displacement = fix - belief.last_fix - belief.last_velocity * belief.elapsed
        weights, acceleration = self.posterior(belief.weights, displacement, belief.elapsed)

        def if_seen(new: Any, old: Any) -> Any:
            return jnp.where(seen, new, old)

        def vector_if_seen(new: Vector, old: Vector) -> Vector:
            return Vector.of(if_seen(n, o) for n, o in zip(new, old, strict=True))

        after = MhkBelief(
            kalman,
            if_seen(weights, belief.weights),
            vector_if_seen(fix, belief.last_fix),
            vector_if_seen(kalman.mean.velocity, belief.last_velocity),
            if_seen(jnp.zeros_like(belief.elapsed), belief.elapsed),
            vector_if_seen(acceleration, belief.acceleration),
            if_seen(belief.elapsed, belief.remaining),
        )
        return after, innovation

    def posterior(self, weights: jax.Array, displacement: Vector, elapsed: Scalar) -> tuple[jax.Array, Vector]:
        """The chain's filtered probabilities (N,) and mean acceleration, m/s², given a displacement, m, in `elapsed` s.

        `displacement`: less what constant velocity covers.
        """
        half_square = 0.5 * elapsed * elapsed
        precision = 1.0 / self.sigma_displacement.value**2
        if self.rate is None:
            return weights, mean_acceleration(self.sphere.rings(), displacement, half_square, precision)
        blocks = self.sphere.blocks()
        # −½ |o − ½Δt²·a|² / σ² without the term common to all states.
        accelerations = blocks.accelerations
        along = product(accelerations, displacement.array())
        squares = jnp.sum(accelerations * accelerations, axis=1)
        log_likelihoods = precision * half_square * (along - 0.5 * half_square * squares)
        after, _ = chain_updated(weights, log_likelihoods)
        mean = product(after, accelerations)
        return after, Vector(mean[0], mean[1], mean[2])


def chain_predicted(weights: jax.Array, stationary: jax.Array, kappa: Scalar) -> jax.Array:
    """The predicted state probabilities wᵀA, (N,), from the filtered ones and the stationary distribution."""
    return kappa * weights + (1.0 - kappa) * (jnp.sum(weights) * stationary)


def chain_updated(weights: jax.Array, log_likelihoods: jax.Array) -> tuple[jax.Array, Scalar]:
    """The filtered state probabilities (N,) given the states' log-likelihoods (N,), and the log-evidence."""
    top = jax.lax.stop_gradient(jnp.max(log_likelihoods))
    joint = weights * jnp.exp(log_likelihoods - top)
    # Before a track starts all weights are zero; a quotient by the smallest number would have no derivative there.
    evidence = jnp.sum(joint)
    evidence = jnp.where(evidence > 0, evidence, 1.0)
    return joint / evidence, top + jnp.log(evidence)
