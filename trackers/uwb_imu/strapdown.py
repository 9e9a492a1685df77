"""Strapdown mechanisation: the IMU's samples drive the motion; its noise and biases are the process noise and states.

An IMU sample is an input of its row, not a reading: `accel` (3,) m/s², specific force in body axes (+g upwards at
rest); `gyro` (3,) rad/s in body axes; `imu` (2,), above ½ if the accelerometer, and the gyro, are available. The
attitude is a manifold-valued leaf of the state, so the ordinary extended Kalman filter on it is the error-state filter.

    p⁺ = p + v dt + ½ a dt²    v⁺ = v + a dt    a = R (f − b_a) + g    R⁺ = R exp((ω − b_g) dt)

Without an accelerometer the acceleration is white noise; without a gyro the attitude is a random walk.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import Input, Inputs, Need
from trackwright.trackers.core.model.motion import AbstractMotion, Noise, as_scale, process_noise
from trackwright.trackers.core.model.state import Heading, Rotation
from trackwright.trackers.core.model.tunable import Real
from trackwright.trackers.parts.drifting_biases import BiasDrift

_HELPER = "`tw.build('uwb-imu', folder)`, from the table imu of a recording folder"
ACCEL = Input("accel", (3,), "m/s^2", "specific force in body axes", _HELPER)
GYRO = Input("gyro", (3,), "rad/s", "turning rate in body axes", _HELPER)
IMU = Input("imu", (2,), "", "whether accelerometer and gyro are available, 1 or 0", _HELPER)
"""The inputs with the IMU's sample."""

ARM = Input(
    "arm",
    (3,),
    "m",
    "the lever arm from the IMU, or the middle of the axle, to the tag in body axes",
    "`offset_m` of the tag in rig.toml",
    Need.IF_GIVEN,
)
"""The input with the place of a tag on its body."""


class PlanarInertial(NamedTuple):
    """The eight states of Kwon et al. 2021, equations (18)–(20), for a level body in the plane.

    Position m and velocity m/s (world axes), accelerometer bias m/s² (body x, y), yaw rad, gyro bias rad/s; in addition
    to the paper's, a range bias per anchor, m, none by default.
    """

    position: Vector
    velocity: Vector
    accel_bias: Vector
    attitude: Heading
    gyro_bias: Scalar
    bias: Vector = Vector()


class Inertial(NamedTuple):
    """Fifteen states: position m, velocity m/s (world), attitude body to world, biases m/s² and rad/s (body).

    The position may be of a tag at a lever arm from the IMU; the velocity is the IMU's. In addition, a range bias
    per anchor, m, none by default.
    """

    position: Vector
    velocity: Vector
    attitude: Rotation
    accel_bias: Vector
    gyro_bias: Vector
    bias: Vector = Vector()


