"""Motion of a tag with damped velocity, and a Gauss–Markov range bias per anchor."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector
from trackers.core.inputs import Inputs
from trackers.core.motion import AbstractMotion, Noise
from trackers.core.tunable import Scale


class RangeState(NamedTuple):
    """Position, m, velocity, m/s, and the range bias of each anchor, m."""

    position: Vector
    velocity: Vector
    bias: Vector


class RangeMotion(AbstractMotion):
    """First-order Gauss–Markov velocities, planar or in three dimensions, and first-order Gauss–Markov range biases.

    `sigma_a`, `sigma_z`: white acceleration, horizontal and vertical, m/s² per √Hz; `memory`: time constant of the
    velocities, s. `sigma_bias`: standard deviation of the biases, m; `time_constant`: theirs, s. `biases`: their
    number. Discretised exactly (Gelb 1974, section 3.8): two steps equal one long step.
    """

    sigma_a: Noise
    sigma_z: Noise
    memory: Noise
    sigma_bias: Noise
    time_constant: Noise
    biases: int = eqx.field(static=True)

    def __init__(
        self, biases: int, sigma_a: float, sigma_z: float, memory: float, sigma_bias: float, time_constant: float
    ):
        self.biases = biases
        self.sigma_a = Scale(sigma_a, "m/s^2/sqrt(Hz)", "process noise", "horizontal")
        self.sigma_z = Scale(sigma_z, "m/s^2/sqrt(Hz)", "process noise", "vertical")
        self.memory = Scale(memory, "s")
        self.sigma_bias = Scale(sigma_bias, "m", "bias noise")
        self.time_constant = Scale(time_constant, "s")

    @property
    def noise_dimension(self) -> int:
        return 6 + self.biases

    def step(self, state: RangeState, inputs: Inputs, dt: Scalar, w: Vector) -> RangeState:
        n = len(state.position)
        sigmas = [self.sigma_a.value, self.sigma_a.value, self.sigma_z.value][:n]
        decay, gain, velocity_noise, shared, own = damped_velocity(dt, self.memory.value)
        axes = list(zip(state.position, state.velocity, sigmas, w.parts[:3], w.parts[3:6], strict=False))
        position = Vector(*(x + v * gain + s * (a * shared + b * own) for x, v, s, a, b in axes))
        velocity = Vector(*(v * decay + s * a * velocity_noise for _, v, s, a, _ in axes))
        bias_decay = jnp.exp(-dt / self.time_constant.value)
        bias_noise = self.sigma_bias.value * safe_sqrt(-jnp.expm1(-2.0 * dt / self.time_constant.value))
        return RangeState(position, velocity, state.bias * bias_decay + Vector(*w.parts[6:]) * bias_noise)


def damped_velocity(dt: Scalar, memory: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Transition and noise factor of dv = −v/τ dt + dW, dx = v dt over `dt` s, with τ = `memory` s.

    v⁺ = decay·v + velocity_noise·a, x⁺ = x + gain·v + shared·a + own·b, with unit noise a and b. With u = dt/τ, the
    conditional variance of x given v is τ³(u − 2 tanh(u/2)), by its power series where u is small.
    """
    u = dt / memory
    loss = -jnp.expm1(-u)
    decay = 1.0 - loss
    velocity_noise = safe_sqrt(0.5 * memory * loss * (1.0 + decay))
    shared = memory * loss * safe_sqrt(0.5 * memory * loss / (1.0 + decay))
    small = u < 0.5
    near = jnp.where(small, u, 0.0)
    series = near**3 * (1.0 / 12.0 - near**2 * (1.0 / 120.0 - near**2 * (17.0 / 20160.0 - near**2 * 31.0 / 362880.0)))
    conditional = jnp.where(small, series, u - 2.0 * jnp.tanh(0.5 * u))
    return decay, memory * loss, velocity_noise, shared, memory * safe_sqrt(memory * conditional)


def safe_sqrt(x: Scalar) -> Scalar:
    """The square root with derivative zero at zero, for steps with dt = 0."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)
