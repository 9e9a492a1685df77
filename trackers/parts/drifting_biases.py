"""Motion of a tag with damped velocity, and sensor biases that drift with time and with the way covered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal, total
from trackwright.trackers.core.model.covariance import Gaussian, variance
from trackwright.trackers.core.model.inputs import HEIGHT_LIMITS, Input, Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Noise, as_scale
from trackwright.trackers.core.model.rig import mirrored
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.parts.start_nearby import NEARBY, AbstractNearbyStart


class BiasedState(NamedTuple):
    """Position, m, velocity, m/s, and biases in the sensor's unit: one per channel, and one shared by all channels.

    `shared` has one entry or none.
    """

    position: Vector
    velocity: Vector
    bias: Vector
    shared: Vector = Vector()


class DriftingBiases(AbstractMotion):
    """First-order Gauss–Markov velocities, planar or in three dimensions, and first-order Gauss–Markov biases.

    `sigma_a`, `sigma_z`: white acceleration, horizontal and vertical, m/s² per √Hz; `memory`: time constant of the
    velocities, s. `sigma_bias`: standard deviation of the biases: one number for all, or k that they take in turn, as
    of azimuth and elevation. A shared bias is constant, the others decay at the rate 1/`time_constant` +
    speed/`length`, s and m: multipath and obstruction depend on the place. `biases`: their number. Exact at constant
    speed (Gelb 1974, section 3.8): there two steps equal one long step. Heights are mirrored at the input
    `height_limits`.
    """

    sigma_a: Noise
    sigma_z: Noise
    memory: Noise
    sigma_bias: Noise
    time_constant: Noise
    length: Noise
    biases: int = eqx.field(static=True)
    speed: Any

    def __init__(
        self,
        biases: int,
        sigma_a: float,
        sigma_z: float,
        memory: float,
        sigma_bias: float | np.ndarray,
        time_constant: float,
        length: float,
        unit: str = "m",
    ):
        """`unit`: of the biases."""
        self.biases = biases
        self.speed = None
        self.sigma_a = Scale(sigma_a, "m/s^2/sqrt(Hz)", "process noise", "horizontal")
        self.sigma_z = Scale(sigma_z, "m/s^2/sqrt(Hz)", "process noise", "vertical")
        self.memory = Scale(memory, "s")
        self.sigma_bias = Scale(sigma_bias, unit, "bias noise")
        self.time_constant = Scale(time_constant, "s")
        self.length = Scale(length, "m")

    @property
    def noise_dimension(self) -> int:
        return 6 + self.biases

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (HEIGHT_LIMITS,)

    def at(self, belief: Gaussian) -> DriftingBiases:
        """The motion whose biases decay with the speed of this belief, shrunk by its uncertainty.

        The speed is |v|·(1 − tr P/|v|²)₊ (James and Stein 1961). If the decay were linearised at low speed, where the
        direction of the velocity is noise, it would act as a measurement of velocity.
        """
        return eqx.tree_at(lambda motion: motion.speed, self, shrunk_speed(belief), is_leaf=lambda x: x is None)

    def step(self, state: BiasedState, inputs: Inputs, dt: Scalar, w: Vector) -> BiasedState:
        if len(state.position) == 3 and HEIGHT_LIMITS.name in inputs:
            (x, y, z), (vx, vy, vz) = state.position, state.velocity
            inside = mirrored(z, inputs[HEIGHT_LIMITS.name])
            climb = jnp.where(inside == z, vz, -vz)
            state = state._replace(position=Vector(x, y, inside), velocity=Vector(vx, vy, climb))
        position, velocity = damped(self, state, dt, w)
        if not self.biases:
            return BiasedState(position, velocity, state.bias, state.shared)
        speed = norm_of(state.velocity) if self.speed is None else self.speed
        return BiasedState(position, velocity, drifted(self, state.bias, dt, speed, w.parts[6:]), state.shared)


class BiasDrift(eqx.Module):
    """The drift of the biases of `DriftingBiases`, for another motion; `at` as there, biases in m.

    `sigma_bias`: standard deviation of the biases, which decay at the rate 1/`time_constant` + speed/`length`, s and m.
    `biases`: their number, where the motion does not tell it.
    """

    sigma_bias: Noise
    time_constant: Noise
    length: Noise
    biases: int = eqx.field(static=True)
    speed: Any

    def __init__(self, sigma_bias: float | Noise, time_constant: float | Noise, length: float | Noise, biases: int = 0):
        self.sigma_bias = as_scale(sigma_bias, "m", "bias noise")
        self.time_constant, self.length = as_scale(time_constant, "s"), as_scale(length, "m")
        self.biases, self.speed = biases, None

    def at(self, belief: Gaussian) -> BiasDrift:
        return eqx.tree_at(lambda drift: drift.speed, self, shrunk_speed(belief), is_leaf=lambda x: x is None)

    def drifted(self, state: Any, dt: Scalar, w: Sequence[Scalar]) -> Vector:
        """The biases of a state with velocity `dt` s later, given a draw for each."""
        speed = norm_of(state.velocity) if self.speed is None else self.speed
        return drifted(self, state.bias, dt, speed, w)


class BiasedStart(AbstractNearbyStart):
    """A start at the position in the input `nearby` (4,), at rest, with zero biases.

    `sigma_position` m, `sigma_velocity` m/s, `sigma_bias` as in `DriftingBiases`, `sigma_shared` in its unit: standard
    deviations. `biases`: their number. Without `sigma_shared` there is no shared bias.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    sigma_bias: Noise
    planar: bool = eqx.field(static=True)
    biases: int = eqx.field(static=True)
    sigma_shared: Noise | None = None

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        zero, nearby = candidate[0] * 0.0, row.inputs[NEARBY.name]
        # The candidate, which may be another place, carries no derivative.
        position = Vector(*(candidate[k] + (nearby[k] - jax.lax.stop_gradient(nearby[k])) for k in range(n)))
        shared = [] if self.sigma_shared is None else [self.sigma_shared.value**2]
        state = BiasedState(position, Vector(*[zero] * n), Vector(*[zero] * self.biases), Vector(*[zero] * len(shared)))
        in_place, moving = self.sigma_position.value**2, self.sigma_velocity.value**2
        biases = [in_turn(self.sigma_bias.value, k) ** 2 for k in range(self.biases)]
        return Gaussian(state, diagonal([in_place] * n + [moving] * n + biases + shared, zero))


