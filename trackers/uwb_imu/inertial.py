"""The assembled trackers of ranges and an IMU: eight states over the floor, fifteen in space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, congruence, diagonal
from trackers.core.ekf import Gaussian
from trackers.core.motion import Noise
from trackers.core.sensor import AbstractSensor
from trackers.core.state import Heading, Rotation
from trackers.core.tracker import AbstractStart, LossPolicy, Row, Tracker
from trackers.core.tunable import Scale
from trackers.uwb_imu.ranges import RANGES, RangeSensor
from trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown, Strapdown
from trackers.uwb_imu.yaws import YawBank


class InertialStart(AbstractStart):
    """Where recent ranges meet, at rest for all it knows, upright by what the accelerometer feels, yaw unknown.

    Inputs: `nearby` (4,), the place, m, and 1 where there is one; `rest` (7,), recent mean specific force and turning
    rate, and 1 where the body was at rest: then the rate is the gyro's bias. The sigmas say how far off it may be:
    `sigma_position` m, `sigma_height` m (large, for anchors at like heights see a tag and its mirror image nearly
    alike), `sigma_velocity` m/s, `sigma_tilt` rad, `sigma_yaw` rad, biases m/s² and rad/s.
    """

    sigma_position: Noise
    sigma_height: Noise
    sigma_velocity: Noise
    sigma_tilt: Noise
    sigma_yaw: Noise
    sigma_accel_bias: Noise
    sigma_gyro_bias: Noise
    planar: bool = eqx.field(static=True)

    def __init__(
        self,
        planar: bool,
        sigma_position: float = 1.0,
        sigma_height: float = 2.0,
        sigma_velocity: float = 1.0,
        sigma_tilt: float = 0.15,
        sigma_yaw: float = 1.0,
        sigma_accel_bias: float = 0.3,
        sigma_gyro_bias: float = 0.03,
    ):
        self.planar = planar
        self.sigma_position = Scale(sigma_position, "m")
        self.sigma_height = Scale(sigma_height, "m")
        self.sigma_velocity = Scale(sigma_velocity, "m/s")
        self.sigma_tilt = Scale(sigma_tilt, "rad")
        self.sigma_yaw = Scale(sigma_yaw, "rad")
        self.sigma_accel_bias = Scale(sigma_accel_bias, "m/s^2")
        self.sigma_gyro_bias = Scale(sigma_gyro_bias, "rad/s")

    def ready(self, row: Row) -> Scalar:
        return row.inputs["nearby"][3] > 0.5

    def acquire(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return row.inputs["nearby"][:3]

    def begin(self, found: Any, row: Row) -> Gaussian:
        zero = jnp.zeros_like(found[0])
        still = row.inputs["rest"][6] > 0.5
        bias = Vector.of(jnp.where(still, row.inputs["rest"][3 + k], 0.0) for k in range(3))
        at_rest = jnp.where(still, 0.1, 1.0)
        variances = {
            name: getattr(self, f"sigma_{name}").value ** 2
            for name in ("position", "height", "velocity", "tilt", "yaw", "accel_bias", "gyro_bias")
        }
        variances["gyro_bias"] = variances["gyro_bias"] * at_rest**2
        if self.planar:
            state: Any = PlanarInertial(
                Vector(*(found[k] for k in range(2))), Vector(zero, zero), Vector(zero, zero), Heading(zero), bias[2]
            )
            names = ["position"] * 2 + ["velocity"] * 2 + ["accel_bias"] * 2 + ["yaw", "gyro_bias"]
            return Gaussian(state, diagonal([variances[name] for name in names], zero))
        force = Vector.of(row.inputs["rest"][k] for k in range(3))
        felt = force.norm() > 1.0
        attitude = upright(Vector.of(jnp.where(felt, f, up) for f, up in zip(force, (0.0, 0.0, 1.0), strict=True)))
        state = Inertial(
            Vector(*(found[k] for k in range(3))), Vector(zero, zero, zero), attitude, Vector(zero, zero, zero), bias
        )
        names = ["position"] * 2 + ["height"] + ["velocity"] * 3 + ["tilt"] * 3 + ["accel_bias"] * 3 + ["gyro_bias"] * 3
        tilt = jnp.where(felt, 1.0, (0.7 / self.sigma_tilt.value) ** 2)
        spread = [variances[name] * tilt if name == "tilt" else variances[name] for name in names]
        # Of a turn about the vertical the accelerometer says nothing; the vertical in body axes is where it points.
        vertical = attitude.inverse().apply(Vector(zero, zero, zero + 1.0))
        return Gaussian(state, with_yaw(diagonal(spread, zero), vertical, self.sigma_yaw.value))


def with_yaw(upper: tuple[Scalar, ...], vertical: Vector, sigma_yaw: Scalar) -> tuple[Scalar, ...]:
    """The covariance of fifteen states with a turn about `vertical` (body axes) added to what is unsure."""
    eye = [{i: 1.0} for i in range(15)]
    return congruence(eye, upper, [{0: vertical[i - 6] * sigma_yaw} if 6 <= i < 9 else {} for i in range(15)])


def upright(force: Vector) -> Rotation:
    """The attitude, yaw zero, of a body whose accelerometer feels `force` (not zero) against gravity alone.

    The shortest turn that brings the force upwards; half a turn where it points down.
    """
    x, y, z = force / force.norm()
    down = z < -0.999
    w = jnp.where(down, 1.0, 1.0 + z)
    turn = Rotation(w, y, -x, jnp.zeros_like(x)).normalised()
    half = Rotation(*(jnp.zeros_like(x) + value for value in (0.0, 1.0, 0.0, 0.0)))
    return Rotation(
        *(
            jnp.where(down, a, b)
            for a, b in zip((half.w, half.x, half.y, half.z), (turn.w, turn.x, turn.y, turn.z), strict=True)
        )
    )


def inertial_tracker(
    planar: bool = False,
    noise: ImuNoise | None = None,
    sigma_r: float = 0.05,
    stretch: float = 5.0,
    tail: float = 3.0,
    anchors: int = 0,
    yaws: int = 3,
) -> Tracker:
    """Position, velocity, attitude and the IMU's biases from ranges and an IMU, either of which may be missing.

    `planar`: the paper's eight states over the floor, at a known height, else fifteen in space. The range sensor's
    numbers are those of `RangeSensor`, one slot a row, with a bias for each of so many `anchors`; `yaws`: how many are
    tried at the start.
    """
    noise = noise or ImuNoise(0.2, 0.02, 0.005, 0.0005, 1.5, 0.3)
    motion = PlanarStrapdown(noise) if planar else Strapdown(noise)
    sensors = {RANGES: RangeSensor(1, anchors, sigma_r, stretch, tail)}
    # Obstructed ranges are too long for seconds: a large running NIS is no sign of a lost track there.
    return Tracker(motion, sensors, InertialStart(planar), YawBank(count=yaws), LossPolicy(limit=1e3, patience=10.0))