class ImuNoise(eqx.Module):
    """Process noise of an IMU, of the motion where a sensor is missing, and of the range biases.

    `sigma_accel` m/s² per √Hz, `sigma_gyro` rad/s per √Hz: white noise. `sigma_accel_walk` m/s² per √s,
    `sigma_gyro_walk` rad/s per √s: random walks of their biases. `sigma_a` m/s² per √Hz: acceleration without an
    accelerometer; `sigma_turn` rad per √s: rotation without a gyro. `sigma_range_walk` m per √s: random walk of a bias;
    None where these drift otherwise.
    """

    sigma_accel: Noise
    sigma_gyro: Noise
    sigma_accel_walk: Noise
    sigma_gyro_walk: Noise
    sigma_a: Noise
    sigma_turn: Noise
    sigma_range_walk: Noise | None

    def __init__(
        self,
        sigma_accel: float | Noise = 0.2,
        sigma_gyro: float | Noise = 0.02,
        sigma_accel_walk: float | Noise = 0.005,
        sigma_gyro_walk: float | Noise = 0.0005,
        sigma_a: float | Noise = 1.5,
        sigma_turn: float | Noise = 0.3,
        sigma_range_walk: float | Noise | None = 0.02,
    ):
        self.sigma_accel = process_noise(sigma_accel, "m/s^2/sqrt(Hz)")
        self.sigma_gyro = process_noise(sigma_gyro, "rad/s/sqrt(Hz)")
        self.sigma_accel_walk = as_scale(sigma_accel_walk, "m/s^2/sqrt(s)", "bias noise")
        self.sigma_gyro_walk = as_scale(sigma_gyro_walk, "rad/s/sqrt(s)", "bias noise")
        self.sigma_a = process_noise(sigma_a, "m/s^2/sqrt(Hz)")
        self.sigma_turn = process_noise(sigma_turn, "rad/sqrt(s)")
        walk = sigma_range_walk
        self.sigma_range_walk = None if walk is None else as_scale(walk, "m/sqrt(s)", "bias noise")

    def sigmas(self, inputs: Inputs, dt: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """Standard deviations over `dt` of velocity m/s, attitude rad, accelerometer bias m/s² and gyro bias rad/s."""
        root = jnp.sqrt(dt)
        accel, gyro = imu_available(inputs)
        return (
            jnp.where(accel, self.sigma_accel.value, self.sigma_a.value) * root,
            jnp.where(gyro, self.sigma_gyro.value, self.sigma_turn.value) * root,
            self.sigma_accel_walk.value * root,
            self.sigma_gyro_walk.value * root,
        )


class AbstractStrapdown(AbstractMotion):
    """A stage with the IMU's sample and the process noise, between two half steps at constant velocity."""

    noise: eqx.AbstractVar[ImuNoise]
    biases: eqx.AbstractVar[int]
    drift: eqx.AbstractVar[BiasDrift | None]

    @abstractmethod
    def drive(self, state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> Any:
        """The stage in the middle."""

    @property
    def stages(self) -> Any:
        return half_coast, self.drive, half_coast

    def step(self, state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> Any:
        for stage in self.stages:
            state = stage(state, inputs, dt, w)
        return state

    def at(self, belief: Any) -> AbstractStrapdown:
        """The motion with the speed of this belief where its biases drift with the way covered."""
        return self if self.drift is None else eqx.tree_at(lambda m: m.drift, self, self.drift.at(belief))

    def biases_after(self, state: Any, dt: Scalar, w: Sequence[Scalar]) -> Vector:
        """The biases of anchors `dt` s later, given a draw for each."""
        if self.drift is not None and self.biases:
            return self.drift.drifted(state, dt, w)
        bias: Vector = state.bias
        walk = self.noise.sigma_range_walk
        return bias + Vector(*w) * (walk.value * jnp.sqrt(dt)) if walk is not None and self.biases else bias


class PlanarStrapdown(AbstractStrapdown):
    """The paper's planar mechanisation in world axes; `noise`: of the IMU; `biases`: number of range biases.

    `drift`: how these drift, None for the random walk of `noise`.

    The velocity does not change by −ω × v, as in Kwon et al. 2021, equation (2): that term belongs to a velocity in
    rotating axes, and the paper adds it to one that is integrated to a position in world axes.
    """

    noise: ImuNoise
    biases: int = eqx.field(static=True, default=0)
    drift: BiasDrift | None = None

    @property
    def inputs(self) -> tuple[Input, ...]:
        return ACCEL, GYRO, IMU

    @property
    def noise_dimension(self) -> int:
        return 8 + self.biases

    def drive(self, state: PlanarInertial, inputs: Inputs, dt: Scalar, w: Vector) -> PlanarInertial:
        has_accel, has_gyro = imu_available(inputs)
        sigma_velocity, sigma_attitude, accel_walk, gyro_walk = self.noise.sigmas(inputs, dt)
        rate = jnp.where(has_gyro, inputs["gyro"][2] - state.gyro_bias, 0.0)
        x, y = (inputs["accel"][k] - state.accel_bias[k] for k in range(2))
        # The heading in the middle of the step: the specific force rotates with the body.
        mid_heading = state.attitude.angle + rate * (0.5 * dt)
        cosine, sine = jnp.cos(mid_heading), jnp.sin(mid_heading)
        rotated = Vector(cosine * x - sine * y, sine * x + cosine * y)
        acceleration = Vector.of(jnp.where(has_accel, a, 0.0) for a in rotated)
        position, velocity = accelerated(state.position, state.velocity, acceleration, dt, sigma_velocity, w)
        return PlanarInertial(
            position,
            velocity,
            state.accel_bias + Vector(*w.parts[4:6]) * accel_walk,
            Heading(state.attitude.angle + rate * dt + w[6] * sigma_attitude),
            state.gyro_bias + w[7] * gyro_walk,
            self.biases_after(state, dt, w.parts[8:]),
        )


class Strapdown(AbstractStrapdown):
    """The mechanisation in three dimensions, world axes with z up (Solà 2017, section 5.2); `noise`: of the IMU.

    `gravity`: specific force at rest, m/s². Optional input `arm` (3,) m: the lever arm, from the IMU in body axes, of
    the tag whose position is in the state; the tunable `arm` (3,) m adds to it. `biases`: number of range biases in the
    state; `drift`: how they drift, None for the random walk of `noise`.
    """

    noise: ImuNoise
    gravity: Noise
    arm: Noise
    biases: int = eqx.field(static=True)
    drift: BiasDrift | None

    def __init__(self, noise: ImuNoise, gravity: float | Noise = 9.81, biases: int = 0, drift: BiasDrift | None = None):
        self.noise = noise
        self.biases = biases
        self.drift = drift
        self.arm = Real(np.zeros(3), "m", typical=0.05)
        self.gravity = gravity if isinstance(gravity, Noise) else Real(gravity, "m/s^2", typical=0.1)

    @property
    def inputs(self) -> tuple[Input, ...]:
        return ACCEL, GYRO, IMU, ARM

    @property
    def noise_dimension(self) -> int:
        return 15 + self.biases

    def drive(self, state: Inertial, inputs: Inputs, dt: Scalar, w: Vector) -> Inertial:
        has_accel, has_gyro = imu_available(inputs)
        sigma_velocity, sigma_attitude, accel_walk, gyro_walk = self.noise.sigmas(inputs, dt)
        rate = Vector.of(jnp.where(has_gyro, inputs["gyro"][k] - state.gyro_bias[k], 0.0) for k in range(3))
        force = Vector.of(inputs["accel"][k] - state.accel_bias[k] for k in range(3))
        # The specific force in the middle of the step, in the initial body axes, to first order in the rotation.
        x, y, z = state.attitude.apply(force + rate.cross(force) * (0.5 * dt))
        acceleration = Vector.of(jnp.where(has_accel, a, 0.0) for a in (x, y, z - self.gravity.value))
        position, velocity = accelerated(state.position, state.velocity, acceleration, dt, sigma_velocity, w)
        turned = renormalised(state.attitude @ Rotation.exp(rate * dt + Vector(*w.parts[6:9]) * sigma_attitude), dt)
        if "arm" in inputs:
            arm = Vector.of(inputs["arm"][k] + self.arm.value[k] for k in range(3))
            position = position + (turned.apply(arm) - state.attitude.apply(arm))
        return Inertial(
            position,
            velocity,
            turned,
            state.accel_bias + Vector(*w.parts[9:12]) * accel_walk,
            state.gyro_bias + Vector(*w.parts[12:15]) * gyro_walk,
            self.biases_after(state, dt, w.parts[15:]),
        )


def imu_available(inputs: Inputs) -> tuple[Scalar, Scalar]:
    """Whether the row's accelerometer and its gyro are available."""
    return inputs["imu"][0] > 0.5, inputs["imu"][1] > 0.5


def half_coast(state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> Any:
    """The state after half a step at constant velocity."""
    return state._replace(position=state.position + state.velocity * (0.5 * dt))


def accelerated(
    position: Vector, velocity: Vector, acceleration: Vector, dt: Scalar, sigma_velocity: Scalar, w: Vector
) -> tuple[Vector, Vector]:
    """Position and velocity after an acceleration with white noise, between two half steps at constant velocity.

    Together with the half steps exact for any interval; `sigma_velocity` m/s. The noise is isotropic and enters in
    world axes. As one stage the Jacobian of the position would be denser, and propagating the covariance of fifteen
    states half as expensive again.
    """
    n = len(position)
    shared, separate = Vector(*w.parts[:n]), Vector(*w.parts[n : 2 * n])
    return position + separate * (sigma_velocity * dt / 12**0.5), velocity + acceleration * dt + shared * sigma_velocity


def renormalised(attitude: Rotation, dt: Scalar) -> Rotation:
    """The attitude renormalised to unit length; bit-identical where dt = 0.

    It corrects the accumulated rounding of many products; its derivative is left out.
    """
    q = stop_gradient(attitude)
    square = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z
    scale = jnp.where(dt > 0, 1.5 - 0.5 * square, 1.0)
    return Rotation(attitude.w * scale, attitude.x * scale, attitude.y * scale, attitude.z * scale)
