"""Strapdown mechanisation: an IMU's readings move the state, its noise and biases are what the filter is unsure of.

An IMU sample is an input of its row, not a reading: `accel` (3,) m/s², specific force in body axes (+g upwards at
rest); `gyro` (3,) rad/s in body axes; `imu` (2,), above ½ where there is an accelerometer, and a gyro, to believe. The
state has a curved leaf for the attitude, so the ordinary extended Kalman filter on it is the error-state filter.

    p⁺ = p + v dt + ½ a dt²    v⁺ = v + a dt    a = R (f − b_a) + g    R⁺ = R exp((ω − b_g) dt)

Without an accelerometer the acceleration is white, without a gyro the attitude walks at random.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient

from trackers.core.algebra import Scalar, Vector
from trackers.core.motion import AbstractMotion, Noise
from trackers.core.state import Heading, Rotation
from trackers.core.tunable import Real, Scale


class PlanarInertial(NamedTuple):
    """The eight states of Kwon et al. 2021, equations (18)–(20): over the floor, the body level.

    Position m and velocity m/s (room axes), accelerometer bias m/s² (body x, y), yaw rad, gyro bias rad/s; beyond the
    paper's, a bias of each anchor's ranges, m, none by default.
    """

    position: Vector
    velocity: Vector
    accel_bias: Vector
    attitude: Heading
    gyro_bias: Scalar
    bias: Vector = Vector()


class Inertial(NamedTuple):
    """Fifteen states: position m, velocity m/s (room), attitude body to room, biases m/s² and rad/s (body).

    The position may be that of a tag away from the IMU on the same body; the velocity is the IMU's. Beyond the
    fifteen, a bias of each anchor's ranges, m, none by default.
    """

    position: Vector
    velocity: Vector
    attitude: Rotation
    accel_bias: Vector
    gyro_bias: Vector
    bias: Vector = Vector()


class ImuNoise(eqx.Module):
    """What an IMU gets wrong, what stands for it where it says nothing, and how range biases wander.

    `sigma_accel` m/s² per √Hz, `sigma_gyro` rad/s per √Hz; `sigma_accel_walk` m/s² per √s and `sigma_gyro_walk` rad/s
    per √s, their biases' random walks; `sigma_a` m/s² per √Hz, the acceleration where no accelerometer tells it, and
    `sigma_turn` rad per √s, the turning where no gyro does; `sigma_range_walk` m per √s, of each anchor's range bias.
    """

    sigma_accel: Noise
    sigma_gyro: Noise
    sigma_accel_walk: Noise
    sigma_gyro_walk: Noise
    sigma_a: Noise
    sigma_turn: Noise
    sigma_range_walk: Noise

    def __init__(
        self,
        sigma_accel: float | Noise = 0.05,
        sigma_gyro: float | Noise = 0.005,
        sigma_accel_walk: float | Noise = 0.005,
        sigma_gyro_walk: float | Noise = 0.0005,
        sigma_a: float | Noise = 1.0,
        sigma_turn: float | Noise = 0.5,
        sigma_range_walk: float | Noise = 0.005,
    ):
        self.sigma_accel = _scale(sigma_accel, "m/s^2/sqrt(Hz)")
        self.sigma_gyro = _scale(sigma_gyro, "rad/s/sqrt(Hz)")
        self.sigma_accel_walk = _scale(sigma_accel_walk, "m/s^2/sqrt(s)")
        self.sigma_gyro_walk = _scale(sigma_gyro_walk, "rad/s/sqrt(s)")
        self.sigma_a = _scale(sigma_a, "m/s^2/sqrt(Hz)")
        self.sigma_turn = _scale(sigma_turn, "rad/sqrt(s)")
        self.sigma_range_walk = _scale(sigma_range_walk, "m/sqrt(s)")

    def range_kick(self, dt: Scalar) -> Scalar:
        """The standard deviation of a range bias's change over `dt`, m."""
        return self.sigma_range_walk.value * jnp.sqrt(dt)

    def kicks(self, inputs: Any, dt: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Standard deviations over `dt` of velocity m/s, attitude rad, accelerometer bias and gyro bias."""
        root = jnp.sqrt(dt)
        accel, gyro = present(inputs)
        return (
            jnp.where(accel, self.sigma_accel.value, self.sigma_a.value) * root,
            jnp.where(gyro, self.sigma_gyro.value, self.sigma_turn.value) * root,
            self.sigma_accel_walk.value * root,
            self.sigma_gyro_walk.value * root,
        )


class PlanarStrapdown(AbstractMotion):
    """The paper's planar mechanisation, room axes; `noise`: the IMU's; `biases`: for so many anchors, in the state.

    With `transport`, the velocity changes by the −ω × v of Kwon et al. 2021, equation (2), too. That term belongs to
    a velocity in turning axes; the paper adds it to one that it integrates to a position in the room, and so does this
    form, whose Jacobian is the paper's matrix (22) put right.
    """

    noise: ImuNoise
    transport: bool = eqx.field(static=True, default=False)
    biases: int = eqx.field(static=True, default=0)

    @property
    def noise_dimension(self) -> int:
        return 8 + self.biases

    def step(self, state: PlanarInertial, inputs: Any, dt: Scalar, w: Vector) -> PlanarInertial:
        return in_stages(self, state, inputs, dt, w)

    @property
    def stages(self) -> Any:
        return coasted, self.driven, coasted

    def driven(self, state: PlanarInertial, inputs: Any, dt: Scalar, w: Vector) -> PlanarInertial:
        """What the IMU's readings and the noise change."""
        saw_accel, saw_gyro = present(inputs)
        kick, turn, accel_walk, gyro_walk = self.noise.kicks(inputs, dt)
        rate = jnp.where(saw_gyro, inputs["gyro"][2] - state.gyro_bias, 0.0)
        x, y = (inputs["accel"][k] - state.accel_bias[k] for k in range(2))
        # In the middle of the step, or a turning body's acceleration points where it stood at the beginning.
        middle = state.attitude.angle + rate * (0.5 * dt)
        cosine, sine = jnp.cos(middle), jnp.sin(middle)
        felt = Vector(cosine * x - sine * y, sine * x + cosine * y)
        if self.transport:
            felt = felt + Vector(rate * state.velocity[1], -rate * state.velocity[0])
        acceleration = Vector.of(jnp.where(saw_accel, a, 0.0) for a in felt)
        position, velocity = pushed(state.position, state.velocity, acceleration, dt, kick, w)
        return PlanarInertial(
            position,
            velocity,
            state.accel_bias + Vector(*w.parts[4:6]) * accel_walk,
            Heading(state.attitude.angle + rate * dt + w[6] * turn),
            state.gyro_bias + w[7] * gyro_walk,
            state.bias + Vector(*w.parts[8:]) * self.noise.range_kick(dt),
        )

    def view(self, state: PlanarInertial) -> PlanarInertial:
        return state


class Strapdown(AbstractMotion):
    """The mechanisation in three dimensions, room axes with z up (Solà 2017, section 5.2); `noise`: the IMU's.

    `gravity` m/s²: what an ideal accelerometer at rest reads; an error of the real one is in its bias. An input `arm`
    (3,) m says where on the body, from the IMU, the tag is whose place the state's position is. `biases`: how many
    anchors have one in the state.
    """

    noise: ImuNoise
    gravity: Noise
    biases: int = eqx.field(static=True)

    def __init__(self, noise: ImuNoise, gravity: float | Noise = 9.81, biases: int = 0):
        self.noise = noise
        self.biases = biases
        self.gravity = gravity if isinstance(gravity, Noise) else Real(gravity, "m/s^2", typical=0.1)

    @property
    def noise_dimension(self) -> int:
        return 15 + self.biases

    def step(self, state: Inertial, inputs: Any, dt: Scalar, w: Vector) -> Inertial:
        return in_stages(self, state, inputs, dt, w)

    @property
    def stages(self) -> Any:
        return coasted, self.driven, coasted

    def driven(self, state: Inertial, inputs: Any, dt: Scalar, w: Vector) -> Inertial:
        """What the IMU's readings and the noise change."""
        saw_accel, saw_gyro = present(inputs)
        kick, turn, accel_walk, gyro_walk = self.noise.kicks(inputs, dt)
        rate = Vector.of(jnp.where(saw_gyro, inputs["gyro"][k] - state.gyro_bias[k], 0.0) for k in range(3))
        force = Vector.of(inputs["accel"][k] - state.accel_bias[k] for k in range(3))
        # Half a step's turn, to first order: what the body feels in the middle of the step, in its first axes.
        x, y, z = state.attitude.apply(force + rate.cross(force) * (0.5 * dt))
        acceleration = Vector.of(jnp.where(saw_accel, a, 0.0) for a in (x, y, z - self.gravity.value))
        position, velocity = pushed(state.position, state.velocity, acceleration, dt, kick, w)
        turned = kept_unit(state.attitude @ Rotation.exp(rate * dt + Vector(*w.parts[6:9]) * turn), dt)
        if "arm" in inputs:
            arm = Vector.of(inputs["arm"][k] for k in range(3))
            position = position + (turned.apply(arm) - state.attitude.apply(arm))
        return Inertial(
            position,
            velocity,
            turned,
            state.accel_bias + Vector(*w.parts[9:12]) * accel_walk,
            state.gyro_bias + Vector(*w.parts[12:15]) * gyro_walk,
            state.bias + Vector(*w.parts[15:]) * self.noise.range_kick(dt),
        )

    def view(self, state: Inertial) -> Inertial:
        return state


def present(inputs: Any) -> tuple[Scalar, Scalar]:
    """Whether the row's accelerometer, and its gyro, are to be believed."""
    return inputs["imu"][0] > 0.5, inputs["imu"][1] > 0.5


def in_stages(motion: AbstractMotion, state: Any, inputs: Any, dt: Scalar, w: Vector) -> Any:
    """A step by its stages."""
    for stage in motion.stages:
        state = stage(state, inputs, dt, w)
    return state


def coasted(state: Any, inputs: Any, dt: Scalar, w: Vector) -> Any:
    """The state half a step further at its velocity."""
    return state._replace(position=state.position + state.velocity * (0.5 * dt))


def pushed(
    position: Vector, velocity: Vector, acceleration: Vector, dt: Scalar, kick: Scalar, w: Vector
) -> tuple[Vector, Vector]:
    """Position and velocity pushed by an acceleration with white noise between two halves of a coasting step.

    Together exact for any interval; `kick` m/s. The noise is the same in all directions, so it may enter in room axes
    whatever the attitude. In one piece position would depend on all that the velocity does: half as much again for a
    covariance of fifteen states to be carried over.
    """
    n = len(position)
    along, across = Vector(*w.parts[:n]), Vector(*w.parts[n : 2 * n])
    return position + across * (kick * dt / 12**0.5), velocity + acceleration * dt + along * kick


def kept_unit(attitude: Rotation, dt: Scalar) -> Rotation:
    """The attitude without the rounding of thousands of products in its length; to the bit itself where dt = 0.

    No derivative sees the length: small steps keep it.
    """
    q = stop_gradient(attitude)
    square = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z
    scale = jnp.where(dt > 0, 1.5 - 0.5 * square, 1.0)
    return Rotation(attitude.w * scale, attitude.x * scale, attitude.y * scale, attitude.z * scale)


def _scale(value: float | Noise, unit: str) -> Noise:
    return value if isinstance(value, Noise) else Scale(value, unit)
