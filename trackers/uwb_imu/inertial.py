"""The assembled trackers of ranges and an IMU: eight states over the floor, fifteen in space."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, diagonal, triangle
from trackers.core.ekf import Gaussian
from trackers.core.motion import Noise
from trackers.core.recording import Row
from trackers.core.state import Heading, Rotation
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Scale
from trackers.parts.ranges import RANGES, RangeSensor
from trackers.parts.start_nearby import AbstractNearbyStart
from trackers.uwb_imu.fusion import OWN_BIASES
from trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown, Strapdown
from trackers.uwb_imu.yaws import YawBank


class InertialStart(AbstractNearbyStart):
    """Where recent ranges meet, at rest for all it knows, upright by what the accelerometer feels, yaw unknown.

    Inputs: `nearby` (4,), the place, m, and 1 where there is one; `rest` (7,), recent mean specific force and turning
    rate, and 1 where the body was at rest: then the rate is the gyro's bias. The sigmas say how far off it may be:
    `sigma_position` m, `sigma_height` m (large, for anchors at like heights see a tag and its mirror image nearly
    alike), `sigma_velocity` m/s, `sigma_tilt` rad, `sigma_yaw` rad, biases m/s², rad/s and, of the ranges, m.
    """

    sigma_position: Noise
    sigma_height: Noise
    sigma_velocity: Noise
    sigma_tilt: Noise
    sigma_yaw: Noise
    sigma_accel_bias: Noise
    sigma_gyro_bias: Noise
    sigma_bias: Noise
    planar: bool = eqx.field(static=True)
    biases: int = eqx.field(static=True)

    def __init__(
        self,
        planar: bool,
        biases: int = 0,
        sigma_position: float = 1.0,
        sigma_height: float = 2.0,
        sigma_velocity: float = 1.0,
        sigma_tilt: float = 0.15,
        sigma_yaw: float = 1.0,
        sigma_accel_bias: float = 0.3,
        sigma_gyro_bias: float = 0.03,
        sigma_bias: float = 0.05,
    ):
        self.planar = planar
        self.biases = biases
        self.sigma_position = Scale(sigma_position, "m")
        self.sigma_height = Scale(sigma_height, "m")
        self.sigma_velocity = Scale(sigma_velocity, "m/s")
        self.sigma_tilt = Scale(sigma_tilt, "rad")
        self.sigma_yaw = Scale(sigma_yaw, "rad")
        self.sigma_accel_bias = Scale(sigma_accel_bias, "m/s^2")
        self.sigma_gyro_bias = Scale(sigma_gyro_bias, "rad/s")
        self.sigma_bias = Scale(sigma_bias, "m")

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        zero = jnp.zeros_like(candidate[0])
        still = row.inputs["rest"][6] > 0.5
        rate = Vector.of(jnp.where(still, row.inputs["rest"][3 + k], 0.0) for k in range(3))
        force = Vector.of(row.inputs["rest"][k] for k in range(3))
        felt = force.norm() > 1.0
        names = ("position", "height", "velocity", "tilt", "yaw", "accel_bias", "gyro_bias", "bias")
        variances = {name: zero + getattr(self, f"sigma_{name}").value ** 2 for name in names}
        variances["gyro_bias"] *= jnp.where(still, 0.01, 1.0)
        variances["tilt"] *= jnp.where(felt, 1.0, 25.0)
        nothing, biases = Vector(zero, zero, zero), Vector(*[zero] * self.biases)
        if self.planar:
            flat = Vector(zero, zero)
            state: Any = PlanarInertial(Vector(candidate[0], candidate[1]), flat, flat, Heading(zero), rate[2], biases)
            spread = {"position": 2, "velocity": 2, "accel_bias": 2, "yaw": 1, "gyro_bias": 1, "bias": self.biases}
            return Gaussian(state, diagonal([variances[k] for k, count in spread.items() for _ in range(count)], zero))
        attitude = upright(Vector.of(jnp.where(felt, f, up) for f, up in zip(force, (0.0, 0.0, 1.0), strict=True)))
        state = Inertial(Vector(*(candidate[k] for k in range(3))), nothing, attitude, nothing, rate, biases)
        spread = {"position": 2, "height": 1, "velocity": 3, "tilt": 3, "accel_bias": 3, "gyro_bias": 3}
        spread["bias"] = self.biases
        cov = diagonal([variances[k] for k, count in spread.items() for _ in range(count)], zero)
        # Of a turn about the vertical the accelerometer says nothing; the vertical in body axes is where it points.
        vertical = attitude.inverse().apply(Vector(zero, zero, zero + 1.0))
        return Gaussian(state, turning(cov, vertical, variances["yaw"]))


def turning(upper: tuple[Scalar, ...], axis: Vector, variance: Scalar) -> tuple[Scalar, ...]:
    """The covariance of an `Inertial` state that may besides be turned about `axis` (body axes), `variance` rad²."""
    n = int((8 * len(upper) + 1) ** 0.5) // 2
    attitude = range(6, 9)
    return tuple(
        p + axis[i - 6] * axis[j - 6] * variance if i in attitude and j in attitude else p
        for p, (i, j) in zip(upper, triangle(n), strict=True)
    )


def upright(force: Vector) -> Rotation:
    """The attitude, yaw zero, of a body whose accelerometer feels `force` (not zero) against gravity alone.

    The shortest turn that brings the force upwards; half a turn where it points down.
    """
    x, y, z = force / force.norm()
    down = z < -0.999
    w = jnp.where(down, 1.0, 1.0 + z)
    turn = Rotation(w, y, -x, jnp.zeros_like(x)).normalised()
    half = Rotation(*(jnp.zeros_like(x) + value for value in (0.0, 1.0, 0.0, 0.0)))
    return Rotation(*(jnp.where(down, getattr(half, q), getattr(turn, q)) for q in "wxyz"))


def inertial_tracker(
    anchors: int = 0,
    planar: bool = False,
    noise: ImuNoise | None = None,
    sigma_r: float = 0.1,
    positive_skew: float = 3.0,
    dof: float = 3.0,
    bias: float = 0.03,
    yaws: int = 3,
) -> Tracker:
    """Position, velocity, attitude and the IMU's biases from ranges and an IMU, either of which may be missing.

    `planar`: the paper's eight states over the floor, at a known height; else fifteen in space, and for up to
    `OWN_BIASES` numbered `anchors` a bias of each beside them. The range sensor's numbers are those of `RangeSensor`,
    one slot a row; `yaws`: how many are tried at the start.
    """
    noise = noise or ImuNoise(0.2, 0.02, 0.005, 0.0005, 1.5, 0.3, 0.005)
    # Over the floor, where three anchors are enough, biases and places can't be told apart.
    biases = anchors if anchors <= OWN_BIASES and not planar else 0
    motion = PlanarStrapdown(noise) if planar else Strapdown(noise, biases=biases)
    return Tracker(
        motion,
        {RANGES: RangeSensor(1, anchors, sigma_r, positive_skew, dof, bias)},
        InertialStart(planar, biases),
        YawBank(count=yaws),
        # Obstructed ranges are too long for seconds: a large running NIS is no sign of a lost track there.
        TrackLossPolicy(nis_limit=1e3, max_gap=10.0),
    )