def shrunk_speed(belief: Gaussian) -> Scalar:
    """The speed of a belief about position, velocity and more, shrunk by its uncertainty: see `DriftingBiases.at`."""
    state, cov = belief
    first = component_names(state).index("velocity.0")
    square = total(v * v for v in state.velocity)
    spread = total(variance(cov, first + k) for k in range(len(state.velocity)))
    moves = square > spread
    return jnp.where(moves, (square - spread) / jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)


def damped(levels: Any, state: Any, dt: Scalar, w: Vector) -> tuple[Vector, Vector]:
    """Position and velocity `dt` s later, given the first six draws; `levels`: as in `DriftingBiases`."""
    n = len(state.position)
    sigmas = [levels.sigma_a.value, levels.sigma_a.value, levels.sigma_z.value][:n]
    decay, gain, velocity_noise, shared, separate = damped_velocity(dt, levels.memory.value)
    axes = list(zip(state.position, state.velocity, sigmas, w.parts[:3], w.parts[3:6], strict=False))
    position = Vector(*(x + v * gain + s * (a * shared + b * separate) for x, v, s, a, b in axes))
    velocity = Vector(*(v * decay + s * a * velocity_noise for _, v, s, a, _ in axes))
    return position, velocity


def drifted(levels: Any, bias: Vector, dt: Scalar, speed: Scalar, w: Sequence[Scalar]) -> Vector:
    """Biases `dt` s later, given a draw for each; `levels`: as in `DriftingBiases`."""
    lapse = dt * (1.0 / levels.time_constant.value + speed / levels.length.value)
    bias_decay, bias_noise = jnp.exp(-lapse), safe_sqrt(-jnp.expm1(-2.0 * lapse))
    draws = (x * (in_turn(levels.sigma_bias.value, k) * bias_noise) for k, x in enumerate(w))
    return bias * bias_decay + Vector(*draws)


def norm_of(velocity: Vector) -> Scalar:
    """The speed, with derivative zero at rest."""
    return safe_sqrt(total(v * v for v in velocity))


def in_turn(values: Any, number: int) -> Any:
    """The value for the bias of this number: the only one, or one of k that the biases take in turn."""
    return values if np.ndim(values) == 0 else values[number % len(values)]


def damped_velocity(dt: Scalar, memory: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar, Scalar]:
    """Transition and noise factor of dv = −v/τ dt + dW, dx = v dt over `dt` s, with τ = `memory` s.

    v⁺ = decay·v + velocity_noise·a, x⁺ = x + gain·v + shared·a + separate·b, with unit noise a and b. With u = dt/τ,
    the conditional variance of x given v is τ³(u − 2 tanh(u/2)), by its power series where u is small.
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
