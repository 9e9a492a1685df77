"""Singer's motion model: first-order Gauss–Markov acceleration (Singer 1970), for manoeuvring targets.

    x = dt/τ    h = x/2    E = e⁻ˣ    t = tanh h    k = σ√(2x)

The acceleration has standard deviation σ and time constant τ. Transition:

    a⁺ = E a    v⁺ = v + dt φ₁ a    p⁺ = p + dt v + dt² φ₂ a    φ₁ = (1 − E)/x    φ₂ = (x − 1 + E)/x²

For short steps the textbook form of the noise covariance subtracts nearly equal numbers. Its lower Cholesky factor in
the order a, v, p has the rows

    a: k √T/(1 + t)        v: k dt (½ T√T/(1 + t), ½ √A)        p: k dt² (¼ D/(√T (1 + t)), ¼ √A, ¼ √B)
    T = t/h    A = (h − t)/h³    B = (1 + h²/3 − h/t)/h⁴    D = (T − 1 + t²)/h²

with T, A, B, D smooth at h = 0; tests/trackers/parts/test_singer.py compares it with the matrix exponential.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Accelerated, Noise, as_scale, process_noise


class SingerTerms(NamedTuple):
    """The smooth functions of h = dt/2τ in transition and noise factor; symbols as in the module's docstring."""

    E: Scalar
    t: Scalar
    T: Scalar
    A: Scalar
    B: Scalar
    D: Scalar


class Singer(AbstractMotion):
    """First-order Gauss–Markov acceleration, discretised exactly (Singer 1970): two steps equal one long step.

    `sigma_a`: standard deviation of the acceleration, m/s². `tau`: its time constant, s; short makes the velocity a
    random walk, long suits sustained manoeuvres.
    """

    sigma_a: Noise
    tau: Noise
    dimensions: int = eqx.field(static=True)

    def __init__(self, sigma_a: float | Noise, tau: float | Noise, dimensions: int):
        self.sigma_a = process_noise(sigma_a, "m/s^2", "all")
        self.tau = as_scale(tau, "s")
        self.dimensions = dimensions

    @property
    def noise_dimension(self) -> int:
        return 3 * self.dimensions

    def step(self, state: Accelerated, inputs: Inputs, dt: Scalar, w: Vector) -> Accelerated:
        n = self.dimensions
        first, second, third = (Vector(*w.parts[k * n : (k + 1) * n]) for k in range(3))
        h = 0.5 * dt / self.tau.value
        E, t, T, A, B, D = singer_terms(h)
        # sqrt(dt) is a separate factor: it has no derivative at zero, and none is taken with respect to dt.
        k = self.sigma_a.value * jnp.sqrt(2.0 / self.tau.value) * jnp.sqrt(dt)
        first_kick = first * (k * jnp.sqrt(T) / (1.0 + t))
        second_kick = second * (0.5 * k * dt * jnp.sqrt(A))
        a = state.acceleration
        velocity = state.velocity + a * (dt * T / (1.0 + t)) + first_kick * (0.5 * dt * T) + second_kick
        position = (
            state.position
            + state.velocity * dt
            + a * (0.5 * dt * dt * (h * A + T) / (1.0 + t))
            + first_kick * (0.25 * dt * dt * D / T)
            + second_kick * (0.5 * dt)
            + third * (0.25 * k * dt * dt * jnp.sqrt(B))
        )
        return Accelerated(position, velocity, a * E + first_kick)


def singer_terms(h: Scalar) -> SingerTerms:
    """The terms of a step at h ≥ 0; they and their derivatives are accurate to a few units of rounding."""
    short = h < 1.5
    # Each branch gets arguments within its range, so that no NaN of the other enters the derivative.
    small, large = jnp.where(short, h, 0.0), jnp.where(short, 1.5, h)
    # Lambert's continued fraction tanh h = h/(1 + h²/(3 + h²/(5 + …))): all terms are positive, nothing cancels.
    square = small * small
    c5 = 21.0 + square / 23.0
    for odd in range(19, 4, -2):
        c5 = odd + square / c5
    c3 = 3.0 + square / c5
    T, A, B = c3 / (c3 + square), 1.0 / (c3 + square), 1.0 / (3.0 * c3 * c5)
    near = T, A, B, T * T - A
    t = jnp.tanh(large)
    E = jnp.exp(-2.0 * large)
    inverse = 1.0 / large
    T = t * inverse
    A = (1.0 - T) * inverse * inverse
    B = (inverse * inverse + 1.0 / 3.0 - inverse / t) * inverse * inverse
    far = T, A, B, (T - 4.0 * E / ((1.0 + E) * (1.0 + E))) * inverse * inverse
    T, A, B, D = (jnp.where(short, a, b) for a, b in zip(near, far, strict=True))
    return SingerTerms(jnp.exp(-2.0 * h), T * h, T, A, B, D)
