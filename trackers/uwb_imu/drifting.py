"""The motion of a tag among anchors whose ranges have drifting biases of their own."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector
from trackers.core.motion import AbstractMotion, ConstantVelocity, Kinematic, Noise
from trackers.core.tunable import Scale


class Ranged(NamedTuple):
    """Position, m, velocity, m/s, and the present bias of each anchor's ranges, m."""

    position: Vector
    velocity: Vector
    bias: Vector


class DriftingBiases(AbstractMotion):
    """Constant velocity, over the floor alone or with the height, and a first-order Gauss–Markov bias per anchor.

    `sigma_a`, `sigma_z`: m/s² per √Hz, horizontal and vertical. `sigma_bias` m: the biases' spread; `time_constant` s:
    how long they last (Gelb 1974, section 3.8: exact for any interval). A state without biases has none.
    """

    sigma_a: Noise
    sigma_z: Noise
    sigma_bias: Noise
    time_constant: Noise
    biases: int = eqx.field(static=True)

    def __init__(self, biases: int, sigma_a: float, sigma_z: float, sigma_bias: float, time_constant: float):
        self.biases = biases
        self.sigma_a = Scale(sigma_a, "m/s^2/sqrt(Hz)")
        self.sigma_z = Scale(sigma_z, "m/s^2/sqrt(Hz)")
        self.sigma_bias = Scale(sigma_bias, "m")
        self.time_constant = Scale(time_constant, "s")

    @property
    def noise_dimension(self) -> int:
        return 6 + self.biases

    def step(self, state: Ranged, inputs: Any, dt: Scalar, w: Vector) -> Ranged:
        floor = Kinematic(Vector(*state.position.parts[:2]), Vector(*state.velocity.parts[:2]))
        floor = ConstantVelocity(self.sigma_a, 2).step(floor, inputs, dt, Vector(*w.parts[:4]))
        position, velocity = floor
        if len(state.position) == 3:
            height = Kinematic(Vector(state.position[2]), Vector(state.velocity[2]))
            height = ConstantVelocity(self.sigma_z, 1).step(height, inputs, dt, Vector(*w.parts[4:6]))
            position, velocity = Vector(*position, *height.position), Vector(*velocity, *height.velocity)
        kept = jnp.exp(-dt / self.time_constant.value)
        # The root has no derivative at zero, where no time passes and nothing is to be differentiated.
        lost = -jnp.expm1(-2.0 * dt / self.time_constant.value)
        fresh = jnp.where(lost > 0, self.sigma_bias.value * jnp.sqrt(jnp.where(lost > 0, lost, 1.0)), 0.0)
        return Ranged(position, velocity, state.bias * kept + Vector(*w.parts[6:]) * fresh)

    def view(self, state: Ranged) -> Ranged:
        return state
