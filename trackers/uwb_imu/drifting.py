"""The motion of a tag among anchors whose ranges have drifting biases of their own."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector
from trackers.core.motion import AbstractMotion, Noise
from trackers.core.tunable import Scale


class Ranged(NamedTuple):
    """Position, m, velocity, m/s, and the present bias of each anchor's ranges, m."""

    position: Vector
    velocity: Vector
    bias: Vector


class DriftingBiases(AbstractMotion):
    """Velocities that die away, over the floor alone or with the height, and a bias per anchor that drifts.

    `sigma_a`, `sigma_z`: m/s² per √Hz, horizontal and vertical. `memory` s: how long a velocity lasts when nothing is
    heard. `sigma_bias` m: the biases' spread; `time_constant` s: how long they last. Both are first-order Gauss–Markov,
    exact for any interval (Gelb 1974, section 3.8): two steps in a row are one long step. A state without biases has
    none.
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
        self.sigma_a = Scale(sigma_a, "m/s^2/sqrt(Hz)")
        self.sigma_z = Scale(sigma_z, "m/s^2/sqrt(Hz)")
        self.memory = Scale(memory, "s")
        self.sigma_bias = Scale(sigma_bias, "m")
        self.time_constant = Scale(time_constant, "s")

    @property
    def noise_dimension(self) -> int:
        return 6 + self.biases

    def step(self, state: Ranged, inputs: Any, dt: Scalar, w: Vector) -> Ranged:
        n = len(state.position)
        sigmas = [self.sigma_a.value, self.sigma_a.value, self.sigma_z.value][:n]
        kept, reach, kick, along, across = damped(dt, self.memory.value)
        axes = list(zip(state.position, state.velocity, sigmas, w.parts[:3], w.parts[3:6], strict=False))
        position = Vector(*(x + v * reach + s * (a * along + b * across) for x, v, s, a, b in axes))
        velocity = Vector(*(v * kept + s * a * kick for _, v, s, a, _ in axes))
        lasting = jnp.exp(-dt / self.time_constant.value)
        fresh = self.sigma_bias.value * root(-jnp.expm1(-2.0 * dt / self.time_constant.value))
        return Ranged(position, velocity, state.bias * lasting + Vector(*w.parts[6:]) * fresh)

    def view(self, state: Ranged) -> Ranged:
        return state


def damped(dt: Scalar, memory: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar]:
    """What is kept of a velocity after `dt` s, how far it reaches (s), and the noise of unit density on both.

    dv = −v/τ dt + dW, dx = v dt: v gets `kick`·a, x gets `along`·a + `across`·b of two unit numbers a and b. With
    u = dt/τ the variance of x that isn't v's is τ³(u − 2 tanh(u/2)), by its power series where u is small.
    """
    u = dt / memory
    gone = -jnp.expm1(-u)
    kept = 1.0 - gone
    kick = root(0.5 * memory * gone * (1.0 + kept))
    along = memory * gone * root(0.5 * memory * gone / (1.0 + kept))
    small = u < 0.5
    near = jnp.where(small, u, 0.0)
    series = near**3 * (1.0 / 12.0 - near**2 * (1.0 / 120.0 - near**2 * (17.0 / 20160.0 - near**2 * 31.0 / 362880.0)))
    rest = jnp.where(small, series, u - 2.0 * jnp.tanh(0.5 * u))
    return kept, memory * gone, kick, along, memory * root(memory * rest)


def root(x: Scalar) -> Scalar:
    """The square root, whose derivative at zero is zero: where no time passes nothing is to be differentiated."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)
